"""SIRT: closer to the views with every iteration, never below vacuum, exact where the views determine the volume."""

import numpy as np
import pytest
import torch
from laws import random_like

from phydict.baselines import SIRT
from phydict.baselines.baseline import typical_chest
from phydict.grid import Grid
from phydict.units import MU_WATER, hu_to_mu
from phydict.xray import ConeBeam, Projector

SMALL = Projector(Grid.cube(5, 300.0), ConeBeam.orbit(8, 1020, 740, (20, 20), 27.0, start=0.2))
CHEST = Projector(Grid.cube(24), ConeBeam.orbit(4, 1020, 740, (28, 28), 20.0))


def chest_views():
    return CHEST(MU_WATER * typical_chest(CHEST))[0]


def test_the_misfit_falls_with_the_iterations_and_is_that_of_the_volume():
    y = CHEST(MU_WATER * random_like((1, 1, 24, 24, 24), torch.float32).abs() * typical_chest(CHEST))[0]
    results = [SIRT(n).reconstruct(y, CHEST) for n in (3, 10, 30, 100)]
    misfits = [r.misfit for r in results]
    assert misfits == sorted(misfits, reverse=True) and misfits[-1] < 0.3 * misfits[0]
    again = CHEST(hu_to_mu(results[-1].volume)[None, None])[0]
    torch.testing.assert_close(again, results[-1].reprojection, atol=1e-4, rtol=1e-4)
    assert misfits[-1] == pytest.approx(float((again - y).norm() / y.norm()), rel=1e-3)


def test_views_that_determine_the_volume_give_it_back():
    mu = MU_WATER * (0.5 + random_like((1, 1, 5, 5, 5), seed=2).abs())
    matrix = torch.cat([SMALL(e.view_as(mu)).flatten(1) for e in torch.eye(125).double()])
    assert torch.linalg.matrix_rank(matrix) == 125
    result = SIRT(3000).reconstruct(SMALL(mu)[0], SMALL)
    assert (hu_to_mu(result.volume) - mu[0, 0]).norm() < 0.01 * mu.norm() and result.misfit < 1e-3


def test_attenuation_is_never_negative_even_for_impossible_views():
    y = random_like((4, 28, 28), torch.float32)
    result = SIRT(20).reconstruct(y, CHEST)
    assert result.volume.min() >= -1000 and result.volume.isfinite().all()
    assert torch.equal(SIRT(5).reconstruct(-y.abs(), CHEST).volume, torch.full((24, 24, 24), -1000.0))


def test_an_empty_object_stays_empty():
    assert torch.equal(SIRT(5).reconstruct(torch.zeros(4, 28, 28), CHEST).volume, torch.full((24, 24, 24), -1000.0))


def test_twice_the_views_values_are_twice_the_attenuation():
    one, two = (hu_to_mu(SIRT(10).reconstruct(f * chest_views(), CHEST).volume) for f in (1, 2))
    torch.testing.assert_close(two, 2 * one, rtol=1e-3, atol=1e-6)


def test_display_values_count_only_up_to_gain_and_offset_of_each_view():
    y = chest_views()
    gains = torch.tensor([0.1, 1.0, 50.0, 7.0]).view(4, 1, 1)
    offsets = torch.tensor([3.0, -1.0, 0.0, -90.0]).view(4, 1, 1)
    one, other = (SIRT(15).reconstruct(v, CHEST, display=True) for v in (y, gains * y + offsets))
    assert (one.volume - other.volume).abs().max() < 1.0  # HU
    exact = SIRT(15).reconstruct(y, CHEST)  # this object is the typical chest, so its scale is found exactly
    assert (one.volume - exact.volume).abs().max() < 1.0
    assert (SIRT(15).reconstruct(50 * y, CHEST).volume - exact.volume).abs().max() > 1000


def test_the_typical_chest_is_an_upright_ellipse_of_water_with_two_lungs():
    chest = typical_chest(CHEST)[0, 0]
    assert torch.equal(chest, chest.flip(0)) and torch.equal(chest, chest.flip(1)) and torch.equal(chest, chest.flip(2))
    area = float((chest[:, :, 0] > 0).sum()) * 16**2
    assert area == pytest.approx(np.pi * 160 * 110, rel=0.05)
    assert chest[12, 12, 0] == 1 and chest[7, 12, 0] == 0.25 and chest[0, 0, 0] == 0


def test_the_result_does_not_depend_on_the_seed_and_counts_its_steps():
    calls = []
    one = SIRT(7).reconstruct(chest_views(), CHEST, seed=1, on_step=lambda: calls.append(1))
    assert torch.equal(one.volume, SIRT(7).reconstruct(chest_views(), CHEST, seed=2).volume)
    assert len(calls) == SIRT(7).steps() == 7 and one.network_calls == 0 and one.projector_calls >= 14


@pytest.mark.parametrize("display", [False, True])
@pytest.mark.parametrize("views", [slice(1), slice(3), None])
def test_x_rays_that_do_not_fit_the_geometry_are_refused(display, views):
    y = chest_views()[views] if views else chest_views()[:, :20]
    with pytest.raises(ValueError):
        SIRT(2).reconstruct(y, CHEST, display=display)


def test_x_rays_that_are_not_finite_are_refused():
    y = chest_views()
    y[1, 2, 3] = float("nan")
    with pytest.raises(ValueError, match="NaN or infinite"):
        SIRT(2).reconstruct(y, CHEST)
