"""PnP-DM on a Gaussian prior: its states have the posterior of data blurred by the coupling, and its means the mean."""

import itertools

import pytest
import torch
from laws import random_like

from phydict.posterior import ExactDraw, Langevin, PnPDM
from posterior.dense import SHAPE, N, V, X, assert_moments, condition, denoiser, measurement, moments, sample

NOISE = 0.3
EXACT = {"likelihood": ExactDraw(20, 1e-12), "noise": NOISE}


def one_draw(iterations, **settings):
    return PnPDM(iterations, burn_in=iterations - 1, thinning=1, **settings)


def drawn(settings, cases, data=None):
    return sample(settings, random_like((cases, *SHAPE), seed=11), data)


def blurred(rho):
    """The posterior of data whose noise has covariance noise^2 I + rho^2 A A'."""
    m, mean = measurement(), denoiser().mean.flatten()
    noise = NOISE**2 * torch.eye(4).double() + rho**2 * m.matrix @ m.matrix.T
    gain = V * m.matrix.T @ torch.linalg.inv(V * m.matrix @ m.matrix.T + noise)
    return mean + gain @ (m.y[0] - m.background - m.matrix @ mean), V * (torch.eye(N).double() - gain @ m.matrix)


@pytest.mark.parametrize("rho", [0.1, 0.3])
@pytest.mark.parametrize("likelihood", [ExactDraw(20, 1e-12), Langevin(400, 2e-3, 1.0)])
def test_at_a_constant_coupling_the_states_have_the_blurred_posterior(rho, likelihood):
    levels = 300 if isinstance(likelihood, ExactDraw) else 200
    iterations = 10 if rho == 0.3 else 24  # the tighter, the longer a state remembers the one before
    settings = one_draw(iterations, rho_max=rho, rho_min=rho, levels=levels, likelihood=likelihood, noise=NOISE)
    assert_moments(drawn(settings, 3000), *blurred(rho), 0.015, 0.08 if isinstance(likelihood, ExactDraw) else 0.15)


def test_as_the_coupling_tightens_the_annealed_states_tend_to_the_posterior():
    mean, covariance = condition(measurement(), denoiser().mean, V, NOISE)
    assert_moments(drawn(one_draw(120, rho_min=0.04, levels=200, **EXACT), 3000), mean, covariance, 0.015, 0.1)


def test_the_mean_of_many_states_is_nearer_the_posterior_mean_than_one_of_them():
    mean, _ = blurred(0.1)
    errors = [(drawn(settings, 200).flatten(1) - mean).norm() for settings in (
        PnPDM(160, rho_min=0.1, levels=30, burn_in=40, thinning=3, **EXACT), one_draw(160, levels=30, **EXACT))]
    assert errors[0] < 0.5 * errors[1]


def test_several_samples_differ_as_much_as_the_posterior_is_wide_although_one_result_is_a_mean():
    _, covariance = blurred(0.1)
    averaging = PnPDM(30, rho_max=0.1, rho_min=0.1, levels=100, burn_in=0, thinning=1, **EXACT)
    several, means = (float(moments(drawn(settings, 2000))[1].trace() / covariance.trace())
                      for settings in (averaging.for_sampling(), averaging))
    assert several == pytest.approx(1, abs=0.2) and means < 0.5


def test_data_without_weight_leave_the_prior():
    settings = one_draw(8, rho_max=0.5, levels=300, likelihood=ExactDraw(), noise=1e6)
    assert_moments(drawn(settings, 3000), denoiser().mean, V * torch.eye(N).double(), 0.015, 0.08)


def test_exact_data_are_met_within_the_blur_and_closer_as_the_coupling_tightens_and_with_more_conjugate_gradients():
    m, noise = measurement(), 0.05
    m.y = m.project(denoiser().mean + V**0.5 * X)

    def misfit(iterations, inner=6):
        settings = one_draw(iterations, levels=30, rho_min=0.02, likelihood=ExactDraw(inner, 1e-12), noise=noise)
        return float((m.project(drawn(settings, 1000, m)) - m.y).square().mean().sqrt())

    levels, inner = [misfit(n) for n in (20, 40, 60, 80)], [misfit(60, n) for n in (0, 1, 2, 3)]
    for misfits in (levels, inner):
        assert all(after < before for before, after in itertools.pairwise(misfits)), misfits
    assert levels[-1] < (2 * (noise**2 + (0.02 * m.norm())**2)) ** 0.5
