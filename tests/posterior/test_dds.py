"""DDS on a Gaussian prior meets exact data and keeps the prior where they are silent; its ADMM ends at TV's optimum."""

import itertools

import pytest
import torch
from laws import random_like

from phydict.posterior import ADMMTV, DDS
from phydict.posterior.normalised import NormalisedMeasurement
from posterior.dense import (
    SHAPE,
    DenseMeasurement,
    V,
    X,
    assert_moments,
    condition,
    denoiser,
    measurement,
    propagate,
    sample,
)


@pytest.mark.parametrize("gamma", [None, 100.0])
def test_without_renewal_it_samples_the_posterior_of_exact_data(gamma):
    mean, covariance = condition(measurement(), denoiser().mean, V, 1e-5)
    found, spread = propagate(lambda x: sample(DDS(200, 0.0, 10, gamma), x))
    torch.testing.assert_close(found, mean, atol=1e-3, rtol=0)
    assert (spread - covariance).norm() < 0.05 * covariance.norm()


@pytest.mark.parametrize("eta", [0.5, 0.85])
def test_with_renewal_the_mean_stays_and_the_spread_is_a_known_share(eta):
    mean, covariance = condition(measurement(), denoiser().mean, V, 1e-5)
    samples = sample(DDS(400, eta, 6), random_like((4000, *SHAPE), seed=11))
    assert_moments(samples, mean, (1 + (1 - eta**2) ** 0.5) / 2 * covariance, 0.012, 0.08)


@pytest.mark.parametrize("settings", [{"eta": 0.0}, {"eta": 0.85}, {"gamma": 1.0}])
def test_more_levels_and_more_conjugate_gradients_never_raise_the_misfit_of_exact_data(settings):
    m = measurement()
    m.y = m.project(denoiser().mean + V**0.5 * X)
    starts = random_like((500, *SHAPE), seed=12)

    def misfit(n, inner):
        return float((m.project(sample(DDS(n, cg_iterations=inner, **settings), starts, m)) - m.y).norm())

    levels, inner = [misfit(n, 2) for n in (5, 20, 80)], [misfit(20, n) for n in (1, 2, 3)]
    for misfits in (levels, inner):
        assert all(after <= before for before, after in itertools.pairwise(misfits)), misfits


def line(n=8):
    """Noisy steps along z, seen directly."""
    truth = torch.cat([torch.zeros(n // 2), torch.ones(n - n // 2)]).double()
    y = truth + 0.1 * random_like((n,), seed=5)
    m = DenseMeasurement(torch.eye(n).double(), y)
    m.adjoint = lambda r: r.view(len(r), 1, 1, 1, n)
    return NormalisedMeasurement(m, 1.0), y


def test_passes_of_admm_end_where_the_conditions_of_total_variation_hold():
    m, y = line()
    weight = 0.15
    passes, x = ADMMTV(weight, rho=1.0).begin(torch.zeros(1, 1, 1, 1, 8)), torch.zeros(1, 1, 1, 1, 8).double()
    for _ in range(500):
        x = passes(m, x, 20)
    pull = (x.flatten() - y).cumsum(0)  # x - y = -D' q with |q| <= weight, and q = weight sign(D x) at a step
    steps = x.flatten().diff()
    assert pull[-1].abs() < 1e-6 and pull.abs().max() < weight + 1e-6
    moved = steps.abs() > 1e-6
    assert 0 < moved.sum() < 7
    torch.testing.assert_close(pull[:-1][moved], weight * steps[moved].sign(), atol=1e-6, rtol=0)


def test_the_dual_lives_across_passes_and_not_across_samplings():
    m, y = line()
    start = y.view(1, 1, 1, 1, 8)
    passes = ADMMTV(0.15, 1.0).begin(start)
    assert not torch.allclose(passes(m, start, 20), passes(m, start, 20))
    settings = DDS(6, 0.5, 5, tv=ADMMTV())
    assert torch.equal(sample(settings), sample(settings))


def test_without_weight_total_variation_leaves_the_fit_and_with_much_it_flattens_along_its_axes_alone():
    m = measurement(6)
    m.y = m.project(0.3 * X)
    settings = {"iterations": 200, "eta": 0.0, "cg_iterations": 20}
    fitted = sample(DDS(**settings, tv=ADMMTV(0.0, 0.1)), data=m)
    torch.testing.assert_close(m.project(fitted), m.y, atol=1e-2, rtol=0)
    flat = sample(DDS(**settings, tv=ADMMTV(100.0, 10.0, "z")), data=m)
    assert flat.diff(dim=4).abs().max() < 0.02 and flat.diff(dim=3).abs().max() > 0.1


@pytest.mark.parametrize("settings, message", [
    ({"iterations": 0}, "DDS.iterations .*0 was"), ({"eta": 1.5}, "1.5"), ({"gamma": 0.0}, "DDS.gamma"),
    ({"gamma": 1e-320}, "DDS.gamma"), ({"cg_iterations": 0}, "DDS.cg_iterations"),
    ({"gamma": 1.0, "tv": ADMMTV()}, "leave one out")])
def test_impossible_settings_are_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        DDS(**settings)


@pytest.mark.parametrize("settings, message", [
    ({"axes": "zz"}, "'zz'"), ({"axes": "t"}, "'t'"), ({"axes": ""}, "''"), ({"rho": 0.0}, "ADMMTV.rho"),
    ({"weight": -1.0}, "-1.0")])
def test_impossible_total_variation_is_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        ADMMTV(**settings)
