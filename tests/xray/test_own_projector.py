"""Projectors of a user's own: given by their class, they take phydict's place on all voxels."""

from __future__ import annotations

import importlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from inference.runs import phantoms, record
from laws import assert_adjoint, assert_gradient_is_adjoint, assert_linear
from prior.tiny import tiny_prior

from phydict.baselines import CGLS, SIRT, Region
from phydict.cli.infer import main
from phydict.datasets import Thorax, build
from phydict.grid import Grid
from phydict.inference.record import method_settings
from phydict.inference.settings import Sampling
from phydict.methods import METHODS, reconstruct, reconstruct_by, reconstructor
from phydict.posterior import DDS
from phydict.units import hu_to_mu
from phydict.xray import ConeBeam, Projector
from phydict.xray.projectors.own import projector_kind

GRID = Grid.cube(12, 360.0)
BEAM = ConeBeam.orbit(3, 1020.0, 740.0, (10, 14), 40.0)
FAST = replace(METHODS["phydict_fast"], iterations=2)
OWN = '''from phydict.xray import Projector


class Own:
    made = []

    def __init__(self, grid, beam):
        self.A = Projector(grid, beam, "joseph", full_detector=True)
        self.made.append(grid.shape)

    def __call__(self, mu):
        return self.A(mu)

    def T(self, xrays):
        return self.A.T(xrays)
'''


@pytest.fixture
def module(tmp_path, monkeypatch):
    """Writes a module of a name that no test has had, and imports it."""
    monkeypatch.syspath_prepend(tmp_path)

    def write(code: str):
        name = f"own_{abs(hash((code, str(tmp_path))))}"
        (tmp_path / f"{name}.py").write_text(code)
        importlib.invalidate_caches()
        return importlib.import_module(name)

    return write


def of_thorax(grid: Grid, beam: ConeBeam) -> torch.Tensor:
    return Projector(grid, beam, "joseph", full_detector=True)(
        hu_to_mu(torch.from_numpy(build(Thorax.standard(), grid)[0]))[None, None])[0]


@pytest.mark.parametrize("continued", [None, True])
def test_it_keeps_the_laws_and_projects_what_it_wraps(module, continued):
    beam = BEAM.with_continued(continued)
    A = Projector(GRID, beam, module(OWN).Own)
    wrapped = Projector(GRID, beam, "joseph")
    x = torch.rand(2, 1, *GRID.shape, generator=torch.Generator().manual_seed(1))
    assert torch.equal(A(x), wrapped(x)) and A.norm() == pytest.approx(wrapped.norm(), rel=1e-5)
    for law in (assert_adjoint, assert_gradient_is_adjoint):
        law(A, A.T, (1, 1, *GRID.shape))
    assert_linear(A, (1, 1, *GRID.shape))


@pytest.mark.filterwarnings("ignore")  # of few iterations and views
@pytest.mark.parametrize("method, grid", [(SIRT(10), Grid.cube(24)), (FAST, None), (FAST, Grid.cube(24)),
                                          (DDS(3), None)])
def test_methods_use_it_on_every_grid_of_theirs_and_give_what_the_wrapped_one_gives(module, method, grid):
    kind, beam, prior = module(OWN).Own, BEAM.with_continued(False), tiny_prior(False)
    xrays = of_thorax(Grid.cube(24), beam)
    own, wrapped = (reconstruct(xrays, beam, None if isinstance(method, SIRT) else prior, method, grid=grid,
                                projector=projector) for projector in (kind, "joseph"))
    assert torch.equal(own.volume, wrapped.volume) and own.misfit == wrapped.misfit
    assert {(grid or prior.grid).shape} | (set() if isinstance(method, SIRT) else {prior.grid.shape}) <= {*kind.made}


def test_a_box_in_the_patient_and_what_lies_around_are_both_its_own(module):
    kind = module(OWN).Own
    xrays, box = of_thorax(GRID, BEAM), Region(CGLS(3), Grid.box(8, 120.0), GRID)
    own, wrapped = (reconstruct_by(box, box.target, xrays, BEAM.with_continued(False), projector=projector)
                    for projector in (kind, "joseph"))
    assert torch.equal(own.volume, wrapped.volume)
    assert {GRID.shape, (8, 8, 8)} <= {*kind.made}


def test_its_results_are_converted_to_the_type_that_was_given(module):
    kind = module(OWN.replace("return self.A(mu)", "return self.A(mu.double())")).Own
    x = torch.rand(1, 1, *GRID.shape)
    assert Projector(GRID, BEAM, kind)(x).dtype == torch.float32


@pytest.mark.parametrize("old, new, sentence", [
    ("return self.A(mu)", "return self.A(mu)[:, :2]",
     r"A\(mu\) of the projector Own .*\(1, 3, 10, 14\), but gave \(1, 2"),
    ("return self.A(mu)", "return self.A(mu).numpy()", r"A\(mu\) of the projector Own .* but gave ndarray"),
    ("return self.A.T(xrays)", "return self.A.T(xrays)[0]", r"A.T\(xrays\) of the projector Own must be a tensor"),
    ("return self.A(mu)", "return self.A(mu) / 0", "the projector Own gives numbers that are not finite"),
    ("def T", "def adjoint", r"the projector Own needs __call__\(mu\) and T\(xrays\)"),
    ("def __init__(self, grid, beam)", "def __init__(self, grid)", "projector Own cannot be made .* .TypeError"),
    ("self.made.append(grid.shape)", "1 / 0", "projector Own cannot be made .* .ZeroDivision")])
def test_one_that_gives_something_else_is_refused_by_its_name(module, old, new, sentence):
    assert OWN.count(old) == 1
    with pytest.raises(ValueError, match=sentence):
        Projector(GRID, BEAM, module(OWN.replace(old, new)).Own)


SCENES = {"few": (GRID, BEAM), "fine": (Grid.cube(64), ConeBeam.orbit(4, 1020.0, 740.0, (56, 56), 8.0)),
          "tilted": (Grid.cube(24, 360.0), ConeBeam.orbit(3, 1020.0, 740.0, (40, 40), 12.0).tilted(7.0)),
          "long": (Grid((16, 20, 12), (20.0, 16.0, 25.0)), ConeBeam.orbit(3, 1020.0, 740.0, (40, 40), 12.0)),
          "box": (Grid.box(16, 60.0, (40.0, 30.0, -20.0)), ConeBeam.orbit(4, 1020.0, 740.0, (112, 112), 4.0)),
          "beside": (Grid.box(8, 60.0, (0.0, 0.0, 190.0)), ConeBeam.orbit(2, 1020.0, 740.0, (24, 40), 4.0))}


@pytest.mark.parametrize("transpose", ["1.01 * self.A.T(xrays)", "self.A.T(xrays).flip(2)", "self.A.T(xrays).flip(4)",
                                       "self.A.T(xrays.flip(1))", "self.A.T(xrays.flip(3))"])
def test_a_transpose_that_is_not_the_adjoint_is_warned_of(module, transpose):
    kind = module(OWN.replace("return self.A.T(xrays)", f"return {transpose}")).Own
    with pytest.warns(UserWarning, match="T of the projector Own is not the adjoint of A"):
        Projector(*SCENES["fine"], kind, full_detector=True)


def changed(module, volume: str = "", views: str = "") -> type:
    """A projector of volumes and of views that are changed before and afterwards, with the exact adjoint."""
    code = OWN.replace("self.A(mu)", f"self.A(mu{volume}){views}")
    return module(code.replace("self.A.T(xrays)", f"self.A.T(xrays{views}){volume}")).Own


@pytest.mark.parametrize("volume, views, words", [
    ("", " / 10", "Own is 0.1 of what phydict's projector gives for a test body: attenuation is in 1/mm"),
    ("", " * 0", "Own is 0 of what"), (".flip(2)", "", "Own shows a test body elsewhere"),
    (".flip(3)", "", "shows a test body elsewhere"), (".flip(4)", "", "shows a test body elsewhere"),
    (".transpose(2, 3)", "", "shows a test body elsewhere"), (".transpose(3, 4)", "", "shows a test body elsewhere"),
    ("", ".flip(1)", "shows a test body elsewhere"), ("", ".flip(2)", "shows a test body elsewhere"),
    ("", ".flip(3)", r"elsewhere .* most in view \d \(counted from 0\): check that no axis is flipped")])
def test_other_units_and_other_axes_are_warned_of(module, volume, views, words):
    with pytest.warns(UserWarning, match=words) as warned:
        Projector(GRID, BEAM, changed(module, volume, views))
    assert len(warned) == 1


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize("method", ["separable", "siddon", "eq4", "joseph"])
def test_other_models_of_the_rays_are_not_warned_of(module, method, scene):
    if method != "separable" or scene != "tilted":
        grid, beam = SCENES[scene]
        Projector(grid, beam.with_continued(False), module(OWN.replace("joseph", method)).Own, full_detector=True)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("scene", ["few", "fine", "tilted"])
def test_a_detector_that_blurs_is_not_warned_of(module, scene):
    code = OWN.replace("import Projector", "import Projector\nfrom torch import full\nfrom torch.nn.functional import "
                       "conv3d").replace("class", """def blur(views):
    return conv3d(views[:, None], full((1, 1, 1, 3, 3), 1 / 9).to(views), padding=(0, 1, 1))[:, 0]


class""").replace("self.A(mu)", "blur(self.A(mu))").replace("self.A.T(xrays)", "self.A.T(blur(xrays))")
    Projector(*SCENES[scene], module(code).Own, full_detector=True)


def test_what_is_no_projector_is_refused_in_one_sentence(module):
    name = module(OWN + "\n\nnumber = 3\n").__name__
    for given, sentence in (("fastest", "there is no projector 'fastest'"), ("no_such.Module", "cannot be imported"),
                            (f"{name}.Missing", "cannot be imported"), (f"{name}.number", "is no class"),
                            (3, "an object of int was given")):
        with pytest.raises(ValueError, match=sentence):
            projector_kind(given)


def test_its_edited_code_is_another_setting(module):
    first, second = (module(code).Own for code in (OWN, OWN + "# edited\n"))
    settings = [method_settings("tv", 0, reconstructor("tv"), kind, Sampling())["projector"]
                for kind in (first, second)]
    assert settings[0]["code_crc32"] != settings[1]["code_crc32"] and settings[0]["class"].endswith(".Own")
    assert method_settings("tv", 0, reconstructor("tv"), "siddon", Sampling())["projector"] == "siddon"


def test_the_command_line_takes_its_path_and_records_it(module, tmp_path):
    own = module(OWN)
    main(phantoms(tmp_path / "own", 1, f"--model.projector={own.__name__}.Own"))
    main(phantoms(tmp_path / "joseph", 1, "--model.projector=joseph"))
    [mine], [theirs] = ([*(tmp_path / name / "sirt").glob("*/reconstruction.json")] for name in ("own", "joseph"))
    assert record(mine.parent)["settings"]["projector"]["class"] == f"{own.__name__}.Own"
    assert record(mine.parent)["scores"] == record(theirs.parent)["scores"]


def test_the_example_is_its_own_adjoint_and_projects_a_box_of_water_as_phydict_does(monkeypatch):
    monkeypatch.syspath_prepend(Path(__file__).parents[2] / "data" / "example" / "own_projector")
    kind = projector_kind("my_projector.MyProjector")
    grid = Grid.cube(16, 360.0)
    A, exact = Projector(grid, BEAM, kind), Projector(grid, BEAM, "eq4")
    assert_adjoint(A, A.T, (1, 1, *grid.shape))
    mu = torch.zeros(1, 1, *grid.shape)
    mu[..., 4:12, 5:11, 3:13] = 0.02
    projected, wanted = A(mu), exact(mu)
    assert float((projected - wanted).norm() / wanted.norm()) < 0.02
    assert np.isfinite(projected.numpy()).all() and projected.max() > 2
