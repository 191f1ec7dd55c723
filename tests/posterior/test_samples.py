"""Several samples: their mean and standard deviation, each its own whatever is drawn beside it."""

from dataclasses import replace

import pytest
import torch
from laws import random_like
from prior.tiny import tiny_prior
from torch.nn.functional import pad

from phydict import reconstruct
from phydict.diffusion import noise_like
from phydict.methods import METHODS
from phydict.posterior import GradientSteps, Measurement, Posterior, PriorOnly, ProximalCG, Reward, SplitGibbs
from phydict.posterior.posterior import sample_seed
from phydict.xray import ConeBeam, Projector
from phydict.xray.boxes import divided, part
from phydict.xray.carried import RAYS, Carried
from posterior.dense import SHAPE, N, measurement
from posterior.scene import BEAM, GRID, PROJECTOR, views

SAMPLER = SplitGibbs(4, ProximalCG(3), ProximalCG(3), t_start=0.7, noise_fraction=0.0, sampling_noise=0.6)


@pytest.fixture(scope="module")
def method():
    return Posterior(tiny_prior(), SAMPLER, precision="float32")


def drawn(method, n, batch=4, display=False):
    return replace(method, samples=n, batch=batch).reconstruct(views(), PROJECTOR, display=display, seed=5)


@pytest.mark.parametrize("display", [False, True])
def test_mean_and_deviation_are_those_of_samples_that_do_not_depend_on_their_number_or_on_how_they_are_batched(
        method, display):
    alone = replace(method, sampler=SAMPLER.for_sampling())
    single = torch.stack([alone.reconstruct(views(), PROJECTOR, display=display, seed=sample_seed(5, i)).volume
                          for i in range(3)])
    for n, batch in ((2, 4), (3, 1), (3, 2), (3, 3)):
        several = drawn(method, n, batch, display)
        torch.testing.assert_close(several.volume, single[:n].mean(0), atol=0.05, rtol=0)
        torch.testing.assert_close(several.deviation, single[:n].std(0), atol=0.05, rtol=0)
    assert single.std(0).mean() > 5


@pytest.mark.parametrize("display", [False, True])
@pytest.mark.parametrize("sampler", [
    replace(METHODS["phydict_fast"], iterations=3), replace(SAMPLER, subgrid=ProximalCG(3)),
    replace(SAMPLER, final_likelihood=ProximalCG(10, tv_weight=10.0, discrepancy=True)),
    replace(SAMPLER, final_likelihood=ProximalCG(3, weighted_least_squares=True)),
    replace(SAMPLER, likelihood=GradientSteps(1, reward=Reward(1.0, random_backbone=True, dropout=True, squared=0)))],
    ids=["phydict_fast", "subgrid", "discrepancy", "own noise", "dropout"])
def test_what_is_sought_beside_a_sample_does_not_depend_on_those_drawn_with_it(method, sampler, display):
    wide = Projector(GRID, ConeBeam.orbit(4, 1020, 740, (16, 16), 40.0))  # the fewest pixels that LPIPS takes
    alone, together = (replace(method, sampler=sampler, samples=3, batch=batch).reconstruct(
        pad(views(), (1, 1, 1, 1)), wide, display=display, seed=5) for batch in (1, 3))
    torch.testing.assert_close(together.volume, alone.volume, atol=0.05, rtol=0)
    torch.testing.assert_close(together.deviation, alone.deviation, atol=0.05, rtol=0)


def test_one_sample_is_the_samplers_own_result_without_a_deviation(method):
    one = drawn(method, 1)
    assert one.deviation is None
    draw = torch.Generator().manual_seed(5)
    x = torch.randn((1, method.prior.state_channels, 16, 16, 16), generator=draw)
    m = Measurement(PROJECTOR, views(), method.prior.window)
    expected = SAMPLER.sample(method.prior.bind(precision="float32"), m, x, draw)
    assert torch.equal(one.volume, method.prior.window.to_hu(expected[0, 0]))


def test_misfit_and_reprojection_belong_to_the_mean_and_calls_are_counted_per_sample(method):
    several, one = drawn(method, 3, 2), drawn(method, 1)
    again = PROJECTOR(method.prior.window.to_mu(method.prior.window.to_range(several.volume))[None, None])[0]
    torch.testing.assert_close(several.reprojection, again, atol=1e-4, rtol=1e-4)
    assert several.network_calls == 3 * one.network_calls
    calls = []
    ready = replace(method, samples=3, batch=2)
    ready.reconstruct(views(), PROJECTOR, on_step=lambda: calls.append(1))
    assert len(calls) == ready.steps() == 2 * SAMPLER.steps()


def test_what_a_sample_finds_beside_the_ct_is_its_own_and_in_the_mean_and_the_deviation(method):
    alone, window = [], method.prior.window

    class Finding(PriorOnly):
        def sample(self, denoiser, measurement, x, generator, on_step=lambda: None):
            assert measurement.carried is None and not measurement.hardened
            z, n = (0.1 * x).clamp(-1, 1), len(alone)
            if n != 1:
                box = part(divided(GRID, RAYS), [slice(8 + 2 * n, 14 + 2 * n), slice(10, 14), slice(6, 10)])
                measurement.carry(Carried(torch.full(box.shape, 1000.0 + 500 * n), box))
                measurement.straighten()
            alone.append(window.to_hu(z[0, 0]) + (measurement.carried.on(GRID) if measurement.carried else 0.0))
            return z

    finding = replace(method, sampler=Finding(1), samples=3, batch=1)
    with pytest.warns(UserWarning, match="as dense as metal"):
        found = finding.reconstruct(views(), PROJECTOR)
    each = torch.stack(alone)
    torch.testing.assert_close(found.volume, each.mean(0), atol=1e-2, rtol=0)
    torch.testing.assert_close(found.deviation, each.std(0), atol=1e-2, rtol=0)
    within = PROJECTOR(window.to_mu(window.to_range(found.within))[None, None])[0]
    torch.testing.assert_close(found.reprojection, within + found.carried.projection(PROJECTOR), atol=1e-4, rtol=1e-4)


def test_the_x_rays_narrow_the_samples(method):
    free = drawn(replace(method, sampler=PriorOnly(4)), 3).deviation
    assert drawn(method, 3).deviation.mean() < 0.8 * free.mean()


def test_the_states_of_a_batch_do_not_influence_each_others_conjugate_gradients():
    m = measurement(4)
    x0 = 0.3 * random_like((3, *SHAPE), seed=30)
    x0[1:2] = ProximalCG(40, noise=1e-5, tolerance=1e-12)(m, x0[1:2], 0.5)  # fits already: stops at once
    step = ProximalCG(3, noise=0.1)
    together = step(m, x0, 0.5)
    for row, own in zip(together, x0):
        torch.testing.assert_close(row[None], step(m, own[None], 0.5), atol=1e-12, rtol=0)
    assert together.isfinite().all() and together[0].numel() == N


def test_one_generator_per_state_draws_what_each_draws_alone():
    draws = [torch.Generator().manual_seed(s) for s in (1, 2)]
    both = noise_like(torch.empty(2, 3, 4), draws)
    for row, s in zip(both, (1, 2)):
        assert torch.equal(row, torch.randn(1, 3, 4, generator=torch.Generator().manual_seed(s))[0])


@pytest.mark.parametrize("settings", [{"samples": 0}, {"samples": 2, "batch": 0}])
def test_impossible_numbers_are_refused(method, settings):
    with pytest.raises(ValueError, match="1 or more"):
        replace(method, **settings)


def test_a_method_without_a_prior_has_no_samples():
    with pytest.raises(ValueError, match="leave samples out"):
        reconstruct(views(), BEAM, method="sirt", samples=2)
