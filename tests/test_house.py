"""How the house is built: imports run downward, Lightning lives on the top floor, every configuration works."""

import ast
import sys
import tomllib
import warnings
from dataclasses import fields, is_dataclass, replace
from importlib import import_module
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest
import yaml
from floors import LIGHTNING, PACKAGE, ROOT, files, module_of, part
from lightning.pytorch.callbacks import WeightAveraging
from lightning.pytorch.strategies import DDPStrategy, ModelParallelStrategy
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from prior.tiny import tiny_prior, tiny_refiner

from phydict.cli import train
from phydict.cli.infer import InferenceCLI
from phydict.cli.infer import main as infer
from phydict.grid import Grid
from phydict.inference import ReconstructionData, ReconstructionTask
from phydict.methods import METHODS
from phydict.posterior import DDS, Posterior
from phydict.prior import save_prior, save_refiner
from phydict.xray import ConeBeam, Ideal, Polychromatic
from phydict.xray.checks import check_scale

FLOORS = {
    "runtime": 0, "units": 0, "linalg": 0,
    "grid": 1,
    "xray": 2, "diffusion": 2,
    "prior": 3, "datasets": 3, "reconstruction": 3, "guard": 3,
    "posterior": 4, "baselines": 4, "evaluation": 4,
    "rivals": 5, "page": 5, "poses": 5,
    "methods": 6,
    "training": 7, "inference": 7,
    "ablation": 8,
    "cli": 9}
MOST_ARGUMENTS = 10
LONG = {
    "SplitGibbs": "constants of the paper's text and release", "PnPDM": "published constants",
    "Unrolled": "constants that its network was trained with", "Reward": "terms of the paper's text and release",
    "Scenes": "a share of each fault that X-rays may have", "OrbitScenes": "Scenes on one orbit",
    "Towers": "sizes of a published network", "Reconstruction": "a record of a result",
    "Thorax": "a record, drawn by a seed", "CTThorax": "a Thorax, fitted to a CT", "Couch": "a record, drawn by a seed",
    "DicomTags": "a record of a file", "Trial": "a record of one row's settings"}
"""Dataclasses with more fields than a constructor may have arguments -> why."""

ROOT_FILES = 8
"""How many modules the package's top may hold."""

CONFIGS = {folder: sorted((ROOT / "configs" / folder).glob("*.yaml"))
           for folder in ("prior", "rivals", "reconstruct", "geometry", "simulate")}

SEVERAL_DEVICES = (ROOT / "configs" / "prior" / "ddp.yaml", ROOT / "configs" / "prior" / "fsdp.yaml")


def imported(file: Path) -> list[str]:
    """Full names of everything a file imports, anywhere in it."""
    names = []
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert not node.level, f"{file} uses a relative import"
            names += [f"{node.module}.{alias.name}" for alias in node.names]
    return names


@pytest.mark.parametrize("file", files(), ids=lambda f: str(f.relative_to(PACKAGE)))
def test_a_file_imports_from_lower_floors_and_its_own_part_alone(file):
    own = part(file)
    for name in imported(file):
        if name.split(".")[0] != "phydict":
            continue
        other = name.split(".")[1]
        assert other in FLOORS, f"{file} imports {name}, which is on no floor"
        assert other == own or FLOORS[other] < FLOORS[own], f"{own} must not import {other} ({name})"


def test_what_is_imported_is_declared_and_what_is_declared_is_pinned():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    wanted = project["dependencies"] + sum(project["optional-dependencies"].values(), [])
    declared = {canonicalize_name(Requirement(text).name) for text in wanted}
    homes = packages_distributions()
    tops = {name.split(".")[0] for file in files() for name in imported(file)} - set(sys.stdlib_module_names)
    for top in tops - {"phydict"}:
        assert {canonicalize_name(home) for home in homes.get(top, [top])} & declared, f"{top} is not declared"
    pinned = {canonicalize_name(line.partition("=")[0]) for line in (ROOT / "constraints.txt").read_text().splitlines()}
    needed = {canonicalize_name(Requirement(text).name) for text in project["dependencies"]}
    assert needed <= pinned, f"not pinned: {needed - pinned}"


@pytest.mark.parametrize("file", files(), ids=lambda f: str(f.relative_to(PACKAGE)))
def test_lightning_is_imported_on_the_top_floor_alone(file):
    found = [name for name in imported(file) if name.split(".")[0] in ("lightning", "pytorch_lightning")]
    assert not found or part(file) in LIGHTNING


@pytest.mark.parametrize("file", files(), ids=lambda f: str(f.relative_to(PACKAGE)))
def test_a_constructor_takes_at_most_ten_arguments(file):
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.FunctionDef) and node.name == "__init__":
            count = len(node.args.args) + len(node.args.kwonlyargs) - 1
            assert count <= MOST_ARGUMENTS, f"{file}:{node.lineno}"


def test_a_dataclass_has_as_few_fields():
    made = {kind for file in files() for kind in vars(import_module(module_of(file))).values()
            if isinstance(kind, type) and is_dataclass(kind) and kind.__module__.startswith("phydict.")}
    assert len(made) > 100 and Posterior in made
    long = {kind.__name__ for kind in made if sum(f.init for f in fields(kind)) > MOST_ARGUMENTS}
    assert long == set(LONG), "group settings into dataclasses of their own, or add a record to LONG"


def test_every_part_has_a_floor_and_the_top_is_small():
    assert {part(f) for f in files()} == set(FLOORS)
    assert len(list(PACKAGE.glob("*.py"))) <= ROOT_FILES


@pytest.fixture(scope="module")
def priors(tmp_path_factory) -> Path:
    """A folder of a tiny prior and a tiny refiner."""
    folder = tmp_path_factory.mktemp("priors")
    save_prior(tiny_prior(), folder / "tiny.safetensors")
    save_refiner(tiny_refiner(), folder / "refiner.safetensors")
    return folder


@pytest.fixture
def inference(priors, monkeypatch):
    """Builds infer.py's command line from arguments, with a tiny prior and nothing run."""
    monkeypatch.chdir(priors)
    return lambda *args: InferenceCLI(
        ReconstructionTask, ReconstructionData, run=False, save_config_callback=None,
        trainer_defaults={"logger": False, "accelerator": "cpu", "devices": 1, "enable_progress_bar": False,
                          "enable_checkpointing": False, "enable_model_summary": False},
        args=["--model.prior=tiny.safetensors", *args, "--model.out=out"])


def built(model: ReconstructionTask):
    return model.reconstructor.sampler if isinstance(model.reconstructor, Posterior) else model.reconstructor


@pytest.mark.parametrize("config", CONFIGS["reconstruct"], ids=lambda f: f.stem)
def test_a_named_method_is_what_its_configuration_builds(inference, config):
    model = inference(f"--config={config}").model
    assert built(model) == METHODS[config.stem]
    assert model.method_name == config.stem == model.reconstructor.name


@pytest.mark.parametrize("name", METHODS)
@pytest.mark.parametrize("config", CONFIGS["simulate"], ids=lambda f: f.stem)
def test_every_method_builds_by_its_name_and_goes_with_every_simulator(inference, name, config):
    cli = inference(f"--model.method={name}", f"--config={config}",
                    *["--model.prior=refiner.safetensors"] * (name == "phydict_learned"))
    assert built(cli.model) == METHODS[name]
    assert cli.datamodule.simulator == {"ideal": Ideal(), "polychromatic": Polychromatic()}[config.stem]
    assert cli.model.method_name == name
    ready = cli.model.reconstructor.with_mu_water(cli.datamodule.simulator.effective_mu_water)
    assert ready.mu_water == cli.datamodule.simulator.effective_mu_water and ready.name == name


PAPER, SETTINGS = f"--config={ROOT / 'configs' / 'reconstruct' / 'phydict_paper.yaml'}", "--model.method.init_args"


@pytest.mark.parametrize("args, name, method", [
    ([], "phydict_fast", METHODS["phydict_fast"]),
    (["--model.prior=refiner.safetensors"], "phydict_learned", METHODS["phydict_learned"]),
    (["--model.name=mine"], "mine", METHODS["phydict_fast"]),
    (["-c", "{model: {prior: refiner.safetensors}}", "--model.prior=tiny.safetensors"], "phydict_fast",
     METHODS["phydict_fast"]),
    (["-c", str(CONFIGS["simulate"][0])], "phydict_fast", METHODS["phydict_fast"]),
    (["-c", "dds"], "dds", METHODS["dds"]), (["-c", "configs/reconstruct/dds.yaml"], "dds", METHODS["dds"]),
    ([PAPER, "--model.method", "phydict_fast"], "phydict_fast", METHODS["phydict_fast"]),
    (["--model.method=dds", PAPER], "phydict_paper", METHODS["phydict_paper"]),
    ([PAPER, "--model.name=mine", "--model.method=dds"], "mine", METHODS["dds"]),
    (["--model.method=dds", f"{SETTINGS}.iterations=4", "-c", "polychromatic"], "dds",
     replace(METHODS["dds"], iterations=4)),
    (["--model.method=dds", "--model.name=mine"], "mine", METHODS["dds"]),
    (["--model.name=mine", "--model.method=dds"], "mine", METHODS["dds"]),
    (["--model.method=dds", f"{SETTINGS}.iterations=4"], "dds", replace(METHODS["dds"], iterations=4)),
    (["--model.method=phydict.posterior.DDS", f"{SETTINGS}.iterations=4"], "DDS", DDS(iterations=4)),
    (["--model.method=DDS"], "DDS", DDS()),
    (["-c", "{model: {method: phydict.posterior.DDS}}"], "DDS", DDS()),
], ids=lambda value: " ".join(value).replace(str(ROOT), "") if isinstance(value, list) else "")
def test_a_method_is_given_by_name_by_class_or_not_at_all(inference, args, name, method):
    model = inference(*args).model
    assert (model.method_name, built(model)) == (name, method)


@pytest.fixture
def prior_training(tmp_path, monkeypatch):
    """Builds train.py's command line from configurations, on two phantoms and one CPU process, with nothing run."""
    monkeypatch.chdir(tmp_path)
    return lambda *configs: train.PriorCLI(
        *train.STAGES[train.stage_of([f"--config={config}" for config in configs])], run=False,
        save_config_callback=None,
        args=[*(f"--config={config}" for config in configs), "--data.phantoms=2", "--data.holdout.phantoms=1",
              "--trainer.accelerator=cpu", "--trainer.devices=1"])


@pytest.mark.parametrize("config", [
    f for f in CONFIGS["prior"] + CONFIGS["rivals"] if f not in SEVERAL_DEVICES], ids=lambda f: f.stem)
def test_every_training_configuration_builds(prior_training, config):
    cli = prior_training(config)
    assert cli.model.prior.grid.same_as(cli.datamodule.grid) and cli.model.prior.window == cli.datamodule.window
    assert cli.trainer.max_steps == yaml.safe_load(config.read_text())["trainer"]["max_steps"]


@pytest.mark.parametrize("devices, strategy, averaged", zip(SEVERAL_DEVICES, (DDPStrategy, ModelParallelStrategy),
                                                            (True, False)), ids=["ddp", "fsdp"])
def test_several_devices_are_a_second_configuration_that_changes_nothing_else(prior_training, devices, strategy,
                                                                              averaged):
    alone, cli = (prior_training(CONFIGS["prior"][0], *more) for more in ([], [devices]))
    assert isinstance(cli.trainer.strategy, strategy)
    assert any(isinstance(c, WeightAveraging) for c in cli.trainer.callbacks) == averaged
    assert cli.trainer.max_steps == alone.trainer.max_steps and cli.trainer.precision == alone.trainer.precision


@pytest.mark.parametrize("config", CONFIGS["geometry"], ids=lambda f: f.stem)
def test_every_geometry_is_read_and_clear_of_the_default_volume(config):
    beam = ConeBeam.from_dict(yaml.safe_load(config.read_text())["beam"])
    beam.check(Grid.cube(64))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_scale(beam, Grid.cube(64))


@pytest.mark.parametrize("main, command", [(infer, "predict"), (train.main, "fit")], ids=["infer", "train"])
@pytest.mark.parametrize("settings, key", [
    ({"model": {"lerning_rate": 1}}, "lerning_rate"), ({"modle": {"seed": 1}}, "modle"),
    ({"data": {"veiws": 3}}, "veiws"), ({"trainer": {"max_stpes": 3}}, "max_stpes")])
def test_an_unknown_key_is_an_error_that_names_it(tmp_path, monkeypatch, capsys, main, command, settings, key):
    monkeypatch.chdir(tmp_path)
    good = CONFIGS["reconstruct" if main is infer else "prior"][0]
    mixed = yaml.safe_load(good.read_text())
    for section, values in settings.items():
        mixed[section] = (mixed.get(section) or {}) | values
    (tmp_path / "bad.yaml").write_text(yaml.safe_dump(mixed))
    with pytest.raises(SystemExit) as stopped:
        main([command, "--config", "bad.yaml"])
    assert stopped.value.code not in (0, None)
    assert key in capsys.readouterr().err


@pytest.mark.parametrize("settings", [{"iterations": 0}, {"t_start": 2.0}])
def test_an_impossible_setting_is_an_error_that_says_why(tmp_path, monkeypatch, capsys, settings):
    monkeypatch.chdir(tmp_path)
    method = {"class_path": "phydict.posterior.SplitGibbs", "init_args": settings}
    (tmp_path / "bad.yaml").write_text(yaml.safe_dump({"model": {"name": "bad", "method": method}}))
    with pytest.raises(SystemExit) as stopped:
        infer(["predict", "--config", "bad.yaml"])
    assert stopped.value.code not in (0, None)
    assert next(iter(settings)).removesuffix("s") in capsys.readouterr().err
