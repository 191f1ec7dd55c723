"""Patients who are larger than the volume."""

import warnings
from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from fitting import fit_to_grid
from prior.tiny import tiny_refiner
from torch.nn.functional import avg_pool3d, pad

from phydict import ConeBeam, Projector, reconstruct
from phydict.baselines import CGLS, FISTATV, Region
from phydict.baselines.extended import Extended, covering, extended
from phydict.datasets import phantom_case
from phydict.evaluation import volume_metrics
from phydict.grid import Grid
from phydict.methods import onto_grid, reconstructor
from phydict.posterior import Posterior, Refined, SplitGibbs, Unrolled
from phydict.reconstruction import Reconstruction
from phydict.runtime.warning import Remark
from phydict.units import HUWindow
from phydict.xray import Ideal
from phydict.xray.boxes import binned_to, covers, lacking
from phydict.xray.carried import Carried

TV = FISTATV(iterations=30)
CHEST, WIDE, WINDOW = Grid.cube(64), Grid.box([80, 80, 64], [480.0, 480.0, 384.0]), HUWindow()
HALF = Grid.cube(32)
ORBIT = replace(ConeBeam.orbit(6, 1300, 800, (112, 112), 6.4, start=0.1), continued=False)


@pytest.fixture(scope="module")
def patients() -> dict[str, torch.Tensor]:
    """A phantom of 384 mm with air beside it, and with arms."""
    alone = pad(phantom_case(3, CHEST, WINDOW)["volume"][None], (0, 0, 8, 8, 8, 8), value=-1.0)
    x, y = torch.meshgrid(torch.arange(80) - 39.5, torch.arange(80) - 39.5, indexing="ij")
    arms = (((x.abs() - 36) / 3.5) ** 2 + (y / 6) ** 2 < 1)[..., None].expand(80, 80, 64)
    return {"alone": alone, "with arms": torch.where(arms, WINDOW.to_range(torch.tensor(40.0)), alone)}


def xrays_of(volume: torch.Tensor, beam: ConeBeam = ORBIT) -> torch.Tensor:
    return Ideal()(Projector(WIDE, beam, full_detector=True), WINDOW.to_mu(volume), 0)[0]


def inside(volume: torch.Tensor, grid: Grid = CHEST) -> torch.Tensor:
    return WINDOW.to_hu(avg_pool3d(volume[..., 8:72, 8:72, :], CHEST.shape[0] // grid.shape[0]).contiguous())


@pytest.fixture(scope="module")
def chests(patients) -> Callable[[object, Grid], Reconstruction]:
    """Of a method and voxels, what it finds of the patient with arms, once."""
    @cache
    def found(method: object, grid: Grid) -> Reconstruction:
        with pytest.warns(Remark, match="something stands beside the volume"):
            return reconstruct(xrays_of(patients["with arms"]), ORBIT, method=method, grid=grid)
    return found


@pytest.mark.filterwarnings("ignore:no volume explains")
@pytest.mark.parametrize("method, voxels", [pytest.param("phydict_learned", CHEST, marks=pytest.mark.slow), (TV, HALF)])
def test_what_stands_beside_the_volume_does_not_spoil_it(patients, chests, method, voxels, monkeypatch):
    y, truth = xrays_of(patients["with arms"]), inside(patients["with arms"], voxels)
    found = chests(method, voxels)
    monkeypatch.setattr("phydict.methods.extended", lambda method, grid, xrays, beam, display: (method, grid, beam))
    spoilt = reconstruct(y, ORBIT, method=method, grid=voxels)
    scores = [volume_metrics(each.volume[None, None], truth)["psnr"] for each in (found, spoilt)]
    assert scores[0] > scores[1] + 2
    torch.testing.assert_close(found.xrays, spoilt.xrays)
    assert found.misfit == pytest.approx(float((found.reprojection - found.xrays).norm() / found.xrays.norm()),
                                         rel=1e-4)
    assert found.misfit < spoilt.misfit and found.method == spoilt.method


@pytest.mark.filterwarnings("ignore:the X-rays show that something")
def test_what_is_tried_to_see_what_stands_beside_the_volume_makes_no_result_doubtful(patients):
    dense = torch.where(patients["with arms"] != patients["alone"], 1.0, patients["alone"])
    found = reconstruct(xrays_of(dense), ORBIT, method=CGLS(8), grid=HALF)
    assert found.extended_mm == (48, 48, 0) and found.misfit < 0.03 and not found.warnings


def test_nothing_is_sought_where_nothing_stands_or_can_be_told(patients):
    method = reconstructor("tv")
    for beam, patient, display in (
            (ORBIT, "alone", False), (ORBIT.select([0, 1, 2]), "with arms", False), (ORBIT, "with arms", True)):
        assert extended(method, CHEST, xrays_of(patients[patient], beam), beam, display) == (method, CHEST, beam)
    with pytest.warns(Remark, match="48 mm more are reconstructed at each side"):
        found, whole, _ = extended(method, CHEST, xrays_of(patients["with arms"]), ORBIT, False)
    assert whole.same_as(WIDE) and found == Extended(method, whole, CHEST, (48.0, 48.0, 0.0))
    narrow = replace(ConeBeam.orbit(6, 1020, 740, (112, 112), 5.0), continued=False)
    assert not narrow.has_room_for(WIDE)
    y = Ideal()(Projector(CHEST, narrow, full_detector=True), WINDOW.to_mu(patients["alone"][..., 8:72, 8:72, :]), 0)[0]
    assert extended(method, CHEST, y, narrow, False) == (method, CHEST, narrow)


def test_voxels_that_lie_get_no_more_at_their_sides(patients):
    lying = Grid(CHEST.shape, affine=CHEST.affine[:, [0, 2, 1, 3]])
    with warnings.catch_warnings():
        warnings.simplefilter("error", Remark)
        assert extended(reconstructor("tv"), lying, xrays_of(patients["with arms"]), ORBIT, False)[1] == lying


@pytest.mark.filterwarnings("ignore:the X-rays show that the patient")
@pytest.mark.parametrize("continued", [None, True])
def test_no_more_is_reconstructed_than_source_and_detectors_leave_room_for(patients, continued):
    beam = replace(ConeBeam.orbit(4, 1020, 740, (56, 56), 10.0).tilted(30), continued=continued)
    assert beam.has_room_for(CHEST) and not beam.has_room_for(CHEST.grown(0, 0, 8))
    y = Projector(CHEST, beam, full_detector=True)(WINDOW.to_mu(patients["alone"][..., 8:72, 8:72, :].contiguous()))[0]
    found, half = (reconstruct(values, beam, method=CGLS(8), grid=CHEST) for values in (y, y.half()))
    assert found.extended_mm[2] < 48 and found.misfit < 0.1
    assert (half.volume - found.volume).square().mean().sqrt() < 5


@pytest.mark.filterwarnings("ignore:the X-rays show that something")
def test_a_method_bound_to_its_voxels_is_left_as_it_is(patients):
    y, learned = xrays_of(patients["with arms"]), reconstructor("phydict_learned")
    wider, whole, _ = extended(learned, CHEST, y, ORBIT, False)
    assert whole.same_as(WIDE) and wider.base.grid.same_as(WIDE) and wider.kept is CHEST

    class Bound:
        """A prior that says of no other shape that it takes it."""

        grid, window, state_channels = CHEST, WINDOW, 4

    bound = Posterior(Bound(), SplitGibbs())
    assert extended(bound, CHEST, y, ORBIT, False)[:2] == (bound, CHEST)
    assert learned.with_room(1, 0, 0) is None and learned.with_room(0, 0, 4).grid.shape == (64, 64, 72)


@pytest.mark.filterwarnings("ignore:the X-rays show that something", "ignore:no volume explains")
def test_the_result_is_cut_out_of_what_more_voxels_give(patients):
    xrays, method = xrays_of(patients["with arms"]), reconstructor(Unrolled(), tiny_refiner(uncertain=True))
    ready, grid, beam = extended(method, method.grid, xrays, ORBIT, False)
    found = reconstruct(xrays, ORBIT, method=method)
    whole = ready.base.reconstruct(*binned_to(grid, xrays, beam, False))
    for part, of in ((found.volume, whole.volume), (found.masks, whole.masks), *zip(
            found.intervals.values(), whole.intervals.values())):
        assert torch.equal(part, of[..., 4:20, 4:20, :])
    assert found.grid.same_as(method.grid) and found.extended_mm == (96, 96, 0) and found.misfit == whole.misfit
    assert found.intervals and ready.steps() == ready.base.steps()


def test_metal_outside_of_the_volume_that_is_kept_is_said_to_be_outside():
    class Found:
        """A method that finds metal at one place."""

        name, mu_water = "found", 0.02

        def __init__(self, place: tuple[float, float, float]):
            self.carried = Carried(torch.ones(2, 2, 2), Grid.box(2, 12.0, place))

        def reconstruct(self, *_):
            none = torch.zeros(1, 2, 2)
            return Reconstruction(torch.zeros(WIDE.shape), WIDE, "found", 0, 0.0, [0.0], {}, none, none,
                                  carried=self.carried)

    def said(*place: float) -> list:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            Extended(Found(place), WIDE, CHEST, (48.0, 48.0, 0.0)).reconstruct(None, None)
        return caught

    assert not said(180.0, 0.0, 0.0)
    assert "lies outside the volume that is kept" in str(said(-218.0, 133.0, -33.0)[0].message)


@pytest.mark.parametrize("box", [Grid.cube(256, 409.6), Grid.box([40, 90, 64], [380.0, 400.0, 384.0]),
                                 Grid.box(16, 96.0, (0.0, 0.0, -170.0)), Grid.box([72, 64, 65], [432.0, 384.0, 390.0])])
@pytest.mark.parametrize("target", [None, Grid.cube(128), Grid.cube(100)])
def test_a_method_takes_as_many_voxels_as_hold_a_box_and_no_more(box, target):
    method = onto_grid(reconstructor("phydict_learned"), target)
    held = covering(method, box)
    own, more = method.survey or method.grid, held.survey or held.grid
    assert covers(more, box) and covers(held.grid, more)
    assert all(n == 0 or n - 4 < lacks for n, lacks in zip(
        np.subtract(more.shape, own.shape) // 2, lacking(own, box)))
    assert covering(method, CHEST) is method and covering(TV, box) is TV


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:no volume explains", "ignore:no network has learnt")
def test_a_volume_wider_than_the_priors_holds_what_stands_there(patients):
    y, truth = xrays_of(patients["with arms"]), WINDOW.to_hu(patients["with arms"])
    found = reconstruct(y, ORBIT, grid=WIDE).volume
    narrow = Refined(reconstructor("phydict_learned"), WIDE)
    spoilt = narrow.reconstruct(*fit_to_grid(narrow, WIDE, y, ORBIT)).volume
    assert found.shape == WIDE.shape
    assert volume_metrics(found[None, None], truth)["psnr"] > volume_metrics(spoilt[None, None], truth)["psnr"] + 2


@pytest.mark.filterwarnings("ignore:the X-rays show that something")
def test_a_finer_box_of_a_wider_patient_is_found_as_well(patients, chests):
    y, box = xrays_of(patients["with arms"]), Grid.box(16, 192.0)
    truth = inside(patients["with arms"], HALF)[0, 0, 8:24, 8:24, 8:24]
    hu = reconstruct(y, ORBIT, method=Region(TV, box, HALF)).volume
    whole = chests(TV, HALF).volume[8:24, 8:24, 8:24]
    assert (hu - truth).square().mean().sqrt() < 1.05 * (whole - truth).square().mean().sqrt()
