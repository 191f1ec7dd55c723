"""FISTA-TV: its parts in closed form, its objective falling onto what another algorithm finds."""

import numpy as np
import pytest
import torch
from laws import random_like, total_variation

from phydict.baselines import CGLS, FISTATV
from phydict.baselines.tv import finest_to_own
from phydict.grid import Grid
from phydict.linalg.total_variation import differences, tv_proximal
from phydict.units import MU_WATER, HUWindow
from phydict.xray import ConeBeam, Projector

UNIT = (1.0, 1.0, 1.0)
SMALL = Projector(Grid((4, 3, 4), (75.0, 75.0, 90.0)), ConeBeam.orbit(3, 1020, 740, (6, 6), 80.0, start=0.2),
                  full_detector=True)
SCALES = finest_to_own(SMALL.grid.spacing)
MATRIX = torch.cat([SMALL(e.view(1, 1, 4, 3, 4)).flatten(1) for e in torch.eye(48).double()]).T
NORM = float(torch.linalg.matrix_norm(MATRIX, 2))
Y = MATRIX @ (0.7 + 0.6 * random_like((48,), seed=1)) + 10 * random_like((len(MATRIX),), seed=2)  # mm of water


def solved(method: FISTATV) -> torch.Tensor:
    """Density relative to water (1, 1, 4, 3, 4)."""
    return 1 + method.reconstruct(MU_WATER * Y.view(3, 6, 6), SMALL).volume[None, None] / 1000


def objective(x: torch.Tensor, weight: float) -> float:
    residual = 3 * (MATRIX @ x.flatten() - Y).square().sum() / (2 * NORM**2 * 1.02)  # of three views
    return float(residual + weight * total_variation(x, SCALES))


def primal_dual(weight: float, low: float, high: float, iterations: int = 5000) -> np.ndarray:
    """The minimiser by Chambolle & Pock's algorithm with dense matrices: another way to the same end."""
    gradient = torch.stack([differences(e.view(1, 1, 4, 3, 4), SCALES).flatten() for e in torch.eye(48).double()], 1)
    scale = (3 / 1.02) ** 0.5 / NORM
    D, A, b = gradient.numpy(), scale * MATRIX.numpy(), scale * Y.numpy()
    step = 0.99 / np.linalg.norm(np.concatenate([A, D]), 2)
    x, ahead, p, q = np.zeros(48), np.zeros(48), np.zeros(len(A)), np.zeros(len(D))
    for _ in range(iterations):
        p = (p + step * (A @ ahead - b)) / (1 + step)
        q = (q + step * D @ ahead).reshape(3, -1)
        q = (q / np.maximum(1, np.sqrt((q**2).sum(0)) / weight)).ravel()
        new = (x - step * (A.T @ p + D.T @ q)).clip(low, high)
        x, ahead = new, 2 * new - x
    return x


def test_a_large_weight_leaves_the_mean_alone():
    v = random_like((1, 1, 5, 4, 3))
    x, _ = tv_proximal(v, 100.0, UNIT, lambda x: x, 1000, torch.zeros(3, *v.shape).double())
    assert x.numpy() == pytest.approx(float(v.mean()), abs=1e-3)


@pytest.mark.parametrize("window", [HUWindow(-1000, 200), None])
def test_the_objective_falls_onto_that_of_another_algorithm(window):
    weight = 9e-3
    low, high = (0, 1.2) if window else (-np.inf, np.inf)
    reference = primal_dual(weight, low, high)
    found = [solved(FISTATV(n, weight, 10, window)) for n in (3, 10, 30, 100)]
    values = [objective(x, weight) for x in found]
    best = objective(torch.as_tensor(reference).view(1, 1, 4, 3, 4), weight)
    assert values == sorted(values, reverse=True)
    assert values[-1] == pytest.approx(best, rel=1e-3)
    assert found[-1].flatten().numpy() == pytest.approx(reference, abs=0.02)


def test_without_weight_it_is_bounded_least_squares():
    window = HUWindow(-1000, 1000)
    smooth = solved(FISTATV(500, 0.0, 1, window))
    direct = 1 + CGLS(48, 20, window).reconstruct(MU_WATER * Y.view(3, 6, 6), SMALL).volume / 1000
    assert objective(smooth, 0.0) == pytest.approx(objective(direct[None, None], 0.0), rel=1e-3)


def test_more_weight_is_smoother_and_fits_less():
    results = [FISTATV(60, w, 10).reconstruct(MU_WATER * Y.view(3, 6, 6), SMALL) for w in (0, 1e-3, 1e-2, 1e-1)]
    variations = [float(total_variation(r.volume[None, None], SCALES)) for r in results]
    misfits = [r.misfit for r in results]
    assert variations == sorted(variations, reverse=True) and misfits == sorted(misfits)


def test_coarser_axes_count_by_their_slope():
    assert finest_to_own((2.0, 4.0, 3.0)) == [1.0, 0.5, 2 / 3]


def test_views_that_are_all_given_twice_count_twice():
    twice = Projector(SMALL.grid, SMALL.beam.select([0, 1, 2, 0, 1, 2]), full_detector=True)
    once, again = (FISTATV(60, weight, 10).reconstruct(MU_WATER * Y.view(3, 6, 6)[views], projector).volume
                   for weight, views, projector in ((0.01, [0, 1, 2], SMALL), (0.02, [0, 1, 2, 0, 1, 2], twice)))
    torch.testing.assert_close(again, once, atol=0.5, rtol=0)
