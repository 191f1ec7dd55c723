"""The Gaussian denoiser is the regression of x_0 on x_t; guidance is affine in either kind of estimate."""

import pytest
import torch
from laws import random_like

from phydict.diffusion import CosineSchedule, GaussianDenoiser, guided, renoise

SCHEDULE = CosineSchedule()


@pytest.mark.parametrize("t", [0.05, 0.4, 0.8])
@pytest.mark.parametrize("mean, variance", [(0.3, 0.25), (-0.5, 0.04)])
def test_the_gaussian_denoiser_is_the_regression_of_the_clean_state_on_the_noisy_one(t, mean, variance):
    n = 400_000
    x0 = mean + variance**0.5 * random_like((n,), seed=1)
    x = renoise(SCHEDULE, x0, t, random_like((n,), seed=2))
    slope = float(torch.cov(torch.stack([x0, x]))[0, 1] / x.var())
    level = float(x0.mean() - slope * x.mean())
    denoiser = GaussianDenoiser(torch.tensor(mean).double(), torch.tensor(variance).double())
    final_denoise, at_one = denoiser.denoise(torch.tensor([0.0, 1.0]).double(), t).tolist()
    assert final_denoise == pytest.approx(level, abs=0.003)
    assert at_one - final_denoise == pytest.approx(slope, abs=0.003)


def test_a_certain_prior_and_pure_noise_both_give_the_mean_and_no_noise_gives_the_state():
    x, mean = random_like((5,), seed=3), torch.full((5,), 0.4).double()
    assert torch.equal(GaussianDenoiser(mean, 0 * mean).denoise(x, 0.5), mean)
    wide = GaussianDenoiser(mean, 0 * mean + 0.25)
    assert (wide.denoise(x, 1.0) - mean).abs().max() < 0.01 * x.abs().max()
    assert (wide.denoise(x, 0.0) - x).abs().max() < 0.003


def test_every_component_keeps_its_own_mean_and_variance():
    mean, variance = random_like((4,), seed=4), random_like((4,), seed=5).square()
    x = random_like((3, 4), seed=6)
    together = GaussianDenoiser(mean, variance).denoise(x, 0.3)
    alone = torch.stack([GaussianDenoiser(mean[i], variance[i]).denoise(x[:, i], 0.3) for i in range(4)], 1)
    torch.testing.assert_close(together, alone)


def test_guidance_of_one_is_the_conditional_and_of_zero_the_unconditional_estimate():
    conditional, unconditional = random_like((2, 3), seed=7), random_like((2, 3), seed=8)
    assert torch.equal(guided(conditional, unconditional, 1.0), conditional)
    assert torch.equal(guided(conditional, unconditional, 0.0), unconditional)
    assert torch.equal(guided(conditional, conditional, 5.0), conditional)


@pytest.mark.parametrize("scale", [0.5, 2.0, 7.5])
def test_guiding_the_clean_estimate_is_guiding_the_noise_estimate(scale):
    conditional, unconditional, x = (random_like((2, 3), seed=s) for s in (9, 10, 11))
    signal, noise = SCHEDULE.scales(0.6)
    eps_c, eps_u = (x - signal * conditional) / noise, (x - signal * unconditional) / noise
    eps = eps_u + scale * (eps_c - eps_u)
    torch.testing.assert_close(guided(conditional, unconditional, scale), (x - noise * eps) / signal)
