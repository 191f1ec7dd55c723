"""Tiles: their weights sum to one, and what is local comes out as on the whole volume, without seams."""

import itertools

import pytest
import torch
from laws import random_like
from torch.nn.functional import avg_pool3d

from phydict.prior.tiles import Tiles

CASES = [(Tiles(8, 4), 8), (Tiles(8, 4), 9), (Tiles(8, 4), 31), (Tiles(12, 4, 2), 38), (Tiles(24, 8, 4), 64),
         (Tiles(16, 8, 8), 40), (Tiles(16, 8), 7)]


@pytest.mark.parametrize("tiles, voxels", CASES)
def test_the_weights_at_every_voxel_sum_to_one(tiles, voxels):
    total = torch.zeros(voxels).double()
    for part, weight in tiles.weights(voxels):
        assert (weight >= 0).all()
        total[part] += weight
    torch.testing.assert_close(total, torch.ones_like(total), atol=1e-15, rtol=0)


@pytest.mark.parametrize("tiles, voxels", CASES)
def test_tiles_cover_the_axis_overlap_and_meet_the_networks_blocks(tiles, voxels):
    starts = tiles.starts(voxels)
    size = min(tiles.size, voxels)
    assert starts[0] == 0 and starts[-1] + size == voxels
    assert all(start % tiles.divisor == 0 for start in starts)
    assert all(a + size - b >= tiles.overlap and b > a for a, b in itertools.pairwise(starts))


def test_what_reaches_a_quarter_of_the_overlap_is_as_on_the_whole_volume():
    def blur(x):  # looks two voxels away, and at zeros beyond the border
        return avg_pool3d(x, 5, stride=1, padding=2) * x.square()

    x = random_like((2, 3, 28, 16, 40))
    whole = blur(x)
    torch.testing.assert_close(Tiles(16, 8)(blur, x), whole, atol=1e-12, rtol=0)
    assert (Tiles(16, 4)(blur, x) - whole).abs().max() > 1e-3  # one voxel is not enough


def test_every_volume_is_cut_alike():
    x, y = random_like((1, 1, 20, 20, 20), seed=1), random_like((1, 1, 20, 20, 20), seed=2)
    torch.testing.assert_close(Tiles(8, 4)(lambda a, b: a - 2 * b, x, y), x - 2 * y, atol=1e-12, rtol=0)


def test_tiles_that_disagree_fade_into_each_other():
    seen = []

    def disagree(x):
        seen.append(x)
        return torch.full_like(x, float(len(seen) % 2))

    blended = Tiles(32, 16)(disagree, torch.zeros(1, 1, 80, 8, 8))
    assert len(seen) == 4 and blended.min() == 0 and blended.max() == 1
    assert blended.diff(dim=2).abs().max() <= 1 / 8 + 1e-6  # the middle half of 16 voxels


def test_a_volume_that_is_one_tile_is_computed_at_once():
    calls = []
    Tiles(16, 4)(lambda x: calls.append(x.shape) or x, torch.zeros(1, 1, 16, 12, 9))
    assert calls == [(1, 1, 16, 12, 9)]


@pytest.mark.parametrize("budget", [2**20, 2**24, 10**9])
def test_tiles_are_the_largest_that_a_budget_holds(budget):
    tiles = Tiles.within(budget, 80.0, 8, 8)
    assert tiles.size**3 * 80 <= budget < (tiles.size + 8) ** 3 * 80


def test_a_budget_that_holds_no_tile_names_the_least():
    with pytest.raises(ValueError, match="allow at least 3 MiB"):
        Tiles.within(2**20, 80.0, 16, 8)


@pytest.mark.parametrize("size, overlap, divisor", [(12, 8, 1), (12, 0, 1), (10, 4, 4), (16, 6, 4)])
def test_tiles_that_cannot_blend_are_refused(size, overlap, divisor):
    with pytest.raises(ValueError, match="multiples of"):
        Tiles(size, overlap, divisor)
