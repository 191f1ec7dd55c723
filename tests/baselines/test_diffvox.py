"""DiffVox's recipe: never negative, its loss falling, smooth where asked, exact where the views determine all."""

import pytest
import torch
from laws import random_like

from phydict.baselines import DiffVox
from phydict.grid import Grid
from phydict.units import MU_WATER
from phydict.xray import ConeBeam, Projector

SMALL = Projector(Grid.cube(5, 300.0), ConeBeam.orbit(8, 1020, 740, (20, 20), 27.0, start=0.2), full_detector=True)
TRUTH = 0.3 + random_like((1, 1, 5, 5, 5), seed=2).abs()
Y = MU_WATER * SMALL(TRUTH)[0]


def density(method: DiffVox, y: torch.Tensor = Y) -> torch.Tensor:
    return 1 + method.reconstruct(y, SMALL).volume[None, None] / 1000


def roughness(x: torch.Tensor) -> float:
    return float(sum(x.diff(dim=axis).abs().sum() for axis in (2, 3, 4)) / x.numel())


def loss(x: torch.Tensor, smoothness: float) -> float:
    return float((SMALL(x) - Y / MU_WATER).abs().mean()) + smoothness * roughness(x)


def test_views_that_determine_the_volume_give_it_back():
    found = density(DiffVox(300, smoothness=0.0, learning_rate=0.05, window=None))
    assert (found - TRUTH).norm() < 0.001 * TRUTH.norm()


@pytest.mark.parametrize("smoothness", [0.0, 15.0])
def test_the_loss_falls_with_the_iterations(smoothness):
    losses = [loss(density(DiffVox(n, smoothness, window=None)), smoothness) for n in (10, 30, 100, 300)]
    assert losses == sorted(losses, reverse=True) and losses[-1] < 0.5 * losses[0]


def test_it_ends_where_no_small_change_lowers_its_loss():
    found = density(DiffVox(500, 15.0, learning_rate=0.05, window=None))
    for seed in range(20):
        changed = (found + 0.05 * random_like(found.shape, seed=seed)).clamp(min=0)
        assert loss(changed, 15.0) > loss(found, 15.0)


def test_smoothness_makes_it_smoother_and_has_the_weight_that_it_is_given():
    found = {s: density(DiffVox(100, s, learning_rate=0.05)) for s in (0.0, 7.5, 15.0, 30.0, 150.0)}
    variations = [roughness(x) for x in found.values()]
    assert variations == sorted(variations, reverse=True) and variations[-1] < 0.5 * variations[0]
    assert loss(found[15.0], 15.0) < min(loss(found[7.5], 15.0), loss(found[30.0], 15.0))


def test_densities_are_never_negative():
    assert density(DiffVox(200, window=None), -Y).min() >= 0
    assert density(DiffVox(200, window=None), Y * random_like(Y.shape, seed=5)).min() >= 0
