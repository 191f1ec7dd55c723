"""The local network: what it answers at a voxel depends on that voxel's neighbourhood alone."""

import pytest
import torch
from laws import random_like

from phydict.prior import LocalUNet
from phydict.prior.local_unet import PositionNorm
from phydict.prior.tiles import Tiles

T, LEVEL = torch.tensor([0.4]), torch.tensor([0.1])


def network(channels, block=1, res_blocks=1):
    """An untrained network in double precision, none of whose layers is zero."""
    with torch.random.fork_rng():
        torch.manual_seed(0)
        local = LocalUNet(2, 1, block, channels, res_blocks).double().requires_grad_(False)
        for weight in local.parameters():
            if not weight.any():
                torch.nn.init.normal_(weight, std=0.3)
    return local


@pytest.mark.parametrize("channels, block, res_blocks", [
    ((8,), 2, 1), ((8, 8), 1, 1), ((8, 8), 2, 2), ((8, 8, 8), 1, 1)])
def test_nothing_beyond_the_reach_changes_the_answer_and_what_is_near_does(channels, block, res_blocks):
    local = network(channels, block, res_blocks)
    n = -(-(local.reach + 3) // local.divisor) * local.divisor
    x = random_like((1, 2, 2 * n, local.divisor, local.divisor), seed=1)
    changed = x.clone()
    changed[:, :, n] += 1.0
    difference = (local(x, T, LEVEL) - local(changed, T, LEVEL)).abs().amax((0, 1, 3, 4))
    away = (torch.arange(2 * n) - n).abs()
    assert not difference[away > local.reach].any()
    assert (difference[away <= block] > 0).all()


@pytest.mark.parametrize("channels", [(8,), (8, 8)])
def test_tiles_with_a_wide_overlap_are_the_whole_up_to_rounding(channels):
    local = network(channels)
    overlap = 4 * -(-local.reach // local.divisor) * local.divisor
    x = random_like((1, 2, 7 * overlap // 2, local.divisor, local.divisor), seed=2)
    tiles = Tiles(2 * overlap, overlap, local.divisor)
    assert len(tiles.starts(x.shape[2])) == 3
    whole = local(x, T, LEVEL)
    torch.testing.assert_close(tiles(lambda part: local(part, T, LEVEL), x), whole, atol=1e-10, rtol=0)


def test_positions_are_normalised_each_for_itself():
    norm = PositionNorm(8).double()
    x = 3 + 5 * random_like((2, 8, 4, 3, 2), seed=3)
    y = norm(x)
    torch.testing.assert_close(y.mean(1), torch.zeros(2, 4, 3, 2).double(), atol=1e-12, rtol=0)
    torch.testing.assert_close(y.var(1, correction=0), torch.ones(2, 4, 3, 2).double(), atol=1e-5, rtol=0)
    torch.testing.assert_close(norm(x[:, :, 1:2]), y[:, :, 1:2], atol=0, rtol=0)


def test_time_and_noise_level_are_heard():
    local, x = network((8, 8)), random_like((1, 2, 8, 8, 8), seed=4)
    known = local(x, T, LEVEL)
    assert not torch.allclose(local(x, T + 0.1, LEVEL), known)
    assert not torch.allclose(local(x, T, LEVEL + 0.1), known)


def test_all_weights_learn():
    """After the first steps, since the last layer starts at zero."""
    torch.manual_seed(0)
    local = LocalUNet(2, 1, 2, (8, 8))
    optimizer = torch.optim.SGD(local.parameters(), 0.1)
    for _ in range(3):
        optimizer.zero_grad()
        (local(torch.randn(1, 2, 8, 8, 8), T, LEVEL) - 1).square().mean().backward()
        optimizer.step()
    still = [name for name, weight in local.named_parameters() if weight.grad is None or not weight.grad.any()]
    assert not still
