"""DAPS on a Gaussian prior: exact with the exact spread, and what its published approximations do."""

import itertools

import pytest
import torch
from laws import random_like

from phydict.posterior import DAPS, ExactDraw, Langevin
from posterior.dense import SHAPE, WithMask, condition, denoiser, measurement, moments

V, NOISE = 0.04, 0.3
EXACT = {"likelihood": ExactDraw(20, 1e-12), "noise": NOISE}
TRUE = {"flow_steps": 1, "prior_std": V**0.5}
X = random_like((1, *SHAPE), seed=10)


def sample(settings, cases=1, data=None, seed=0):
    x = X if cases == 1 else random_like((cases, *SHAPE), seed=11)
    return settings.sample(denoiser(V), data or measurement(), x, torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("levels", [1, 3, 30])
def test_with_the_true_spread_the_samples_are_the_posteriors_whatever_the_levels(levels):
    mean, covariance = condition(measurement(), denoiser(V).mean, V, NOISE)
    assert (covariance - V * torch.eye(6).double()).norm() > 0.5 * covariance.norm()
    found, spread = moments(sample(DAPS(levels, **EXACT, **TRUE), 20000))
    torch.testing.assert_close(found, mean, atol=0.006, rtol=0)
    assert (spread - covariance).norm() < 0.04 * covariance.norm()


@pytest.mark.parametrize("alike", [0.0, 0.9])
def test_a_ct_and_a_mask_that_no_x_ray_measures_have_the_spread_of_their_posterior(alike):
    prior, x = WithMask(V, alike), random_like((1500, 2, *SHAPE[1:]), seed=11)
    settings = DAPS(60, sigma_min=0.001, flow_end=0.001, **EXACT, **TRUE)
    states = settings.sample(prior, measurement(), x, torch.Generator().manual_seed(0))
    found = [float(states[:, i].flatten(1).T.cov().trace()) for i in (0, 1)]
    assert found == pytest.approx(prior.spreads(measurement(), NOISE), rel=0.08)


def test_the_published_spread_and_a_full_flow_see_the_prior_with_half_its_weight():
    settings = DAPS(200, 10.0, 0.03, 15, **EXACT)
    mean, covariance = condition(measurement(), denoiser(V).mean, 2 * V, NOISE)
    found, spread = moments(sample(settings, 4000))
    torch.testing.assert_close(found, mean, atol=0.02, rtol=0)
    assert (spread - covariance).norm() < 0.1 * covariance.norm()


def test_the_published_spread_around_the_denoisers_estimate_ends_at_the_posterior():
    settings = DAPS(300, 10.0, 0.03, 1, **EXACT)
    mean, covariance = condition(measurement(), denoiser(V).mean, V, NOISE)
    found, spread = moments(sample(settings, 4000))
    torch.testing.assert_close(found, mean, atol=0.015, rtol=0)
    assert (spread - covariance).norm() < 0.1 * covariance.norm()


def test_langevin_dynamics_of_small_steps_come_near_the_posterior():
    """Within 10 % of its spread: what 1500 steps per level leave of the start, and what the step's size adds."""
    mean, covariance = condition(measurement(), denoiser(V).mean, V, NOISE)
    settings = DAPS(4, sigma_max=1.0, sigma_min=0.3, likelihood=Langevin(1500, 4e-4, 0.5), noise=NOISE, **TRUE)
    found, spread = moments(sample(settings, 3000))
    torch.testing.assert_close(found, mean, atol=0.02, rtol=0)
    assert (spread - covariance).norm() < 0.1 * covariance.norm()


def test_published_langevin_dynamics_stay_finite_and_pull_towards_the_data():
    m = measurement()
    m.y = m.project(denoiser(V).mean + V**0.5 * X)
    free = sample(DAPS(20, noise=1e6), 200, m)
    for noise in (0.05, 1e-3):  # the second would diverge with the published step
        found = sample(DAPS(20, noise=noise), 200, m)
        assert found.abs().max() < 1
        assert (m.project(found) - m.y).norm() < 0.5 * (m.project(free) - m.y).norm()


@pytest.mark.parametrize("spread", [TRUE, {}])
def test_exact_data_are_met_to_the_stated_noise_by_more_levels_and_closer_by_more_conjugate_gradients(spread):
    m, noise = measurement(), 0.05
    m.y = m.project(denoiser(V).mean + V**0.5 * X)

    def misfit(levels, iterations):
        settings = DAPS(levels, noise=noise, likelihood=ExactDraw(iterations, 1e-12), **spread)
        return float((m.project(sample(settings, 2000, m)) - m.y).square().mean().sqrt())

    levels = [misfit(n, 6) for n in (3, 10, 30)]
    assert all(after <= max(before, 1.05 * noise) for before, after in itertools.pairwise(levels)), levels
    assert levels[-1] < 1.05 * noise
    inner = [misfit(10, n) for n in (0, 1, 2, 3)]
    assert all(after < before for before, after in itertools.pairwise(inner)), inner


def test_the_result_depends_on_the_seed_alone():
    for likelihood in (ExactDraw(), Langevin(5)):
        settings = DAPS(3, likelihood=likelihood, noise=NOISE)
        torch.manual_seed(1)
        one = sample(settings, seed=3)
        torch.manual_seed(2)
        assert torch.equal(one, sample(settings, seed=3)) and not torch.allclose(one, sample(settings, seed=4))


@pytest.mark.parametrize("settings", [{"levels": 0}, {"flow_steps": 0}, {"sigma_min": 200.0}, {"noise": -1.0},
                                      {"prior_std": 0.0}, {"noise": 1e-200}, {"noise": float("inf")},
                                      {"sigma_max": float("inf")}])
def test_impossible_settings_are_refused(settings):
    with pytest.raises(ValueError, match=str(next(iter(settings.values())))):
        DAPS(**settings)
