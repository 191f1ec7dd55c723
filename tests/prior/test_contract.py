"""A prior of one's own takes the place of a trained one, in Python and on the command line."""

import json
import re
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
import yaml
from command_lines import refusal
from posterior.scene import PROJECTOR, views

import phydict
from phydict.cli.infer import main as infer
from phydict.diffusion import CosineSchedule
from phydict.inference import ReconstructionTask
from phydict.methods import METHODS, reconstructor
from phydict.prior import find_prior, own_identity
from phydict.runtime.own_code import own_code
from prior.tiny import tiny_prior

MODULE = (Path(__file__).parents[2] / "data" / "example" / "own_prior" / "my_prior.py").read_text() + '''

class OwnPrior(MyPrior):
    grid = Grid.cube(16)


class Shapeless(OwnPrior):
    def bind(self, report, guidance, precision):
        denoiser = super().bind(report, guidance, precision)
        object.__setattr__(denoiser, "denoise", lambda x, t: x[..., :1])
        return denoiser


class Underived:
    grid, window, state_channels, bind = OwnPrior.grid, HUWindow(), 1, OwnPrior.bind

    def __init__(self, hu: float = -500.0):
        self.hu = hu


class Weighted(Underived, torch.nn.Module):
    def __init__(self, weight: float = 0.0):
        torch.nn.Module.__init__(self)
        self.weight, self.hu = torch.nn.Parameter(torch.full((2,), weight)), -500.0


class Derived(OwnPrior, torch.nn.Module):
    def __init__(self, weight: float = 0.0):
        torch.nn.Module.__init__(self)
        self.weight, self.hu = torch.nn.Parameter(torch.full((2,), weight)), -500.0


class Unbound:
    grid, window, state_channels = Grid.cube(16), HUWindow(), 1


class Needy(OwnPrior):
    def __init__(self, hu):
        self.hu = hu


class Reportless(OwnPrior):
    def bind(self, report):
        return super().bind(report, 1.0, "auto")


class Nothing(OwnPrior):
    def bind(self, report, guidance, precision):
        super().bind(report, guidance, precision)


class Given(OwnPrior):
    def bind(self, report, guidance, precision):
        return self.denoiser


class Timeless(CosineSchedule):
    def alpha_bar(self, t):
        return super().alpha_bar(t) ** 2


class Dropping(Derived):
    precision = "float32"

    def bind(self, report, guidance, precision):
        self.was_training = self.training
        return super().bind(report, guidance, precision)
'''


@pytest.fixture
def module(tmp_path, monkeypatch):
    """The name of a module with priors of one's own."""
    name = f"own_{re.sub('[^a-z0-9]', '_', tmp_path.name)}"
    (tmp_path / f"{name}.py").write_text(MODULE)
    monkeypatch.syspath_prepend(tmp_path)
    return name


@pytest.fixture
def xrays():
    return phydict.load_xrays("data/example/xrays")


@pytest.mark.filterwarnings("ignore:.*as dense as 1000 HU")
def test_in_python_it_is_an_object_or_the_path_of_its_class(module, xrays):
    prior = find_prior(f"{module}.OwnPrior")
    given = xrays["xrays"], xrays["beam"]
    found = phydict.reconstruct(*given, prior, display=xrays["display"])
    by_path = phydict.reconstruct(*given, f"{module}.OwnPrior", display=xrays["display"])
    assert torch.equal(found.volume, by_path.volume) and found.grid.same_as(prior.grid)
    alone = phydict.reconstruct(*given, prior, "prior_only", display=xrays["display"])
    assert found.misfit < 0.5 * alone.misfit and alone.volume.mean() == pytest.approx(-500, abs=50)


def test_on_the_command_line_it_is_a_class_with_its_settings(module, tmp_path):
    settings = {"model": {"prior": {"class_path": f"{module}.OwnPrior", "init_args": {"hu": -300.0}}}}
    (tmp_path / "own.yaml").write_text(yaml.safe_dump(settings))
    common = ["predict", "--data.xrays", "data/example/xrays", "--model.method", "prior_only",
              "--model.sampling.with_report", "false", "--model.out"]
    infer([*common, str(tmp_path / "a"), "--model.prior", f"{module}.OwnPrior"])
    infer([*common, str(tmp_path / "b"), "-c", str(tmp_path / "own.yaml")])
    levels = []
    for name, hu in (("a", -500.0), ("b", -300.0)):
        record = json.loads(next((tmp_path / name).rglob("reconstruction.json")).read_text())
        code = own_code(import_module(module).OwnPrior)
        told = {"class": f"{module}.OwnPrior", "hu": hu} | code
        assert code and told.items() <= record["settings"]["prior"].items()
        levels.append(record["misfit"])
    assert levels[0] != levels[1]


@pytest.mark.parametrize("name", ["OwnPrior", "Underived"])
def test_an_ablation_compares_with_it(name, module, tmp_path):
    (tmp_path / "ablate.yaml").write_text(yaml.safe_dump({
        "out": str(tmp_path / "out"), "phantoms": 1,
        "axes": {"prior": [f"{module}.{name}"], "method": ["prior_only"], "views": [2], "detector": [32]}}))
    infer(["ablate", "-c", str(tmp_path / "ablate.yaml"), "--device", "cpu"])
    assert f"{module}.{name}" in (tmp_path / "out" / "results.csv").read_text()


@pytest.mark.filterwarnings("ignore:the prior was trained without text")
def test_it_need_not_derive_from_the_contract(module, xrays, tmp_path):
    infer(["predict", "--data.xrays", "data/example/xrays", "--model.method", "prior_only", "--model.out",
           str(tmp_path), "--model.prior", f"{module}.Underived"])
    record = json.loads(next(tmp_path.rglob("reconstruction.json")).read_text())
    assert {"class": f"{module}.Underived", "hu": -500.0}.items() <= record["settings"]["prior"].items()
    made = vars(import_module(module))
    tasks = [ReconstructionTask(METHODS["prior_only"], prior=prior, out=str(tmp_path / "python")) for prior in (
        made["Underived"](), made["Underived"](-300.0), made["Weighted"](), made["Weighted"](1.0))]
    settings = [task.settings["prior"] for task in tasks]
    assert settings[0] == record["settings"]["prior"] and settings[1]["hu"] == -300.0
    assert settings[2] | {"weights_crc32": settings[3]["weights_crc32"]} == settings[3] != settings[2]


def test_other_weights_are_another_prior_however_it_is_made(module, tmp_path):
    made = vars(import_module(module))
    for kind in (made["Weighted"], made["Derived"]):
        crcs = [own_identity(kind(weight), None)["weights_crc32"] for weight in (0.0, 1.0, 0.0)]
        assert crcs[0] == crcs[2] != crcs[1]


def test_what_keeps_no_contract_is_refused_in_one_sentence(module, xrays, tmp_path):
    for path, words in (("Unbound", "Unbound lacks bind: see phydict.prior.PriorContract"),
                        ("Absent", "cannot be imported: module own_.* has no Absent"),
                        ("Needy", "Needy cannot be made .*missing 1 required .*: its settings need defaults")):
        with pytest.raises(ValueError, match=words):
            find_prior(f"{module}.{path}")
    with pytest.raises(ValueError, match="dict lacks grid, window, state_channels, bind"):
        reconstructor("phydict_fast", {})
    with pytest.raises(ValueError, match=r"states like those it is given, \(1, 1, 16, 16, 16\)"):
        phydict.reconstruct(xrays["xrays"], xrays["beam"], f"{module}.Shapeless", display=xrays["display"])


@pytest.mark.parametrize("kind, denoiser, words", [
    ("Reportless", None, r"bind of the prior Reportless is called as \(report, guidance, precision\), but is "
                         r"written as \(report\)"),
    ("Nothing", None, r"bind of the prior Nothing must return a denoiser.* NoneType, lacks denoise, schedule"),
    ("Given", SimpleNamespace(denoise=lambda x, t: x), "bind of the prior Given .* lacks schedule:"),
    ("Given", SimpleNamespace(schedule=CosineSchedule()), "bind of the prior Given .* lacks denoise:"),
    ("Given", SimpleNamespace(denoise=lambda x, t: x, schedule=SimpleNamespace(scales=min, steps=min)),
     "lacks schedule.sigma, schedule.time:"),
    ("Given", SimpleNamespace(denoise=lambda x: x, schedule=CosineSchedule()), r"denoise of the prior Given .*, t\)"),
    ("Given", SimpleNamespace(denoise=lambda x, t: None, schedule=CosineSchedule()), "NoneType came: correct the")])
def test_what_bind_returns_is_refused_in_one_sentence_that_names_the_class(module, kind, denoiser, words):
    prior = vars(import_module(module))[kind]()
    prior.denoiser = denoiser
    with pytest.raises(ValueError, match=words):
        of_scene(prior)


def test_a_schedule_whose_time_is_of_another_is_warned_of(module):
    prior, made = find_prior(f"{module}.Given"), vars(import_module(module))
    prior.denoiser = made["Smooth"](-0.5, made["Timeless"]())
    with pytest.warns(UserWarning, match="the schedule of the prior Given contradicts itself: time"):
        of_scene(prior)


@pytest.mark.parametrize("wrong", [
    lambda x, x0, noise: (x - x0) / noise, lambda x, x0, noise: 1000 * x0, lambda x, x0, noise: (x0 + 1) / 2],
    ids=["noise", "HU", "shares"])
def test_a_denoiser_that_answers_by_something_else_than_the_clean_state_is_warned_of(module, wrong):
    prior, right = find_prior(f"{module}.Given"), vars(import_module(module))["Smooth"](-0.5)
    prior.denoiser = SimpleNamespace(schedule=right.schedule, denoise=lambda x, t: wrong(
        x, right.denoise(x, t), float(right.schedule.scales(t)[1])))
    with pytest.warns(UserWarning, match="denoise of the prior Given makes .* of a state of air.*not the noise, HU or"):
        of_scene(prior)
    prior.denoiser = right
    of_scene(prior)  # without a word: warnings are errors


def test_a_method_that_needs_a_refiner_names_one_that_takes_a_prior_of_ones_own(module):
    with pytest.raises(ValueError, match="phydict_learned needs a refiner, its file or object, but OwnPrior, a prior "
                                         "of your own, was given: give it to phydict_fast"):
        reconstructor("phydict_learned", f"{module}.OwnPrior")


def of_scene(prior):
    return reconstructor("prior_only", prior).reconstruct(views(), PROJECTOR)


def test_a_network_of_ones_own_is_asked_in_evaluation_and_told_by_its_own_settings_and_precision(module):
    made = vars(import_module(module))
    prior = made["Dropping"]()
    told, result = own_identity(prior, prior), of_scene(prior)
    assert not prior.was_training and result.precision == "float32"
    assert not {"training", "_is_full_backward_hook"} & set(told) and told["hu"] == -500.0
    assert {of_scene(made[name]()).precision for name in ("OwnPrior", "Underived", "Derived")} == {"own"}
    assert own_identity(prior, prior) == told | {"was_training": False}
    assert of_scene(tiny_prior()).precision in ("float32", "bfloat16")


def test_the_example_that_predicts_noise_has_the_schedule_of_ddpm_and_the_denoiser_of_its_network(monkeypatch):
    monkeypatch.syspath_prepend(Path("data/example/own_prior"))
    prior = find_prior("noise_prior.NoisePrior")
    denoiser, times = prior.bind("", 1.0, "auto"), torch.arange(1, 1001, dtype=torch.float64) / 1000
    exact = (1 - torch.linspace(1e-4, 0.02, 1000, dtype=torch.float64)).cumprod(0)
    schedule = denoiser.schedule
    assert ((schedule.alpha_bar(times).log() - exact.log()).abs() < 0.01 + 0.01 * exact.log().abs()).all()
    for t in (0.02, 0.3, 1.0):
        assert schedule.time(float(schedule.sigma(t))) == pytest.approx(t)
    x0, noise = torch.rand(2, 1, 4, 4, 4) - 0.5, torch.randn(2, 1, 4, 4, 4)
    signal, sigma = (float(weight) for weight in schedule.scales(0.4))
    knows = type(denoiser)(lambda x, steps: noise if (steps == 400).all() else None)
    torch.testing.assert_close(knows.denoise(signal * x0 + sigma * noise, 0.4), x0, atol=1e-4, rtol=0)
    reconstructed = phydict.reconstruct(**{name: phydict.load_xrays("data/example/xrays")[name]
                                           for name in ("xrays", "beam")}, prior=prior, method="prior_only")
    assert reconstructed.volume.shape == (32, 32, 32)


def test_an_empty_file_is_not_taken_for_no_prior(tmp_path, capsys):
    (tmp_path / "pytorch_model.bin").write_bytes(b"")
    for given in (["--model.prior", str(tmp_path / "pytorch_model.bin")],
                  [f"--model.prior={tmp_path / 'pytorch_model.bin'}"]):
        assert "is empty" in refusal(capsys, infer, ["predict", "--data.xrays", "data/example/xrays", "--model.out",
                                                     str(tmp_path / "out"), *given])
    assert not (tmp_path / "out").exists()


def test_what_identifies_a_prior_of_ones_own_names_its_voxels_and_its_hu(module):
    made = import_module(module).OwnPrior()
    before = made.identity()
    type(made).grid = phydict.Grid.cube(32)
    assert made.identity() != before
    type(made).grid, made.window = phydict.Grid.cube(16), phydict.HUWindow(-1024, 2000)
    assert made.identity() != before and json.dumps(made.identity())


def test_reading_a_network_leaves_the_random_numbers_of_others_alone():
    state = torch.get_rng_state()
    phydict.load_prior().load_text()
    assert torch.equal(torch.get_rng_state(), state)
