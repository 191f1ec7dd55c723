"""CGLS: the least-squares solution in the end, the best of its Krylov space on the way, bounded where asked."""

import numpy as np
import pytest
import torch
from laws import random_like
from scipy.optimize import lsq_linear

from phydict.baselines import CGLS
from phydict.grid import Grid
from phydict.units import MU_WATER, HUWindow
from phydict.xray import ConeBeam, Projector

SMALL = Projector(Grid.cube(4, 300.0), ConeBeam.orbit(5, 1020, 740, (7, 7), 75.0, start=0.2), full_detector=True)
MATRIX = torch.cat([SMALL(e.view(1, 1, 4, 4, 4)).flatten(1) for e in torch.eye(64).double()]).T
NOISY = MATRIX @ (0.5 + random_like((64,), seed=1)) + 20 * random_like((len(MATRIX),), seed=2)  # mm of water


def solved(method: CGLS, y: torch.Tensor = NOISY) -> torch.Tensor:
    """Density relative to water (64,)."""
    return 1 + method.reconstruct(MU_WATER * y.view(5, 7, 7), SMALL).volume.flatten() / 1000


def test_many_iterations_reach_the_least_squares_solution():
    exact = torch.linalg.lstsq(MATRIX, NOISY[:, None]).solution[:, 0]
    assert torch.linalg.matrix_rank(MATRIX) == 64
    torch.testing.assert_close(solved(CGLS(200)), exact, rtol=0, atol=1e-4)


def test_every_iterate_is_the_best_of_its_krylov_space():
    vectors = [MATRIX.T @ NOISY]
    for k in range(1, 6):
        basis, _ = torch.linalg.qr(torch.stack(vectors, 1))
        best = basis @ torch.linalg.lstsq(MATRIX @ basis, NOISY[:, None]).solution[:, 0]
        torch.testing.assert_close(solved(CGLS(k)), best, rtol=1e-6, atol=1e-6)
        following = MATRIX.T @ (MATRIX @ vectors[-1])
        vectors.append(following / following.norm())


def test_the_misfit_falls_and_the_volume_grows_with_the_iterations():
    results = [CGLS(k).reconstruct(MU_WATER * NOISY.view(5, 7, 7), SMALL) for k in (1, 2, 4, 8, 16)]
    misfits, sizes = [r.misfit for r in results], [float((r.volume + 1000).norm()) for r in results]
    assert misfits == sorted(misfits, reverse=True) and sizes == sorted(sizes)


def test_stopping_early_is_nearer_to_the_truth_than_fitting_the_noise():
    truth = 0.5 + random_like((64,), seed=1)
    noisy = MATRIX @ truth + 60 * random_like((len(MATRIX),), seed=2)
    errors = [float((solved(CGLS(k), noisy) - truth).norm()) for k in (1, 8, 200)]
    assert errors[1] < errors[0] and errors[1] < errors[2]


def test_with_bounds_it_reaches_the_bounded_least_squares_solution():
    window = HUWindow(-1000, 500)
    exact = lsq_linear(MATRIX.numpy(), NOISY.numpy(), (0, 1.5), tol=1e-12).x
    assert (exact < 1e-6).any() and (exact > 1.5 - 1e-6).any() and ((exact > 0.1) & (exact < 1.4)).any()
    assert solved(CGLS(64, 20, window)).numpy() == pytest.approx(exact, abs=1e-4)


def test_it_is_linear_up_to_scale_without_bounds():
    one, two = (solved(CGLS(4), f * NOISY) for f in (1.0, -3.0))
    assert np.allclose(two, -3 * one, rtol=1e-6, atol=1e-9)
