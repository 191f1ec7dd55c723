"""Sampling the prior alone: on a Gaussian prior, the exact map from noise to samples has the prior's moments."""

import pytest
import torch
from laws import random_like

from phydict.diffusion import GaussianDenoiser, renoise
from phydict.posterior import PriorOnly, ddim_sample
from posterior.dense import FINE, SHAPE, N, denoiser, propagate

VARIANCES = torch.tensor([0.01, 0.02, 0.03, 0.04, 0.05, 0.06]).double().view(1, *SHAPE)


def prior():
    return GaussianDenoiser(denoiser().mean, VARIANCES, FINE)


def sampled_moments(steps):
    return propagate(lambda x: PriorOnly(steps).sample(prior(), None, x, None))


def test_samples_have_the_priors_mean():
    mean, _ = sampled_moments(20)
    torch.testing.assert_close(mean, prior().mean.flatten(), atol=1e-3, rtol=0)


def test_samples_have_the_priors_variance_as_the_steps_grow():
    expected = torch.diag(VARIANCES.flatten())
    errors = [float((sampled_moments(n)[1] - expected).norm() / expected.norm()) for n in (50, 200, 800)]
    assert errors[2] < 0.02
    assert errors[0] / errors[1] > 3 and errors[1] / errors[2] > 3  # first order in the step


def test_components_do_not_mix():
    _, covariance = sampled_moments(20)
    assert (covariance - torch.diag(covariance.diagonal())).abs().max() < 1e-12


def test_a_descent_from_a_time_between_brings_the_noised_prior_back_to_the_prior():
    start, n = 0.6, 400
    a, s = (float(w) for w in FINE.scales(start))
    gain = propagate(lambda x: ddim_sample(prior(), a * prior().mean + s * x, n, start))[1].diagonal() / s**2
    noised = a**2 * VARIANCES.flatten() + s**2
    torch.testing.assert_close(gain * noised, VARIANCES.flatten(), rtol=0.03, atol=0)


def test_one_step_from_pure_noise_is_the_mean_and_many_runs_are_the_same():
    x = random_like((1, *SHAPE), seed=5)
    assert (ddim_sample(prior(), x, 1) - prior().mean).abs().max() < 1e-3
    assert torch.equal(ddim_sample(prior(), x, 30), ddim_sample(prior(), x, 30))


def test_samples_stay_in_the_priors_range():
    wide = GaussianDenoiser(torch.full((1, *SHAPE), 0.9).double(), torch.tensor(4.0).double(), FINE)
    sample = ddim_sample(wide, 3 * random_like((1, *SHAPE), seed=6), 20)
    assert sample.max() == 1 and sample.min() == -1


def test_on_step_is_called_once_per_step():
    calls = []
    PriorOnly(7).sample(prior(), None, torch.zeros(1, *SHAPE).double(), None, lambda: calls.append(1))
    assert len(calls) == PriorOnly(7).steps() == 7


def test_a_descent_of_no_steps_is_refused():
    with pytest.raises(ValueError, match="at least one step"):
        ddim_sample(prior(), renoise(FINE, prior().mean, 0.5, torch.ones(N).double().view(1, *SHAPE)), 0, 0.5)
