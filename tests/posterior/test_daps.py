"""DAPS on a Gaussian prior: exact with the exact spread, and what its published approximations do."""

import itertools

import pytest
import torch
from laws import random_like

from phydict.posterior import DAPS, ExactDraw, Langevin
from posterior.dense import SHAPE, V, X, assert_moments, condition, denoiser, measurement, sample

NOISE = 0.3
EXACT = {"likelihood": ExactDraw(20, 1e-12), "noise": NOISE}
TRUE = {"flow_steps": 1, "prior_std": V**0.5}


def drawn(settings, cases, data=None):
    return sample(settings, random_like((cases, *SHAPE), seed=11), data)


@pytest.mark.parametrize("levels", [1, 3, 30])
def test_with_the_true_spread_the_samples_are_the_posteriors_whatever_the_levels(levels):
    mean, covariance = condition(measurement(), denoiser().mean, V, NOISE)
    assert (covariance - V * torch.eye(6).double()).norm() > 0.5 * covariance.norm()
    assert_moments(drawn(DAPS(levels, **EXACT, **TRUE), 20000), mean, covariance, 0.006, 0.04)


def test_the_published_spread_and_a_full_flow_see_the_prior_with_half_its_weight():
    mean, covariance = condition(measurement(), denoiser().mean, 2 * V, NOISE)
    assert_moments(drawn(DAPS(200, 10.0, 0.03, 15, **EXACT), 4000), mean, covariance, 0.02, 0.1)


def test_the_published_spread_around_the_denoisers_estimate_ends_at_the_posterior():
    mean, covariance = condition(measurement(), denoiser().mean, V, NOISE)
    assert_moments(drawn(DAPS(300, 10.0, 0.03, 1, **EXACT), 4000), mean, covariance, 0.015, 0.1)


def test_langevin_dynamics_of_small_steps_come_near_the_posterior():
    """Within 10 % of its spread: what 1500 steps per level leave of the start, and what the step's size adds."""
    mean, covariance = condition(measurement(), denoiser().mean, V, NOISE)
    settings = DAPS(4, sigma_max=1.0, sigma_min=0.3, likelihood=Langevin(1500, 4e-4, 0.5), noise=NOISE, **TRUE)
    assert_moments(drawn(settings, 3000), mean, covariance, 0.02, 0.1)


def test_published_langevin_dynamics_stay_finite_and_pull_towards_the_data():
    m = measurement()
    m.y = m.project(denoiser().mean + V**0.5 * X)
    free = drawn(DAPS(20, noise=1e6), 200, m)
    for noise in (0.05, 1e-3):  # the second would diverge with the published step
        found = drawn(DAPS(20, noise=noise), 200, m)
        assert found.abs().max() < 1
        assert (m.project(found) - m.y).norm() < 0.5 * (m.project(free) - m.y).norm()


@pytest.mark.parametrize("spread", [TRUE, {}])
def test_exact_data_are_met_to_the_stated_noise_by_more_levels_and_closer_by_more_conjugate_gradients(spread):
    m, noise = measurement(), 0.05
    m.y = m.project(denoiser().mean + V**0.5 * X)

    def misfit(levels, iterations):
        settings = DAPS(levels, noise=noise, likelihood=ExactDraw(iterations, 1e-12), **spread)
        return float((m.project(drawn(settings, 2000, m)) - m.y).square().mean().sqrt())

    levels = [misfit(n, 6) for n in (3, 10, 30)]
    assert all(after <= max(before, 1.05 * noise) for before, after in itertools.pairwise(levels)), levels
    assert levels[-1] < 1.05 * noise
    inner = [misfit(10, n) for n in (0, 1, 2, 3)]
    assert all(after < before for before, after in itertools.pairwise(inner)), inner
