"""Split Gibbs on a Gaussian prior and a linear measurement meets the closed-form posterior."""

from dataclasses import dataclass, replace

import pytest
import torch
from laws import random_like
from scenes import block

from phydict.datasets import phantom_case
from phydict.diffusion import CosineSchedule, GaussianDenoiser, renoise
from phydict.grid import Grid
from phydict.posterior import LikelihoodStep, Measurement, PriorOnly, ProximalCG, SplitGibbs, ddim_sample
from phydict.units import HUWindow
from phydict.xray import ConeBeam, Projector
from posterior.dense import FINE, SHAPE, DenseMeasurement, V, X, condition, denoiser, measurement, propagate, sample
from posterior.hollow import fine_scene, measured

NOISE = 0.3
EXACT = ProximalCG(50, noise=NOISE, tolerance=1e-12)


@dataclass(frozen=True)
class NoData(LikelihoodStep):
    """A likelihood that knows nothing."""

    def __call__(self, measurement, x0, x0_std):
        return x0


def sampler(iterations=30, **settings):
    return SplitGibbs(iterations, **{"likelihood": EXACT, "prior_std": V**0.5} | settings)


@pytest.mark.parametrize("t", [0.1, 0.5, 0.95])
def test_one_likelihood_step_is_the_exact_posterior_mean_given_the_noisy_state_and_the_data(t):
    prior, m = denoiser(), measurement()
    a, s = (float(w) for w in FINE.scales(t))
    x = a * prior.mean + 0.2 * X
    spread = sampler().x0_std(prior, t)
    assert spread**2 == pytest.approx(V * s**2 / (a**2 * V + s**2))  # the variance of x_0 given x_t
    z = EXACT(m, prior.denoise(x, t), spread)
    # the same mean from one stacked observation of x_0: x_t = a x_0 + s eps, and y
    precision = m.matrix.T @ m.matrix / NOISE**2 + torch.eye(6).double() * (1 / V + (a / s) ** 2)
    shift = m.matrix.T @ (m.y[0] - m.background) / NOISE**2 + (prior.mean / V + a / s**2 * x).flatten()
    torch.testing.assert_close(z.flatten(), torch.linalg.solve(precision, shift), atol=1e-8, rtol=0)


@pytest.mark.parametrize("final", [None, EXACT])
def test_the_samples_have_the_posteriors_mean_and_covariance_as_the_steps_grow(final):
    prior = denoiser()
    mean, covariance = condition(measurement(), prior.mean, V, NOISE)
    assert (covariance - V * torch.eye(6).double()).norm() > 0.5 * covariance.norm()  # the data say something
    errors = []
    for n in (50, 200):
        found, spread = propagate(lambda x: sample(sampler(n, final_likelihood=final), x))
        errors.append(float((spread - covariance).norm() / covariance.norm()))
        assert (found - mean).abs().max() < 0.2 / n
    assert errors[1] < 0.05 and errors[0] / errors[1] > 3  # first order in the step


def test_a_guided_last_estimate_fits_the_data_better_and_an_unguided_one_is_the_denoisers():
    m, few = measurement(), 5
    step = ProximalCG(50, noise=0.01, tolerance=1e-12)
    tight = {"likelihood": step}
    misfit = [float((m.project(sample(sampler(few, final_likelihood=final, **tight))) - m.y).norm())
              for final in (None, step)]
    assert misfit[1] < 0.2 * misfit[0]
    once = sample(sampler(1, **tight))
    torch.testing.assert_close(once, denoiser().denoise(X, 1.0))


def test_data_without_weight_leave_the_prior():
    expected = PriorOnly(30).sample(denoiser(), None, X, None)
    for likelihood in (ProximalCG(50, noise=1e6), NoData()):
        found = sample(sampler(likelihood=likelihood, final_likelihood=likelihood))
        torch.testing.assert_close(found, expected, atol=1e-8, rtol=0)


def test_exact_data_are_matched():
    matrix = torch.eye(6).double()[[0, 3]]
    m = DenseMeasurement(matrix, torch.tensor([0.3, -0.2]).double())
    trusting = ProximalCG(50, noise=1e-6, tolerance=1e-12)
    found = sample(sampler(30, likelihood=trusting, final_likelihood=trusting), data=m).flatten()
    torch.testing.assert_close(found[[0, 3]], m.y[0], atol=1e-6, rtol=0)
    free = PriorOnly(30).sample(denoiser(), None, X, None).flatten()
    rest = [1, 2, 4, 5]
    torch.testing.assert_close(found[rest], free[rest], atol=1e-8, rtol=0)  # the others stay the prior's


def test_only_the_ct_channel_meets_the_data():
    x = random_like((1, 3, *SHAPE[1:]), seed=11)
    prior = GaussianDenoiser(torch.zeros(()).double(), torch.tensor(V).double(), FINE)
    found = sample(sampler(final_likelihood=EXACT), x, prior=prior)
    free = PriorOnly(30).sample(prior, None, x, None)
    assert torch.equal(found[:, 1:], free[:, 1:]) and not torch.allclose(found[:, :1], free[:, :1])


def test_estimates_stay_in_the_priors_range():
    m = DenseMeasurement(torch.eye(6).double(), torch.full((6,), 7.0).double())
    found = sample(sampler(likelihood=ProximalCG(50, noise=1e-4), final_likelihood=EXACT), data=m)
    assert found.max() == 1


@pytest.mark.parametrize("t_start", [0.4, 0.7])
def test_a_warm_start_keeps_the_posterior_mean_and_counts_its_steps(t_start):
    warm = sampler(20, t_start=t_start, final_likelihood=EXACT)
    pairs = warm.times(denoiser())
    assert len(pairs) == 20 and pairs[0] == (1.0, t_start) and pairs[-1][1] == 0
    assert [s for _, s in pairs[:-1]] == [t for t, _ in pairs[1:]]
    mean, covariance = condition(measurement(), denoiser().mean, V, NOISE)
    found, spread = propagate(lambda x: sample(warm, x))
    torch.testing.assert_close(found, mean, atol=5e-3, rtol=0)
    assert spread.trace() < covariance.trace()  # it starts at the mean: less spread, never more


def test_a_warm_start_at_one_is_the_plain_descent():
    assert torch.equal(sample(sampler(12, t_start=1.0)), sample(sampler(12)))


def test_refining_from_zero_is_the_identity():
    assert torch.equal(sample(sampler(12, ec_delta=0.0, ec_steps=9)), sample(sampler(12)))


def test_refining_a_little_keeps_the_sample_and_refining_from_near_one_forgets_it():
    other = DenseMeasurement(measurement().matrix, -measurement().y[0])
    plain = [sample(sampler(), data=m) for m in (measurement(), other)]
    apart = (plain[0] - plain[1]).norm()

    def refined(delta):
        return [sample(sampler(ec_delta=delta, ec_steps=30), data=m) for m in (measurement(), other)]

    little, much = refined(0.001), refined(0.999)
    assert (little[0] - plain[0]).norm() < 0.15 * apart
    assert (much[0] - much[1]).norm() < 0.01 * apart


def test_refining_is_the_prior_seen_from_the_renoised_sample():
    noise = torch.randn(X.shape, generator=torch.Generator().manual_seed(0), dtype=X.dtype)
    start = renoise(FINE, sample(sampler()), 0.8, noise)
    expected = ddim_sample(denoiser(), start, 15, 0.8)
    torch.testing.assert_close(sample(sampler(ec_delta=0.8, ec_steps=15)), expected)


def test_without_fresh_noise_nothing_is_drawn_and_with_it_the_draw_decides():
    for drawless in (sampler(), sampler(noise_fraction=0.0)):
        torch.testing.assert_close(sample(drawless, seed=1), sample(drawless, seed=2), rtol=0, atol=1e-12)
    noisy = sampler(noise_fraction=0.5)
    assert torch.equal(sample(noisy, seed=1), sample(noisy, seed=1))
    assert not torch.allclose(sample(noisy, seed=1), sample(noisy, seed=2))


@pytest.mark.parametrize("path", [{}, {"t_start": 0.4, "t_end": 0.2}, {"momentum": 0.75},
                                  {"ec_delta": 0.9, "ec_steps": 20, "ec_guided": True},
                                  {"t_end": 0.2, "ec_delta": 0.5, "ec_steps": 20, "ec_guided": True}])
def test_a_descent_without_noise_ends_at_the_posterior_mean(path):
    mean, _ = condition(measurement(), denoiser().mean, V, NOISE)
    found = sample(sampler(20, noise_fraction=0.0, final_likelihood=EXACT, **path))
    torch.testing.assert_close(found.flatten(), mean.flatten(), atol=2e-3, rtol=0)


def test_the_last_level_is_where_the_settings_say():
    times = sampler(5, t_start=0.5, t_end=0.2).times(denoiser())
    assert [t for t, _ in times] == pytest.approx([1.0, 0.5, 0.4, 0.3, 0.2]) and times[-1][1] == 0


@pytest.mark.parametrize("settings", [
    sampler(9), sampler(9, t_start=0.5), sampler(9, ec_delta=0.4, ec_steps=5),
    sampler(9, ec_delta=0.4, ec_steps=5, ec_guided=True, final_denoise=True),
    sampler(9, t_end=0.2, ec_delta=0.1, ec_steps=5, ec_guided=True)])
def test_on_step_is_called_as_often_as_promised(settings):
    calls = []
    settings.sample(denoiser(), measurement(), X, torch.Generator(), lambda: calls.append(1))
    assert len(calls) == settings.steps()


@pytest.mark.parametrize("settings, message", [
    ({"iterations": 0}, "SplitGibbs.iterations"), ({"iterations": 2.5}, "whole number, but 2.5"),
    ({"t_start": 0.0}, "t_start"),
    ({"t_start": 1.2}, "t_start"), ({"prior_std": 0.0}, "prior_std"), ({"prior_std": -0.5}, "prior_std"),
    ({"ec_delta": 1.0}, "ec_delta"), ({"ec_delta": -0.1}, "ec_delta")])
def test_impossible_settings_are_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        SplitGibbs(**settings)


@pytest.mark.parametrize("settings", [
    {"ec_delta": 0.8, "ec_steps": 0}, {"iterations": 1, "t_start": 0.7},
    {"noise_fraction": 1.5}, {"noise_fraction": -0.1}, {"momentum": 0.5},
    {"noise_fraction": 0.0, "momentum": 1.5}, {"t_end": 0.8, "t_start": 0.5}])
def test_settings_that_contradict_each_other_are_refused_before_the_long_computation(settings):
    with pytest.raises(ValueError):
        SplitGibbs(**settings)


def test_the_result_does_not_depend_on_the_default_schedules_ends():
    coarse = GaussianDenoiser(denoiser().mean, torch.tensor(V).double(), CosineSchedule())
    fine, wide = (sample(sampler(100, final_likelihood=EXACT), prior=p) for p in (denoiser(), coarse))
    assert (fine - wide).abs().max() < 0.01


@pytest.mark.parametrize("scatter", [0.0, 0.05])
def test_scatter_is_looked_for_where_the_xrays_are_missed_and_otherwise_costs_and_changes_nothing(scatter):
    grid, window = Grid.cube(24), HUWindow()
    projector = Projector(grid, ConeBeam.orbit(6, 1020, 740, (48, 48), 11.5), full_detector=True)
    truth = phantom_case(7, grid, window)["volume"][None]
    y = -torch.log(torch.exp(-projector(window.to_mu(truth))[0]) + scatter)
    y = y + 0.005 * random_like(y.shape, torch.float32)
    prior = GaussianDenoiser(0.8 * truth, torch.tensor(0.04))
    settings = SplitGibbs(4, ProximalCG(noise=0.02), ProximalCG(10, 5, noise=0.02, refit_scatter=True),
                          t_start=0.9, t_end=0.2, noise_fraction=0.0)
    found = {}
    for seek in (False, True):
        m = Measurement(projector, y, window, noise=0.005 / float(y.max()))
        x = random_like((2, 1, 24, 24, 24), torch.float32)
        z = replace(settings, scatter=seek).sample(prior, m, x, torch.Generator())
        found[seek] = z, float((z - truth).norm()), m.calls
    if scatter:
        assert found[True][1] < 0.8 * found[False][1]
    else:
        torch.testing.assert_close(found[True][0], found[False][0], atol=0, rtol=0)
        assert found[True][2] == found[False][2] + 2  # to see what is missed


@torch.no_grad()
@pytest.mark.parametrize("wrong", ["nothing", "finer voxels", "a tube's bend"])
def test_what_the_model_lacks_is_looked_for_where_the_xrays_are_missed_and_otherwise_changes_nothing(wrong):
    m, truth = fine_scene(noise=1e-3) if wrong == "finer voxels" else (measured(noise=1e-3), block())
    if wrong == "a tube's bend":
        m.measured = m.y = m.y - 0.03 * m.y * (m.y - 4)
    prior, parts = GaussianDenoiser(0.9 * truth, torch.tensor(0.04)), {"hardening": True, "subgrid": ProximalCG(10, 2)}
    plain = SplitGibbs(4, ProximalCG(), ProximalCG(10, 5, noise=0.01), t_start=0.9, t_end=0.2, noise_fraction=0.0)
    x = random_like((2, *truth.shape[1:]), torch.float32)
    errors = []
    for settings in (plain, replace(plain, **parts)):
        errors.append(float((settings.sample(prior, m, x, torch.Generator()) - truth).norm()))
    assert m.hardened == (wrong == "a tube's bend") and isinstance(m.subgrid, torch.Tensor) == (wrong != "nothing")
    assert errors[1] == errors[0] if wrong == "nothing" else errors[1] < 0.97 * errors[0]
