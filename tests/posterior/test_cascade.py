"""Reconstruction in two stages: what each is given, what guidance adds, and what a result depends on."""

from dataclasses import dataclass, replace

import pytest
import torch
from laws import random_like
from prior.medsyn_files import super_resolution_unet
from prior.tiny import tiny_prior, tiny_super_resolution
from torch.nn.functional import interpolate

from phydict.diffusion import CosineSchedule, GaussianDenoiser
from phydict.grid import Grid
from phydict.methods import METHODS
from phydict.posterior import CascadePosterior, Posterior, PriorOnly, ProximalCG, SplitGibbs, Unrolled
from phydict.prior import Cascade, MedSynSuperResolution, PriorContract
from phydict.units import MU_WATER, HUWindow
from phydict.xray import ConeBeam, Projector, binned
from phydict.xray.calibration import without_hardening

BEAM = ConeBeam.orbit(4, 1020, 740, (56, 56), 10.0)
FINE = Grid.cube(32)
PROJECTOR = Projector(FINE, BEAM, full_detector=True)
SAMPLER = SplitGibbs(3, ProximalCG(4), ProximalCG(4), t_start=0.5, t_end=0.3, noise_fraction=0.0)


@dataclass
class GaussianStage:
    """A stage in closed form: given the coarse CT, fine ones are N(its upsampling, variance), independent by voxel."""

    variance: float
    grid = FINE
    window = HUWindow(-1000, 600)
    schedule = CosineSchedule(offset=1e-3, floor=1e-6)
    state_channels, coarse_channels, factor = 1, 1, 2
    default_noise = 0.05

    def upsample(self, coarse):
        return interpolate(coarse, scale_factor=2, mode="trilinear")

    def check_memory(self, dtype):
        pass

    def bind(self, coarse, noise=0.0, precision="auto", generator=None):
        return GaussianDenoiser(self.upsample(coarse), torch.tensor(self.variance), self.schedule)


@pytest.fixture(scope="module")
def xrays():
    """Line integrals of a block of soft tissue with a hollow, finer than the base grid."""
    mu = torch.zeros(1, 1, *FINE.shape)
    mu[:, :, 6:26, 8:24] = 0.02
    mu[:, :, 9:14, 12:19, 10:23] = 0.005
    return PROJECTOR(mu)[0]


@pytest.fixture(scope="module")
def cascade():
    return Cascade(tiny_prior(False), tiny_super_resolution())


def gaussian(variance=1e-2, **settings):
    stages = Cascade(tiny_prior(False), GaussianStage(variance))
    return CascadePosterior(stages, SAMPLER, precision="float32", **settings)


def base_alone(xrays, seed=3, kind="auto"):
    """The base stage's reconstruction by itself, in the prior's range, upsampled."""
    half = BEAM.binned(2)
    result = Posterior(tiny_prior(False), SAMPLER, precision="float32").reconstruct(
        binned(xrays, 2), Projector(Grid.cube(16), half, kind, full_detector=True), seed=seed)
    coarse = HUWindow(-1000, 600).to_range(result.volume)[None, None]
    return interpolate(coarse, scale_factor=2, mode="trilinear")


@pytest.mark.parametrize("kind", ["auto", "siddon"])
def test_unguided_and_without_detail_it_is_the_base_stages_result_upsampled(xrays, kind):
    method = gaussian(1e-12, sr_guided=False, noise=0.0)
    found = method.reconstruct(xrays, Projector(FINE, BEAM, kind, full_detector=True), seed=3)
    expected = HUWindow(-1000, 600).to_hu(base_alone(xrays, kind=kind))[0, 0]
    torch.testing.assert_close(found.volume, expected, atol=0.1, rtol=0)
    assert found.grid.same_as(FINE)


def test_what_the_x_rays_hold_beside_the_ct_is_as_the_base_stage_found_it():
    sampler = METHODS["phydict_fast"]
    assert sampler.scatter and sampler.hardening and sampler.metal
    second = CascadePosterior(Cascade(tiny_prior(False), tiny_super_resolution()), SAMPLER, sr_sampler=sampler).second
    assert not (second.scatter or second.hardening or second.metal) and second.iterations == sampler.iterations


def test_no_setting_of_the_second_stage_s_own_sampler_is_without_effect():
    own = CascadePosterior(Cascade(tiny_prior(False), GaussianStage(1e-2)), SAMPLER).sr_sampler
    denoiser = GaussianDenoiser(torch.zeros(1), torch.ones(1))
    assert own.t_end is None and own.times(denoiser) == [(1.0, 0.3), (0.3, 0.0)]


def test_a_projector_of_one_s_own_leaves_the_base_stage_to_phydict_s(xrays):
    class Own:
        grid, beam, method = FINE, BEAM, "mine"
        __call__, T, norm = PROJECTOR.__call__, PROJECTOR.T, PROJECTOR.norm

    method = gaussian(1e-12, sr_guided=False, noise=0.0)
    with pytest.warns(UserWarning, match="Own projects its own voxels alone"):
        found = method.reconstruct(xrays, Own(), seed=3)
    assert torch.equal(found.volume, method.reconstruct(xrays, PROJECTOR, seed=3).volume)


def test_guided_it_is_the_posterior_mean_of_a_gaussian_stage(xrays):
    """At time 1 the state tells nothing: one likelihood step there ends at the mean of p(x | coarse, Y)."""
    solve = ProximalCG(iterations=300, restarts=20, noise=1.0, tolerance=1e-7)
    one = SplitGibbs(1, ProximalCG(), final_likelihood=solve, prior_std=0.1)
    found = gaussian(0.01, sr_sampler=one, noise=0.0).reconstruct(xrays, PROJECTOR, seed=3)
    x, mean = HUWindow(-1000, 600).to_range(found.volume)[None, None], base_alone(xrays).clamp(-1, 1)
    slope, offset = HUWindow(-1000, 600).mu_affine()
    residual = xrays[None] - PROJECTOR(slope * x + offset)
    negative_gradient = slope * PROJECTOR.T(residual) + (mean - x) / 0.1**2
    inside = x.abs() < 1 - 1e-6
    assert inside.float().mean() > 0.1
    start = slope * PROJECTOR.T(xrays[None] - PROJECTOR(slope * mean + offset))
    assert negative_gradient[inside].norm() < 5e-3 * start[inside].norm()


def test_the_xrays_guide_the_fine_stage_only_if_asked(xrays):
    guided, unguided = (gaussian(sr_guided=flag).reconstruct(xrays, PROJECTOR, seed=3) for flag in (True, False))
    assert guided.misfit < 0.3 * unguided.misfit
    assert guided.projector_calls > unguided.projector_calls


def test_display_values_are_calibrated_at_both_stages(xrays):
    method = gaussian(noise=0.0)
    displayed = 7.0 + 3.0 * xrays
    found = method.reconstruct(displayed, PROJECTOR, display=True, seed=3)
    assert (found.xrays - found.reprojection).norm() < 0.2 * found.xrays.norm()
    assert found.xrays.std() == pytest.approx(float(xrays.std()), rel=0.5)


@pytest.mark.parametrize("scatter", [0.0, 0.05])
def test_scatter_that_the_base_stage_finds_is_subtracted_at_both_stages(xrays, scatter):
    step = ProximalCG(10, 5, refit_scatter=True)
    base = SplitGibbs(3, ProximalCG(4), step, t_start=0.5, t_end=0.3, noise_fraction=0.0, scatter=True)
    measured = -torch.log(torch.exp(-xrays) + scatter) + 0.005 * random_like(xrays.shape, torch.float32)
    found = replace(gaussian(), sampler=base).reconstruct(measured, PROJECTOR, seed=3)
    if scatter:
        assert found.scatter == pytest.approx(float((scatter * torch.exp(measured)).mean()), rel=0.3)
        assert (found.xrays - xrays).norm() < 0.5 * (measured - xrays).norm()
    else:
        assert found.scatter == 0 and found.xrays.equal(measured)


class Finding(CascadePosterior):
    """One whose base stage finds what `found` says, beside what it finds."""

    found = {}

    def _base(self, *args):
        return replace(super()._base(*args), **self.found)


def test_what_the_base_stage_straightened_or_took_for_noise_is_so_at_the_second_stage(xrays):
    doubted = torch.tensor([0.0, 1.0, 0.0, 0.0])[:, None, None]
    plain, straight, doubting = (type("Found", (Finding,), {"found": found})(
        Cascade(tiny_prior(False), GaussianStage(1e-2)), SAMPLER, precision="float32").reconstruct(
            xrays, PROJECTOR, seed=3) for found in ({}, {"hardened": True}, {"model_variance": doubted}))
    torch.testing.assert_close(straight.xrays, without_hardening(plain.xrays, MU_WATER))
    assert straight.hardened and not plain.hardened and torch.equal(doubting.model_variance, doubted)
    assert doubting.misfit_per_view[1] > 1.2 * plain.misfit_per_view[1]


class CTAlone(PriorContract):
    """A prior without masks."""

    grid, window = Grid.cube(16), HUWindow(-1000, 600)

    def bind(self, report="", guidance=1.0, precision="auto"):
        return GaussianDenoiser(torch.full((1, 1, *self.grid.shape), -0.5), torch.tensor(0.1), GaussianStage.schedule)


def test_a_prior_without_masks_has_a_second_stage(xrays):
    found = CascadePosterior(Cascade(CTAlone(), GaussianStage(1e-2)), SAMPLER).reconstruct(xrays, PROJECTOR, seed=3)
    assert found.volume.shape == FINE.shape and found.masks.shape == (0, *FINE.shape)


def medsyn_stage():
    """MedSyn's second stage, narrow, on the cube and window of the other stages here."""
    stage = MedSynSuperResolution(super_resolution_unet(), FINE)
    stage.window, stage.factor = HUWindow(-1000, 600), 2
    return stage


@pytest.mark.parametrize("guide", [True, False])
def test_medsyns_second_stage_goes_on_where_the_base_stage_found_scatter(xrays, guide):
    step = ProximalCG(10, 5, refit_scatter=True)
    base = SplitGibbs(3, ProximalCG(4), step, t_start=0.5, t_end=0.3, noise_fraction=0.0, scatter=True)
    measured = -torch.log(torch.exp(-xrays) + 0.05) + 0.005 * random_like(xrays.shape, torch.float32)
    method = CascadePosterior(Cascade(tiny_prior(False), medsyn_stage()), base, guide, unguided=PriorOnly(2))
    found = method.reconstruct(measured, PROJECTOR, seed=3)
    assert found.scatter > 0 and (found.xrays - xrays).norm() < 0.5 * (measured - xrays).norm()


def test_medsyns_second_stage_unguided_ends_with_a_call_at_time_zero(xrays):
    steps, times, stage = [], [], medsyn_stage()
    stage.network.register_forward_pre_hook(lambda _, inputs: times.append(float(inputs[1])))
    method = CascadePosterior(Cascade(tiny_prior(False), stage), SAMPLER, False, unguided=PriorOnly(4))
    found = method.reconstruct(xrays, PROJECTOR, on_step=lambda: steps.append(1))
    assert times == [1, 0.75, 0.5, 0.25, 0] and found.network_calls == len(steps) == method.steps() == 3 + 5


def test_a_second_stage_without_enough_memory_is_refused_before_the_first_is_run(xrays):
    steps, stage = [], medsyn_stage()
    stage.memory = 2**20
    method = CascadePosterior(Cascade(tiny_prior(False), stage), SAMPLER)
    with pytest.raises(ValueError, match="super_resolution.memory"):
        method.reconstruct(xrays, PROJECTOR, on_step=lambda: steps.append(1))
    assert not steps


def test_the_noise_of_the_coarse_volume_is_the_stages_own_unless_given(cascade):
    medsyn = Cascade(tiny_prior(False), medsyn_stage())
    assert CascadePosterior(cascade).level == 0.05 and CascadePosterior(medsyn).level == 0
    assert CascadePosterior(cascade, noise=0.0).level == 0 and CascadePosterior(medsyn, noise=0.2).level == 0.2


@pytest.mark.parametrize("guide", [True, False])
def test_the_same_seed_gives_the_same_bits_and_another_seed_others(cascade, xrays, guide):
    method = CascadePosterior(cascade, SAMPLER, guide, unguided=PriorOnly(3))
    one, again, other = (method.reconstruct(xrays, PROJECTOR, seed=seed) for seed in (3, 3, 4))
    assert torch.equal(one.volume, again.volume) and torch.equal(one.masks, again.masks)
    assert not torch.allclose(one.volume, other.volume)


def test_in_tiles_the_result_is_that_of_the_whole_within_a_tolerance(cascade, xrays):
    method = CascadePosterior(cascade, SAMPLER, unguided=PriorOnly(3), precision="float32")
    tiled = tiny_super_resolution(overlap=8)
    tiled.memory = int(17**3 * tiled.network.bytes_per_voxel)
    assert len(tiled.tiles().starts(32)) == 3
    for guide in (True, False):
        whole, parts = (replace(method, cascade=Cascade(cascade.base, fine), sr_guided=guide).reconstruct(
            xrays, PROJECTOR, seed=3).volume for fine in (cascade.super_resolution, tiled))
        assert 0 < (whole - parts).square().mean().sqrt() < 0.02 * whole.std()


def test_the_noise_given_to_the_coarse_volume_is_used_and_told(cascade, xrays):
    volumes = [CascadePosterior(cascade, SAMPLER, noise=noise).reconstruct(xrays, PROJECTOR, seed=3).volume
               for noise in (0.0, 0.2)]
    assert (volumes[0] - volumes[1]).std() > 1


def test_all_figures_are_finite_and_belong_to_the_volume(cascade, xrays):
    calls = []
    method = CascadePosterior(cascade, SAMPLER, name="both")
    found = method.reconstruct(xrays, PROJECTOR, on_step=lambda: calls.append(1))
    assert len(calls) == method.steps() == 3 + 2 and found.method == "both" and found.network_calls == 5
    assert set(found.seconds) == {"base", "prepare", "sample", "score"}
    assert found.volume.min() >= -1000 and found.volume.max() <= 600
    assert found.masks.shape == (3, *FINE.shape) and found.masks.min() >= 0 and found.masks.max() <= 1
    window = cascade.super_resolution.window
    again = PROJECTOR(window.to_mu(window.to_range(found.volume))[None, None])[0]
    torch.testing.assert_close(found.reprojection, again, atol=1e-4, rtol=1e-4)


def test_xrays_of_another_grid_are_refused(cascade, xrays):
    with pytest.raises(ValueError, match=r"\(32, 32, 32\).*\(16, 16, 16\).*use its grid"):
        CascadePosterior(cascade, SAMPLER).reconstruct(
            xrays, Projector(Grid.cube(16), BEAM, full_detector=True))


def test_a_stage_that_wants_the_full_detector_gets_it(cascade):
    full = replace(SAMPLER, full_detector=True)
    assert CascadePosterior(cascade, full).full_detector
    assert CascadePosterior(cascade, SAMPLER, sr_sampler=full).full_detector
    assert not CascadePosterior(cascade, SAMPLER, False, sr_sampler=full).full_detector


def test_x_rays_in_double_precision_are_those_in_single(cascade, xrays):
    method = CascadePosterior(cascade, SAMPLER, precision="float32")
    double, single = (method.reconstruct(y, PROJECTOR, seed=3) for y in (xrays.double(), xrays))
    assert torch.equal(double.volume, single.volume) and double.precision == single.precision == "float32"


@dataclass(frozen=True)
class Halving(PriorOnly):
    """A sampler of one's own that gives less than it is given."""

    def sample(self, *given):
        return super().sample(*given)[:, :, ::2]


@dataclass(frozen=True)
class Short(PriorOnly):
    """A sampler of one's own that is not called as samplers are."""

    def sample(self, denoiser, x):
        return x


@pytest.mark.parametrize("sampler, words", [
    (Halving(2), "sample of the sampler Halving must return clean states, a tensor of shape"),
    (Short(2), r"sample of the sampler Short is called as \(denoiser, measurement, x, generator, on_step\)")])
def test_a_sampler_of_ones_own_is_checked_at_the_second_stage_as_at_the_first(xrays, sampler, words):
    for method in (gaussian(sr_sampler=sampler), replace(gaussian(), sampler=sampler)):
        with pytest.raises(ValueError, match=words):
            method.reconstruct(xrays, PROJECTOR)


@pytest.mark.parametrize("sampler", [Unrolled(), PriorOnly, "phydict_fast"])
def test_what_cannot_sample_a_second_stage_is_refused(sampler):
    with pytest.raises(ValueError, match="is a Sampler that needs no refiner"):
        gaussian(sr_sampler=sampler)
