"""PnP-DM on a Gaussian prior: its states have the posterior of data blurred by the coupling, and its means the mean."""

import itertools

import pytest
import torch
from laws import random_like

from phydict.posterior import ExactDraw, Langevin, PnPDM
from posterior.dense import SHAPE, N, WithMask, condition, denoiser, measurement, moments

V, NOISE = 0.04, 0.3
EXACT = {"likelihood": ExactDraw(20, 1e-12), "noise": NOISE}
X = random_like((1, *SHAPE), seed=10)


def one_draw(iterations, **settings):
    return PnPDM(iterations, burn_in=iterations - 1, thinning=1, **settings)


def sample(settings, cases=1, data=None, seed=0):
    x = X if cases == 1 else random_like((cases, *SHAPE), seed=11)
    return settings.sample(denoiser(V), data or measurement(), x, torch.Generator().manual_seed(seed))


def blurred(rho):
    """The posterior of data whose noise has covariance noise^2 I + rho^2 A A'."""
    m, mean = measurement(), denoiser(V).mean.flatten()
    noise = NOISE**2 * torch.eye(4).double() + rho**2 * m.matrix @ m.matrix.T
    gain = V * m.matrix.T @ torch.linalg.inv(V * m.matrix @ m.matrix.T + noise)
    return mean + gain @ (m.y[0] - m.background - m.matrix @ mean), V * (torch.eye(N).double() - gain @ m.matrix)


@pytest.mark.parametrize("rho", [0.1, 0.3])
@pytest.mark.parametrize("likelihood", [ExactDraw(20, 1e-12), Langevin(400, 2e-3, 1.0)])
def test_at_a_constant_coupling_the_states_have_the_blurred_posterior(rho, likelihood):
    levels = 300 if isinstance(likelihood, ExactDraw) else 200
    iterations = 10 if rho == 0.3 else 24  # the tighter, the longer a state remembers the one before
    settings = one_draw(iterations, rho_max=rho, rho_min=rho, levels=levels, likelihood=likelihood, noise=NOISE)
    mean, covariance = blurred(rho)
    found, spread = moments(sample(settings, 3000))
    torch.testing.assert_close(found, mean, atol=0.015, rtol=0)
    assert (spread - covariance).norm() < (0.08 if isinstance(likelihood, ExactDraw) else 0.15) * covariance.norm()


def test_as_the_coupling_tightens_the_annealed_states_tend_to_the_posterior():
    mean, covariance = condition(measurement(), denoiser(V).mean, V, NOISE)
    found, spread = moments(sample(one_draw(120, rho_min=0.04, levels=200, **EXACT), 3000))
    torch.testing.assert_close(found, mean, atol=0.015, rtol=0)
    assert (spread - covariance).norm() < 0.1 * covariance.norm()


@pytest.mark.parametrize("alike", [0.0, 0.9])
def test_a_ct_and_a_mask_that_no_x_ray_measures_have_the_spread_of_their_posterior(alike):
    prior, x = WithMask(V, alike), random_like((1500, 2, *SHAPE[1:]), seed=11)
    settings = one_draw(20, rho_max=0.2, rho_min=0.05, levels=150, **EXACT)
    states = settings.sample(prior, measurement(), x, torch.Generator().manual_seed(0))
    found = [float(states[:, i].flatten(1).T.cov().trace()) for i in (0, 1)]
    assert found == pytest.approx(prior.spreads(measurement(), NOISE), rel=0.12)


def test_the_mean_of_many_states_is_nearer_the_posterior_mean_than_one_of_them():
    mean, _ = blurred(0.1)
    errors = [(sample(settings, 200).flatten(1) - mean).norm() for settings in (
        PnPDM(160, rho_min=0.1, levels=30, burn_in=40, thinning=3, **EXACT), one_draw(160, levels=30, **EXACT))]
    assert errors[0] < 0.5 * errors[1]


def test_several_samples_differ_as_much_as_the_posterior_is_wide_although_one_result_is_a_mean():
    _, covariance = blurred(0.1)
    averaging = PnPDM(30, rho_max=0.1, rho_min=0.1, levels=100, burn_in=0, thinning=1, **EXACT)
    several, means = (float(moments(sample(settings, 2000))[1].trace() / covariance.trace())
                      for settings in (averaging.for_sampling(), averaging))
    assert several == pytest.approx(1, abs=0.2) and means < 0.5


def test_data_without_weight_leave_the_prior():
    found, spread = moments(sample(one_draw(8, rho_max=0.5, levels=300, likelihood=ExactDraw(), noise=1e6), 3000))
    torch.testing.assert_close(found, denoiser(V).mean.flatten(), atol=0.015, rtol=0)
    assert (spread / V - torch.eye(N).double()).norm() < 0.08 * N**0.5


def test_exact_data_are_met_within_the_blur_and_closer_as_the_coupling_tightens_and_with_more_conjugate_gradients():
    m, noise = measurement(), 0.05
    m.y = m.project(denoiser(V).mean + V**0.5 * X)

    def misfit(iterations, inner=6):
        settings = one_draw(iterations, levels=30, rho_min=0.02, likelihood=ExactDraw(inner, 1e-12), noise=noise)
        return float((m.project(sample(settings, 1000, m)) - m.y).square().mean().sqrt())

    levels, inner = [misfit(n) for n in (20, 40, 60, 80)], [misfit(60, n) for n in (0, 1, 2, 3)]
    for misfits in (levels, inner):
        assert all(after < before for before, after in itertools.pairwise(misfits)), misfits
    assert levels[-1] < (2 * (noise**2 + (0.02 * m.norm())**2)) ** 0.5


def test_the_result_depends_on_the_seed_alone():
    settings = one_draw(4, levels=10, **EXACT)
    torch.manual_seed(1)
    one = sample(settings, seed=3)
    torch.manual_seed(2)
    assert torch.equal(one, sample(settings, seed=3)) and not torch.allclose(one, sample(settings, seed=4))


@pytest.mark.parametrize("settings", [{"rho_min": 20.0}, {"decay": 1.5}, {"levels": 0}, {"noise": 0.0},
                                      {"burn_in": 98}, {"thinning": 0}, {"noise": 1e-200}])
def test_impossible_settings_are_refused(settings):
    with pytest.raises(ValueError, match=str(next(iter(settings.values())))):
        PnPDM(**settings)
