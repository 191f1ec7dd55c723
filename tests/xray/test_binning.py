"""Detectors finer than a grid can use: the binning that is suggested, and what it does to the views."""

import numpy as np
import pytest
import torch
from laws import assert_adjoint, random_like
from torch.nn.functional import avg_pool3d

from phydict.units import MU_WATER
from phydict.xray import ConeBeam, Grid, Projector, binned, binning
from phydict.xray.finer import FinerProjector

GRID = Grid.cube(64)
DEFAULT = ConeBeam.orbit(8, 1020, 740, (448, 448), 1.25)


@pytest.mark.parametrize("grid", [GRID, Grid.cube(128), Grid.cube(16), Grid((64, 64, 32), (6.0, 6.0, 12.0))])
@pytest.mark.parametrize("beam", [
    DEFAULT, ConeBeam.orbit(2, 1500, 1000, (450, 300), (1.0, 0.7)), ConeBeam.orbit(2, 1020, 740, (7, 7), 80.0),
    ConeBeam.orbit(2, 1020, 740, (1021, 449), (0.5, 1.25)), ConeBeam.orbit(2, 1020, 740, (19, 24), 2.0)])
def test_binned_pixels_stay_below_seven_tenths_of_a_voxel_at_the_isocentre_and_fill_the_detector(grid, beam):
    factor = binning(grid, beam)
    magnification = beam.distances / np.linalg.norm(beam.sources, axis=1)
    largest = max(np.linalg.norm(step, axis=1).max() for step in (beam.u, beam.v)) / magnification.max()
    assert all(n % factor <= 0.01 * n for n in beam.shape)
    beam.binned(factor)
    assert factor == 1 or factor * largest <= 0.7 * min(grid.spacing) * (1 + 1e-9)
    coarser = [f for f in range(factor + 1, min(beam.shape) + 1) if all(n % f <= 0.01 * n for n in beam.shape)]
    assert all(f * largest > 0.7 * min(grid.spacing) for f in coarser)  # and no larger factor would do


def test_a_detector_whose_sides_share_no_divisor_is_binned_as_others_are():
    assert binning(GRID, ConeBeam.orbit(8, 1020, 740, (449, 443), 1.25)) == binning(GRID, DEFAULT) == 4


def test_the_default_detector_is_binned_to_the_default_grid():
    assert binning(GRID, DEFAULT) == 4
    assert binning(GRID, DEFAULT.binned(4)) == 1


def test_binning_looks_at_the_grids_centre():
    moved = GRID.affine.copy()
    moved[1, 3] -= 400  # nearer to the source of the PA view: more magnified, so finer pixels
    beam = DEFAULT.select([0])
    assert binning(Grid(GRID.shape, affine=moved), beam) > binning(GRID, beam)


@pytest.mark.parametrize("factor", [1, 2, 4])
def test_binning_keeps_the_mean_of_every_block(factor):
    y = random_like((3, 8, 12), seed=1)
    small = binned(y, factor)
    assert small.shape == (3, 8 // factor, 12 // factor)
    torch.testing.assert_close(small.mean((1, 2)), y.mean((1, 2)))
    torch.testing.assert_close(small[1, 1, 2], y[1, factor:2 * factor, 2 * factor:3 * factor].mean())


@pytest.mark.parametrize("shape, factor", [((56, 56), 2), ((57, 58), 2), ((58, 59), 3)])
def test_binning_views_and_beam_together_measures_the_same(shape, factor):
    grid = Grid.cube(16)
    beam = ConeBeam.orbit(2, 1020, 740, shape, 20.0 / factor)
    mu = MU_WATER * random_like((1, 1, 16, 16, 16)).abs()
    fine, coarse = (Projector(grid, b, full_detector=True)(mu)[0] for b in (beam, beam.binned(factor)))
    assert (binned(fine, factor) - coarse).norm() < 0.02 * coarse.norm()


def test_finer_voxels_and_rays_have_an_exact_adjoint_and_measure_the_same_of_what_is_smooth():
    projector = Projector(Grid.cube(12), ConeBeam.orbit(3, 1020, 740, (14, 18), 30.0), full_detector=True)
    finer = FinerProjector(projector)
    assert finer.device == projector.device == torch.device("cpu")
    assert_adjoint(finer, finer.T, (1, 1, 24, 24, 24), torch.float64, 1e-10)
    smooth = torch.sin(torch.arange(24) / 7.0)[:, None, None].expand(1, 1, 24, 24, 24).abs().contiguous()
    torch.testing.assert_close(finer(smooth), projector(avg_pool3d(smooth, 2)), rtol=0.05, atol=5.0)
