"""Grids of noise levels stay inside the schedule, and walks along them sample what they should."""

import itertools

import pytest
import torch
from laws import random_like

from phydict.diffusion import CosineSchedule, ddim, noise_in, renoise
from phydict.posterior.samplers.noise_levels import denoise_along, polynomial_levels, stochastic_ddim_step, times_of
from posterior.dense import FINE, SHAPE, N, V, assert_moments, denoiser, moments

SCHEDULE = CosineSchedule()


@pytest.mark.parametrize("sigma", [0.0125, 0.1, 1.0, 30.0, 99.0])
def test_the_time_of_a_level_is_where_the_schedule_has_it(sigma):
    assert float(SCHEDULE.sigma(SCHEDULE.time(sigma))) == pytest.approx(sigma, rel=1e-9)


def test_levels_beyond_the_schedule_are_its_ends():
    assert SCHEDULE.time(0.002) == 0 and SCHEDULE.time(0.0) == 0
    assert float(SCHEDULE.sigma(SCHEDULE.time(1e6))) == pytest.approx(float(SCHEDULE.sigma(1.0)))
    times = times_of(SCHEDULE, polynomial_levels(1000.0, 0.001, 40))
    assert len(set(times)) == len(times) < 40 and times == sorted(times, reverse=True)
    assert times[-1] == 0


def test_levels_are_even_in_their_root_from_one_end_to_the_other():
    levels = polynomial_levels(80.0, 0.002, 100)
    assert levels[0] == pytest.approx(80) and levels[-1] == pytest.approx(0.002) and len(levels) == 100
    roots = [sigma ** (1 / 7) for sigma in levels]
    assert [a - b for a, b in itertools.pairwise(roots)] == pytest.approx([(roots[0] - roots[-1]) / 99] * 99)
    assert polynomial_levels(5.0, 0.1, 1) == [pytest.approx(5.0)]


def test_the_noise_in_a_state_is_what_was_put_in_and_kept_whole_it_is_ddim():
    x0, eps = random_like((1, *SHAPE), seed=1), random_like((1, *SHAPE), seed=2)
    x = renoise(SCHEDULE, x0, 0.6, eps)
    torch.testing.assert_close(noise_in(SCHEDULE, x0, x, 0.6), eps)
    torch.testing.assert_close(stochastic_ddim_step(SCHEDULE, x0, eps, 0.3, 1.0, None), ddim(SCHEDULE, x0, x, 0.6, 0.3))


@pytest.mark.parametrize("kept", [0.0, 0.5, 0.9])
def test_partly_renewed_noise_keeps_its_variance_and_its_correlation(kept):
    eps = random_like((1, 100000), seed=3)
    new = stochastic_ddim_step(SCHEDULE, torch.zeros_like(eps), eps, 0.5, kept, torch.Generator().manual_seed(0))
    new = new / SCHEDULE.scales(0.5)[1]
    assert float(new.std()) == pytest.approx(1, abs=0.01)
    assert float((new * eps).mean()) == pytest.approx(kept, abs=0.012)


@pytest.mark.parametrize("rho", [0.05, 0.2, 1.0])
def test_an_ancestral_walk_draws_from_the_clean_states_given_the_noisy_one(rho):
    prior, t = denoiser(), FINE.time(rho)
    a, s = (float(w) for w in FINE.scales(t))
    x = a * prior.mean + 0.3 * s * random_like((1, *SHAPE), seed=5)
    times = times_of(FINE, polynomial_levels(rho, 0.002, 200))
    samples = denoise_along(prior, x.expand(4000, *SHAPE), times, torch.Generator().manual_seed(0))
    assert_moments(samples, prior.denoise(x, t), V * rho**2 / (V + rho**2) * torch.eye(N).double(), 0.012, 0.08)


def test_a_walk_along_the_probability_flow_of_one_level_is_the_estimate_and_of_many_keeps_the_priors_variance():
    prior, x = denoiser(), random_like((4000, *SHAPE), seed=6)
    assert torch.equal(denoise_along(prior, x, [0.7]), prior.denoise(x, 0.7))
    _, spread = moments(denoise_along(prior, x, times_of(FINE, polynomial_levels(900.0, 0.002, 300))))
    assert (spread / V - torch.eye(N).double()).norm() < 0.08 * N**0.5
