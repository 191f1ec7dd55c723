"""Draws near an estimate that fit the data: exact by perturbation, biased by a known amount with Langevin's steps."""

import pytest
import torch
from laws import random_like

from phydict.grid import Grid
from phydict.linalg.conjugate_gradients import conjugate_gradients
from phydict.posterior import ExactDraw, Langevin, Measurement
from phydict.posterior.normalised import NormalisedMeasurement, nearest_fit
from phydict.units import HUWindow
from phydict.xray import ConeBeam, Projector
from posterior.dense import SHAPE, DenseMeasurement, N, assert_moments, condition, measurement

X0 = 0.3 * random_like((1, *SHAPE), seed=20)
NOISE = 0.3


def drawn(draw, spread, cases=20000, m=None, noise=NOISE):
    m = NormalisedMeasurement(m or measurement(), noise)
    return draw(m, X0.expand(cases, *SHAPE), spread, torch.Generator().manual_seed(0), 0.0)


@pytest.mark.parametrize("rows", [1, 4, 9])
@pytest.mark.parametrize("spread", [0.05, 0.5])
def test_perturbed_and_fitted_it_has_the_mean_and_covariance_of_its_target(rows, spread):
    m = measurement(rows)
    mean, covariance = condition(m, X0, spread**2, NOISE)
    assert_moments(drawn(ExactDraw(20, 1e-12), spread, m=m), mean, covariance, 0.025 * spread, 0.04)


def test_what_the_data_do_not_see_has_its_full_spread_after_any_number_of_iterations():
    null = torch.linalg.svd(measurement().matrix)[2][4:]
    draws = [drawn(ExactDraw(k), 0.5, 10).flatten(1) @ null.T for k in (0, 1, 20)]
    torch.testing.assert_close(draws[1], draws[0], atol=1e-9, rtol=0)
    torch.testing.assert_close(draws[2], draws[0], atol=1e-9, rtol=0)


@pytest.mark.parametrize("step", [1e-3, 4e-3])
def test_langevin_steps_have_the_right_mean_and_a_variance_too_large_by_a_known_factor(step):
    m = measurement()
    mean, covariance = condition(m, X0, 0.2**2, NOISE)
    values, vectors = torch.linalg.eigh(torch.linalg.inv(covariance))
    scaled = NormalisedMeasurement(m, NOISE)
    assert step * values.max() < 1 and scaled.noise == pytest.approx(NOISE / m.norm())
    expected = vectors @ torch.diag(1 / values / (1 - step * values / 2)) @ vectors.T
    assert_moments(drawn(Langevin(int(4 / (step * values.min())), step), 0.2, 10000), mean, expected, 0.015, 0.05)


def test_a_step_that_would_diverge_is_shortened():
    assert drawn(Langevin(200, 10.0), 0.2, 10, noise=1e-3).abs().max() < 10


def test_a_step_shrinks_linearly_with_progress():
    m, x = NormalisedMeasurement(measurement(), NOISE), X0
    moved = [Langevin(1, 1e-6, 0.25)(m, x, 0.2, torch.Generator().manual_seed(0), p) - x for p in (0.0, 1.0)]
    assert float(moved[1].norm() / moved[0].norm()) == pytest.approx(0.5, rel=0.05)  # noise goes with the root


def test_conjugate_gradients_treat_each_case_by_itself():
    m = measurement(9)
    right = random_like((3, *SHAPE), seed=7) * torch.tensor([1e-6, 1.0, 1e6]).double().view(3, 1, 1, 1, 1)
    right[1] = 0

    def operator(d):
        return m.adjoint(m.linear(d)) + 0.1 * d

    together = conjugate_gradients(operator, right, 4)
    for i in range(3):
        torch.testing.assert_close(together[i:i + 1], conjugate_gradients(operator, right[i:i + 1], 4))
    assert not together[1].any()
    solved = conjugate_gradients(operator, right, 60, 1e-13)
    torch.testing.assert_close(operator(solved), right, rtol=1e-7, atol=1e-12)


def test_without_weight_the_nearest_of_all_fits_is_found_and_unseen_voxels_stay():
    matrix = torch.zeros(3, N).double()
    matrix[0, 0] = matrix[1, 0] = 1.0
    m = NormalisedMeasurement(DenseMeasurement(matrix, torch.tensor([0.4, 0.6, 0.9]).double()), 1.0)
    z = nearest_fit(m, X0, 0.0, 30)
    assert z.isfinite().all() and float(z.flatten()[0]) == pytest.approx(0.5)
    assert torch.equal(z.flatten()[1:], X0.flatten()[1:])


def test_a_normalised_measurement_has_norm_one_and_the_same_relative_misfit():
    grid, window = Grid.cube(8), HUWindow()
    projector = Projector(grid, ConeBeam.orbit(4, 1020, 740, (14, 14), 40.0))
    truth = (0.4 * random_like((1, 1, 8, 8, 8), torch.float32, seed=1)).clamp(-1, 1)
    plain = Measurement(projector, projector(window.to_mu(truth))[0], window)
    m = NormalisedMeasurement(plain, 0.02)
    v = torch.ones_like(truth)
    for _ in range(50):
        v = m.adjoint(m.linear(v / v.norm()))
    assert float(v.norm()) == pytest.approx(1, rel=1e-3)
    assert m.noise * plain.norm() == pytest.approx(0.02) and torch.equal(m.y, plain.y / plain.norm())
    torch.testing.assert_close(m.project(truth), m.y, rtol=1e-4, atol=1e-5)


def test_no_noise_and_no_view_are_refused():
    with pytest.raises(ValueError, match="noise of the line integrals.* lies between .*, but 0.0 was given"):
        NormalisedMeasurement(measurement(), 0.0)
    with pytest.raises(ValueError, match="no ray"):
        NormalisedMeasurement(DenseMeasurement(torch.zeros(2, N).double(), torch.zeros(2).double()), 0.1)


@pytest.mark.parametrize("wrong", [{"iterations": -1}, {"tolerance": -1e-4}, {"tolerance": 2.0}])
def test_impossible_exact_draws_are_refused(wrong):
    [(name, value)] = wrong.items()
    with pytest.raises(ValueError, match=rf"^ExactDraw\.{name} .*, but {value} was given$"):
        ExactDraw(**wrong)


@pytest.mark.parametrize("settings", [{"iterations": 0}, {"step": 0.0}, {"last_share": 2.0}])
def test_impossible_langevin_dynamics_are_refused(settings):
    with pytest.raises(ValueError, match=str(next(iter(settings.values())))):
        Langevin(**settings)
