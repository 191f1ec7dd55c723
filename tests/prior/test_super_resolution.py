"""The super-resolution stage: what it does before training, in tiles, with noise, and on bad input."""

import pytest
import torch
from laws import random_like
from torch.nn.functional import avg_pool3d

from phydict.grid import Grid
from phydict.posterior import ddim_sample
from phydict.prior import LocalUNet, SuperResolution
from phydict.units import HUWindow
from prior.peak import Peak
from prior.tiny import tiny_super_resolution

COARSE = 0.3 * random_like((1, 4, 16, 16, 16), torch.float32, seed=1)
X = random_like((1, 1, 32, 32, 32), torch.float32, seed=2)


def test_untrained_it_believes_the_coarse_volume_in_pure_noise_and_the_state_without_noise():
    fine = SuperResolution(LocalUNet(2, 1, 2, (8, 8)), Grid.cube(32), HUWindow(), 2)
    denoiser = fine.bind(COARSE, precision="float32")
    upsampled = fine.upsample(COARSE)
    torch.testing.assert_close(denoiser.denoise(X, 1.0), upsampled, atol=1e-3, rtol=0)
    share = 0.1**2 / (0.1**2 + float(fine.schedule.sigma(0.0)) ** 2)
    clean = X / float(fine.schedule.scales(0.0)[0])
    torch.testing.assert_close(denoiser.denoise(X, 0.0), share * clean + (1 - share) * upsampled, atol=1e-4, rtol=0)


def test_upsampling_keeps_places_and_undoes_block_means_of_what_is_smooth():
    axes = [torch.arange(32.0), torch.arange(32.0), torch.arange(32.0)]
    x, y, z = torch.meshgrid(*axes, indexing="ij")
    ramp = (0.02 * x - 0.01 * y + 0.005 * z)[None, None]
    found = tiny_super_resolution().upsample(avg_pool3d(ramp, 2))
    inside = (..., *[slice(1, -1)] * 3)
    torch.testing.assert_close(found[inside], ramp[inside], atol=1e-5, rtol=0)


def test_only_the_coarse_channels_it_uses_change_the_estimate():
    fine, other = tiny_super_resolution(), COARSE.clone()
    other[:, 1:] += 1
    assert torch.equal(fine.bind(COARSE).denoise(X, 0.5), fine.bind(other).denoise(X, 0.5))
    other[:, :1] += 0.1
    assert not torch.allclose(fine.bind(COARSE).denoise(X, 0.5), fine.bind(other).denoise(X, 0.5))


def test_the_noise_level_of_the_coarse_volume_is_told():
    fine = tiny_super_resolution()
    estimates = [fine.bind(COARSE, noise, precision="float32").denoise(X, 0.5) for noise in (0.0, 0.1, 0.5)]
    assert (estimates[0] - estimates[1]).std() > 1e-4 and (estimates[1] - estimates[2]).std() > 1e-4


def test_states_of_one_coarse_volume_are_each_as_they_are_alone():
    bound, others = tiny_super_resolution().bind(COARSE, precision="float32"), random_like(X.shape, torch.float32, 3)
    together = bound.denoise(torch.cat([X, others]), 0.5)
    torch.testing.assert_close(together, torch.cat([bound.denoise(x, 0.5) for x in (X, others)]), atol=1e-5, rtol=1e-4)


def test_half_precision_changes_little_and_double_precision_stays():
    fine = tiny_super_resolution()
    exact = fine.bind(COARSE, precision="float32").denoise(X, 0.5)
    low = fine.bind(COARSE, precision="bfloat16").denoise(X, 0.5)
    assert 0 < (low - exact).std() < 0.03 * exact.std() and low.dtype == torch.float32
    double = tiny_super_resolution().double()
    found = double.bind(COARSE.double()).denoise(X.double(), 0.5)
    assert found.dtype == torch.float64
    torch.testing.assert_close(found.float(), exact, atol=1e-5, rtol=1e-4)


def in_tiles(overlap=16, voxels=64):
    """A stage whose memory holds tiles of twice the overlap alone."""
    fine = tiny_super_resolution(voxels, overlap=overlap)
    fine.memory = int((2 * overlap + 1) ** 3 * fine.network.bytes_per_voxel)
    assert fine.tiles().size == 2 * overlap and len(fine.tiles().starts(voxels)) == 3
    return fine


def long_stage(overlap, memory_of=None):
    """A stage on 144 x 16 x 16 voxels whose network sees 12 voxels far; in tiles of twice the overlap, or whole."""
    with torch.random.fork_rng():
        torch.manual_seed(0)
        network = LocalUNet(2, 1, 1, (8,)).requires_grad_(False)
        for weight in network.parameters():
            if not weight.any():
                torch.nn.init.normal_(weight, std=0.3)
    fine = SuperResolution(network, Grid((144, 16, 16), (2.4,) * 3), HUWindow(), 2, overlap=overlap)
    if memory_of:
        fine.memory = int((memory_of + 1) ** 3 * network.bytes_per_voxel)
    return fine


def test_a_sample_in_tiles_is_that_of_the_whole_and_the_same_bits_each_time():
    coarse = COARSE[:, :, :, :8, :8].repeat(1, 1, 5, 1, 1)[:, :, :72]
    noise = X[..., :16, :16].repeat(1, 1, 5, 1, 1)[:, :, :144]

    def sample(fine):
        return ddim_sample(fine.bind(coarse, 0.05, precision="float32"), noise, 2)

    expected = sample(long_stage(8))
    detail = (expected - long_stage(8).upsample(coarse)).std()
    wide = long_stage(48, memory_of=96)
    assert wide.network.reach <= 12 and len(wide.tiles().starts(144)) == 2
    torch.testing.assert_close(sample(wide), expected, atol=1e-5, rtol=0)
    errors = []
    for overlap in (8, 16, 32):
        fine = long_stage(overlap, memory_of=2 * overlap)
        found = sample(fine)
        assert torch.equal(sample(fine), found)
        errors.append(float((found - expected).square().mean().sqrt() / detail))
    assert errors == sorted(errors, reverse=True) and errors[0] > errors[-1] and errors[-1] < 0.01


def test_tiles_share_as_many_voxels_as_the_network_s_levels_divide():
    network = LocalUNet(block=4, channels=(32, 32, 32, 32))
    fine = SuperResolution(network, Grid.cube(2 * network.divisor), HUWindow(), 2)
    assert fine.overlap == 64 and fine.tiles().overlap == 64


def test_tiles_leave_no_seams():
    """Across the faces of the tiles, the estimate changes as much from voxel to voxel as the whole's."""
    coarse, noise = COARSE.repeat(1, 1, 2, 2, 2), X.repeat(1, 1, 2, 2, 2)
    whole = tiny_super_resolution(64).bind(coarse, precision="float32").denoise(noise, 0.5)
    tiled = in_tiles().bind(coarse, precision="float32").denoise(noise, 0.5)
    for face in (15, 31, 47):
        for axis in (2, 3, 4):
            steps = [volume.diff(dim=axis).narrow(axis, face, 1).square().mean().sqrt() for volume in (tiled, whole)]
            assert steps[0] == pytest.approx(float(steps[1]), rel=0.01)


@pytest.mark.parametrize("channels, block", [((16, 16), 2), ((64, 96), 4), ((32, 64, 64), 4)])
def test_a_call_stays_within_the_memory_that_it_states(channels, block):
    torch.manual_seed(0)
    network = LocalUNet(2, 1, block, channels).requires_grad_(False)
    fine = SuperResolution(network, Grid.cube(64), HUWindow(), 2)
    denoiser = fine.bind(torch.zeros(1, 1, 32, 32, 32), precision="float32")
    x = torch.zeros(1, 1, 64, 64, 64)
    with Peak() as peak:
        denoiser.denoise(x, 0.5)
    assert 0.3 * network.bytes_per_voxel < peak.most / 64**3 <= network.bytes_per_voxel


def test_less_memory_is_enough_in_tiles():
    def peak(fine):
        denoiser, x = fine.bind(torch.zeros(1, 1, 32, 32, 32), precision="float32"), torch.zeros(1, 1, 64, 64, 64)
        with Peak() as found:
            denoiser.denoise(x, 0.5)
        return found.most

    tiled, volume = in_tiles(), 4 * 64**3
    assert peak(tiled) <= tiled.memory + 3 * volume  # state, coarse volume and estimate
    assert peak(tiny_super_resolution(64)) > 2 * peak(tiled)


def test_memory_that_holds_no_tile_is_refused_before_anything_is_denoised():
    fine = in_tiles()
    fine.check_memory(torch.float32)
    fine.memory = 1000
    with pytest.raises(ValueError, match="allow at least"):
        fine.check_memory(torch.float32)


def test_noise_drawn_for_the_coarse_volume_is_added_to_it():
    fine, draw = tiny_super_resolution(), torch.Generator().manual_seed(5)
    noisy = COARSE + 0.2 * torch.randn(COARSE.shape, generator=torch.Generator().manual_seed(5))
    given, drawn = fine.bind(noisy, 0.2), fine.bind(COARSE, 0.2, generator=draw)
    assert torch.equal(given.upsampled, drawn.upsampled) and given.noise == drawn.noise == 0.2


@pytest.mark.parametrize("noise", [-0.1, 1.1])
def test_a_noise_level_outside_its_range_is_refused(noise):
    with pytest.raises(ValueError, match=r"between 0 and 1"):
        tiny_super_resolution().bind(COARSE, noise)


@pytest.mark.parametrize("settings, words", [
    ({"voxels": 34}, "divisible by 4"), ({"voxels": 40, "factor": 3}, "factor 3"),
    ({"factor": 0}, "the factor .* 1 or more, but 0"), ({"factor": -2}, "the factor .* 1 or more, but -2"),
    ({"coarse_channels": 4}, "has 5 inputs"), ({"coarse_channels": 0}, "coarse state must have")])
def test_stages_that_cannot_be_are_refused(settings, words):
    with pytest.raises(ValueError, match=words):
        tiny_super_resolution(**settings)


def test_too_few_coarse_channels_are_refused():
    fine = SuperResolution(LocalUNet(5, 1, 2, (8, 8)), Grid.cube(32), HUWindow(), 2, coarse_channels=4)
    with pytest.raises(ValueError, match="needs 4 coarse channels, but 1"):
        fine.bind(COARSE[:, :1])
