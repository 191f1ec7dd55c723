"""Laws of what a reconstruction reports."""

import json
import math
import re
import sys
from dataclasses import dataclass, field
from importlib import import_module, invalidate_caches
from pathlib import Path

import pytest
import torch
from command_lines import refusal
from posterior.scene import BEAM, GRID, views

from phydict.ablation.trials import method_of
from phydict.cli.infer import main as infer
from phydict.guard import BAD_GUESS
from phydict.methods import METHODS, reconstruct
from phydict.posterior import Refinement
from phydict.reconstruction import describe
from phydict.runtime.own_code import imported
from phydict.xray import Ideal, Polychromatic
from phydict.xray.residuals import misfits, shared_norms

Y = torch.rand(3, 5, 4, generator=torch.Generator().manual_seed(0)) + 0.1


def test_misfit_is_zero_for_the_truth_one_for_nothing_and_proportional_between():
    assert misfits(Y, Y) == {"misfit": 0, "misfit_per_view": [0, 0, 0]}
    assert misfits(0 * Y, Y)["misfit"] == pytest.approx(1)
    assert misfits(1.1 * Y, Y)["misfit"] == pytest.approx(0.1, rel=1e-4)


def test_misfits_of_views_combine_to_the_whole():
    scaled = Y * torch.tensor([1.0, 1.3, 0.9])[:, None, None]
    said = misfits(Y, scaled)
    assert said["misfit_per_view"] == pytest.approx([0, 0.3 / 1.3, 0.1 / 0.9], abs=1e-6, rel=1e-4)
    sizes = scaled.flatten(1).norm(dim=1)
    residuals = torch.tensor(said["misfit_per_view"]) * sizes
    assert said["misfit"] == pytest.approx(float(residuals.norm() / sizes.norm()), rel=1e-5)


def test_what_neighbours_share_is_all_of_smooth_views_and_nothing_of_noise():
    smooth = torch.ones(2, 60, 50).cumsum(1) * torch.tensor([1.0, 3.0])[:, None, None]
    noise = torch.randn(2, 60, 50, generator=torch.Generator().manual_seed(0)) * smooth.mean()
    assert shared_norms(smooth) == pytest.approx(smooth.flatten(1).norm(dim=1), rel=0.02)
    assert (shared_norms(noise) < 0.15 * noise.flatten(1).norm(dim=1)).all()
    assert shared_norms(smooth + noise) == pytest.approx(shared_norms(smooth), rel=0.05)


def test_settings_of_any_kind_are_plain_json():
    @dataclass(frozen=True)
    class Mine:
        weights: Path = Path("a.safetensors")
        levels: tuple = (1, (Path("b"), 2.0))
        named: dict = field(default_factory=lambda: {"c": Path("d")})

    told = json.loads(json.dumps(describe(Mine())))
    assert told.pop("class").endswith(".Mine") and told.pop("code_crc32") and told == {
        "weights": "a.safetensors", "levels": [1, ["b", 2.0]], "named": {"c": "d"}}


def test_numbers_that_json_cannot_say_are_told_apart():
    @dataclass(frozen=True)
    class Mine:
        cap: float | None

    told = {json.dumps(describe(Mine(cap)), allow_nan=False) for cap in (math.inf, -math.inf, math.nan, None)}
    assert len(told) == 4


def test_shipped_settings_are_told_by_the_name_of_their_class_and_their_fields_alone():
    for settings in (*METHODS.values(), Refinement(), Ideal(), Polychromatic()):
        told = describe(settings)
        assert told["class"] == type(settings).__name__ and "code_crc32" not in json.dumps(told)


NOT_DATACLASSES = """
from phydict.baselines import Baseline
from phydict.posterior import Sampler

class Method(Baseline):
    def __init__(self, scale: float = 1.0):
        self.scale = scale

    def steps(self):
        return 1

    def solve(self, A, y, on_step):
        return A.T(y)

class Drawn(Sampler):
    def steps(self):
        return 1

    def sample(self, denoiser, measurement, x, generator, on_step=lambda: None):
        return x
"""
BACKPROJECTION = """
from dataclasses import dataclass
from phydict.baselines import Baseline
from phydict.units import MU_WATER

@dataclass(frozen=True)
class Method(Baseline):
    scale: float = 1.0
    mu_water: float = MU_WATER
    name: str = "mine"

    def steps(self):
        return 1

    def solve(self, A, y, on_step):
        on_step()
        return self.scale * A.T(y)
"""
PREDICT = ["predict", "--data.xrays", "data/example/xrays", "--model.grid=16", "--trainer.accelerator=cpu"]


@pytest.fixture
def written(tmp_path, monkeypatch):
    """Writes a module of a name that no test has had."""
    monkeypatch.syspath_prepend(tmp_path)

    def write(code: str) -> str:
        name = f"own_{abs(hash((code, str(tmp_path))))}"
        (tmp_path / f"{name}.py").write_text(code)
        invalidate_caches()
        return name

    return write


@pytest.mark.parametrize("kind", ["Method", "Drawn"])
def test_a_class_that_is_no_dataclass_is_told_to_become_one(kind, written, tmp_path, capsys):
    module, words = written(NOT_DATACLASSES), rf"{kind} is no dataclass, .*: put @dataclass\(frozen=True\) above"
    assert re.search(words, refusal(capsys, infer, [*PREDICT, f"--model.out={tmp_path / 'out'}",
                                                    f"--model.method={module}.{kind}"]))
    for wrong in (lambda: describe(getattr(import_module(module), kind)()), lambda: imported(f"{module}.{kind}"),
                  lambda: method_of(f"{module}.{kind}")):
        with pytest.raises(ValueError, match=words):
            wrong()


def test_a_fault_of_own_code_does_not_advise_to_run_the_same_again(written, tmp_path):
    module = written(BACKPROJECTION.replace("return self.scale * A.T(y)", "raise KeyError('mask')"))
    with pytest.raises(KeyError) as raised:
        infer([*PREDICT, f"--model.out={tmp_path / 'out'}", f"--model.method={module}.Method"])
    assert not any("same command" in note for note in getattr(raised.value, "__notes__", ()))


def test_a_network_that_never_projects_is_doubted_where_it_explains_nothing(written):
    kind = import_module(written(BACKPROJECTION)).Method
    found = reconstruct(views(), BEAM, method=kind(), grid=GRID)
    assert found.misfit > 10 and "no volume was found that explains the X-rays" in "".join(found.warnings)
    scale = (found.reprojection * found.xrays).sum() / found.reprojection.square().sum()
    fitting = reconstruct(views(), BEAM, method=kind(float(scale)), grid=GRID)
    assert fitting.misfit < BAD_GUESS and "no volume" not in "".join(fitting.warnings)


def test_a_network_in_half_precision_that_optimises_gives_what_one_in_single_does(written):
    optimised = """with torch.enable_grad():
            density = torch.zeros(1, 1, *A.grid.shape, requires_grad=True)
            optimiser = torch.optim.SGD([density], 1e-5)
            (A(density) - y).square().sum().backward()
            optimiser.step()
            on_step()
        return density"""
    code = "import torch\n" + BACKPROJECTION.replace("on_step()\n        return self.scale * A.T(y)", optimised)
    single = reconstruct(views(), BEAM, method=import_module(written(code)).Method(), grid=GRID)
    code = code.replace("return density", "return density.bfloat16()")
    half = reconstruct(views(), BEAM, method=import_module(written(code)).Method(), grid=GRID)
    assert half.volume.dtype == torch.float32 and not half.volume.requires_grad
    torch.testing.assert_close(half.volume, single.volume, rtol=0, atol=float(single.volume.abs().max()) / 100)


RETURNING = """
from dataclasses import dataclass, replace
from phydict.baselines import CGLS
from phydict.reconstruction import Reconstructor

@dataclass(frozen=True)
class Whole(Reconstructor):
    def steps(self):
        return 1

    def reconstruct(self, xrays, projector, *arguments, **named):
        found = CGLS(iterations=1).reconstruct(xrays, projector)
        return {}
"""


@pytest.mark.parametrize("code, came", [
    ("None", "a Reconstruction, but NoneType came back"), ("found.volume", "a Reconstruction, but Tensor came back"),
    ("replace(found, volume=found.volume[1:])", r"the grid's shape \(16, 16, 16\), but \(15, 16, 16\) came back"),
    ("replace(found, volume=found.volume.numpy())", "a tensor in HU, but ndarray came back")])
def test_a_method_that_returns_no_reconstruction_is_told_what_to_return(code, came, written):
    method = import_module(written(RETURNING.format(code))).Whole()
    with pytest.raises(ValueError, match=f"reconstruct of the method Whole must return .*{came}"):
        reconstruct(views(), BEAM, method=method, grid=GRID)


@pytest.mark.parametrize("value", ["nan", "inf"])
def test_a_method_that_returns_what_is_not_finite_gives_no_volume(value, written):
    spoilt = f"replace(found, volume=found.volume.index_fill(0, torch.tensor([3]), float('{value}')))"
    method = import_module(written("import torch\n" + RETURNING.format(spoilt))).Whole()
    with pytest.raises(FloatingPointError, match="Whole must .* 256 of its 4096 voxels are NaN or infinite"):
        reconstruct(views(), BEAM, method=method, grid=GRID)


@pytest.mark.parametrize("code, came", [
    ("None", "NoneType"), ("A.T(y)[0]", r"\(1, 16, 16, 16\)"),
    ("A.T(y).repeat(2, 1, 1, 1, 1)", r"\(2, 1, 16, 16, 16\)")])
def test_a_baseline_that_solves_for_no_single_density_is_told_its_shape(code, came, written):
    method = import_module(written(BACKPROJECTION.replace("self.scale * A.T(y)", code))).Method()
    with pytest.raises(ValueError, match=rf"solve of the method Method must return .*, but {came} came back"):
        reconstruct(views(), BEAM, method=method, grid=GRID)


@pytest.mark.parametrize("code, path, words", [
    ("", "nowhere.Mine", "there is no module nowhere: put its folder on PYTHONPATH"),
    ("", "json.nowhere.Mine", "there is no module json.nowhere$"),
    ("import not_there", "{}.Mine", "module own_.* needs not_there, which is not installed$"),
    ("number = undefined_thing", "{}.Mine", "module own_.* ends in NameError: name 'undefined_thing' is not defined$"),
    ("number = 3", "{}.Mine", "module own_.* has no Mine$")])
def test_why_a_class_cannot_be_imported_is_said_of_each_setting_that_takes_one(code, path, words, written, tmp_path,
                                                                                capsys):
    path = path.format(written(code))
    with pytest.raises(ValueError, match=words):
        imported(path)
    for setting in ("method", "prior", "projector"):
        more = ["--model.method=phydict_fast"] if setting == "prior" else []
        said = refusal(capsys, infer, [*PREDICT, f"--model.out={tmp_path / 'out'}", f"--model.{setting}={path}", *more])
        assert re.search(rf"{path} cannot be imported: {words}", said.strip())


BASE = """
class Base:
    steps = 1
"""
OWN = """
from dataclasses import dataclass
from own_base import Base

@dataclass(frozen=True)
class Mine(Base):
    weight: float = 1.0
"""


def test_an_own_class_is_told_by_its_place_and_by_the_code_of_it_and_of_its_bases(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)

    def told(base: str = BASE, own: str = OWN, module: str = "own_a") -> dict:
        for name, text in (("own_base", base), (module, own)):
            (tmp_path / f"{name}.py").write_text(text)
            monkeypatch.delitem(sys.modules, name, raising=False)
        return describe(import_module(module).Mine())

    first = told()
    assert first == told() and first["class"] == "own_a.Mine" and first["weight"] == 1.0
    others = [told(base=BASE + "    more = 2\n"), told(own=OWN + "    def solve(self): ...\n"), told(module="own_b")]
    assert all(other != first for other in others) and others[2]["class"] == "own_b.Mine"


def test_of_a_script_the_lines_of_the_class_count_and_without_lines_its_place(tmp_path, monkeypatch):
    script = tmp_path / "script.py"

    def told(text: str) -> dict:
        script.write_text(text)
        monkeypatch.setattr(sys.modules["__main__"], "__file__", str(script), raising=False)
        scope = {"__name__": "__main__"}
        exec(compile(text, script, "exec"), scope)
        return describe(scope["Mine"]())

    own = OWN.replace("(Base)", "").replace("from own_base import Base", "")
    first = told(own)
    assert first["class"] == "__main__.Mine" and first == told(own + "print\n") != told(own + "    more = 2\n")
    monkeypatch.delattr(sys.modules["__main__"], "__file__")
    scope = {"__name__": "__main__"}
    exec(own, scope)
    assert describe(scope["Mine"]()) == {"class": "__main__.Mine", "weight": 1.0}
