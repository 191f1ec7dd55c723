"""DiffPIR on a Gaussian prior: what its mean and its spread are, and what it does with exact data."""

import itertools

import pytest
import torch
from laws import random_like

from phydict.posterior import DiffPIR
from posterior.dense import FINE, SHAPE, N, V, X, assert_moments, condition, denoiser, measurement, propagate, sample

NOISE = 0.3


@pytest.mark.parametrize("weight", [1.0, 3.0])
def test_one_level_is_the_minimiser_of_its_own_objective(weight):
    m, prior = measurement(), denoiser()
    found = sample(DiffPIR(1, 1.0, weight, 0.0, NOISE, 50))
    spread = float(FINE.sigma(1.0)) / weight**0.5
    expected, _ = condition(m, prior.denoise(X, 1.0), spread**2, NOISE)
    torch.testing.assert_close(found.flatten(), expected, atol=1e-6, rtol=0)


@pytest.mark.parametrize("weight, zeta", [(1.0, 0.5), (1.0, 1.0), (4.0, 0.5)])
def test_the_mean_tends_to_the_posteriors_and_the_spread_to_a_known_share_of_it(weight, zeta):
    mean, covariance = condition(measurement(), denoiser().mean, V, NOISE * weight**0.5)
    samples = sample(DiffPIR(300, 1.0, weight, zeta, NOISE, 6), random_like((4000, *SHAPE), seed=11))
    assert_moments(samples, mean, (1 + (1 - zeta) ** 0.5) / 2 * covariance, 0.012, 0.08)


def test_with_exact_data_and_no_renewal_it_samples_the_posterior():
    m, tiny = measurement(), 1e-5
    mean, covariance = condition(m, denoiser().mean, V, tiny)
    found, spread = propagate(lambda x: sample(DiffPIR(200, 1.0, zeta=0.0, noise=tiny, cg_iterations=20), x))
    torch.testing.assert_close(found, mean, atol=1e-4, rtol=0)
    assert (spread - covariance).norm() < 0.05 * covariance.norm()


def test_data_without_weight_leave_the_prior():
    errors = []
    for n in (100, 400):
        _, spread = propagate(lambda x: sample(DiffPIR(n, zeta=0.0, noise=1e6), x))
        errors.append(float((spread / V - torch.eye(N).double()).norm() / N**0.5))
    assert errors[1] < 0.3 and errors[0] / errors[1] > 2  # the published spacing leaves a long last step


def test_exact_data_are_met_within_the_stated_noise_and_closer_with_more_conjugate_gradients():
    m, noise = measurement(), 0.05
    m.y = m.project(denoiser().mean + V**0.5 * X)
    starts = random_like((500, *SHAPE), seed=12)

    def misfit(settings):
        return float((m.project(sample(settings, starts, m)) - m.y).square().mean().sqrt())

    assert misfit(DiffPIR(30, noise=1e6)) > 4 * noise
    assert all(misfit(DiffPIR(n, noise=noise)) < noise for n in (3, 10, 30, 100))
    inner = [misfit(DiffPIR(30, noise=noise, cg_iterations=n)) for n in (1, 2, 3, 4)]
    assert all(after < before for before, after in itertools.pairwise(inner))
