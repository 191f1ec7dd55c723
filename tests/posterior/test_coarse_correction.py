"""A coarse network's call at an estimate on finer voxels: what it sees, and what it leaves."""

from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace

import pytest
import torch
from fitting import fit_to_grid
from laws import random_like
from prior.tiny import tiny_prior, tiny_refiner

from phydict.grid import Grid
from phydict.methods import reconstructor
from phydict.posterior import Measurement, PriorOnly, Refined, Refinement, Unrolled
from phydict.posterior.coarse_correction import CoarseCorrection, coarse_correction
from phydict.runtime.profiling import profiled
from phydict.units import HUWindow
from phydict.xray import ConeBeam, Projector
from phydict.xray.finer import FinerProjector

BEAM = ConeBeam.orbit(3, 1020, 740, (56, 56), 10.0)
WINDOW, COARSE = HUWindow(-1000, 600), Grid.cube(16)
UNROLLED = Unrolled((0.2,), (0.5, 0.3), contradiction=None)


class Answer:
    """A refiner that answers `change` beyond the state it is shown, and keeps what it was shown."""

    def __init__(self, change: float = 0.0):
        self.change, self.schedule = change, SimpleNamespace(scales=lambda t: (torch.tensor(0.5), None))

    def refine(self, x, t, evidence):
        self.evidence = evidence
        return 2 * x + self.change


def measured(factor: int) -> tuple[Measurement, Measurement, torch.Tensor]:
    """X-rays of a fine volume on the coarse and on its own voxels, and the volume."""
    projector = Projector(COARSE, BEAM, full_detector=True)
    fine = FinerProjector(projector, factor)
    z = 0.9 * random_like((1, 1, *fine.grid.shape)).tanh()
    y = fine(WINDOW.to_mu(z))[0]
    return Measurement(projector, y, WINDOW), Measurement(fine, y, WINDOW), z


@pytest.mark.parametrize("factor", [2, 4])
def test_what_the_network_is_shown_holds_no_misfit_where_the_finer_voxels_have_none(factor):
    coarse, fine, z = measured(factor)
    refiner = Answer()
    kept = CoarseCorrection(refiner, coarse, torch.zeros(1, 3, *COARSE.shape), factor)(z)
    torch.testing.assert_close(kept, z)
    torch.testing.assert_close(coarse.project(torch.nn.functional.avg_pool3d(z, factor)), fine.project(z))
    assert refiner.evidence[:, 0].abs().max() < 1e-4


def test_what_the_network_changes_of_the_means_is_added_to_every_voxel_of_theirs():
    coarse, _, z = measured(2)
    changed = CoarseCorrection(Answer(0.05), coarse, torch.zeros(1, 1, *COARSE.shape), 2)(z)
    torch.testing.assert_close(changed, z + 0.05)


def test_the_back_projection_of_ones_is_made_once_and_each_call_takes_four_more():
    coarse, _, z = measured(2)
    correction = CoarseCorrection(Answer(0.05), coarse, torch.zeros(1, 1, *COARSE.shape), 2)
    counts = [correction.projector_calls]
    for _ in range(3):
        with profiled() as profile:
            z = correction(z)
        counts.append(correction.projector_calls)
        assert sum(use.calls for name, use in profile.uses.items() if name.endswith("projector")) == 4
    assert [after - before for before, after in pairwise(counts)] == [4, 4, 4]


def test_only_a_refiner_corrects_on_voxels_that_divide_its_own_with_upright_detectors():
    y = Projector(COARSE, BEAM, full_detector=True)(0.02 * torch.ones(1, 1, *COARSE.shape))[0]
    learned, other = reconstructor(UNROLLED, tiny_refiner()), reconstructor(PriorOnly(1), tiny_prior(False))
    seen = fit_to_grid(learned, COARSE, y, BEAM)
    found = learned.reconstruct(*seen)

    def correction(level: Grid, base=learned, seen=seen, found=found) -> CoarseCorrection | None:
        return coarse_correction(base, level, seen, found, "", False)

    assert [correction(Grid.cube(voxels)).factor for voxels in (32, 64)] == [2, 4]
    for level in (COARSE, Grid.cube(24), Grid.box((32, 32, 30), (384, 384, 360)), Grid.cube(32, 300)):
        assert correction(level) is None
    assert correction(Grid.cube(32), other) is None
    assert correction(Grid.cube(32), found=replace(found, masks=None)) is None
    assert correction(Grid.cube(32), seen=fit_to_grid(learned, COARSE, y, BEAM, "siddon")) is None


def test_every_correction_is_a_call_of_the_network_and_less_than_none_is_refused():
    fine = Grid.cube(32)
    y = Projector(fine, BEAM, full_detector=True)(0.02 * torch.ones(1, 1, *fine.shape))[0]

    def network_calls(calls: int) -> int:
        ready = Refined(reconstructor(UNROLLED, tiny_refiner()), fine, Refinement(calls=calls))
        return ready.reconstruct(*fit_to_grid(ready, fine, y, BEAM)).network_calls

    assert [network_calls(calls) - network_calls(0) for calls in (1, 3)] == [1, 3]
    with pytest.raises(ValueError, match="Refinement.calls is a finite number, 0 or more, but -1 was given"):
        Refinement(calls=-1)
