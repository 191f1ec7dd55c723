"""Running a local network tile by tile: overlapping tiles, blended by weights that sum to one."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import product

import torch
from torch import Tensor


@dataclass(frozen=True)
class Tiles:
    """How a volume is split: tiles of at most `size` voxels a side, neighbours sharing at least `overlap` voxels.

    Tiles start and end at multiples of `divisor`, so that a network's downsampling meets the same voxels as in the
    whole volume. Of an overlap, each tile's outer quarter counts nothing and the middle half fades from one tile to the
    next: the result is smooth, and where the network reaches no further than overlap / 4 it is that of the whole
    volume up to rounding.
    """

    size: int
    overlap: int
    divisor: int = 1

    def __post_init__(self):
        if self.size % self.divisor or self.overlap % self.divisor or not 0 < 2 * self.overlap <= self.size:
            raise ValueError(f"tiles and their overlap are multiples of {self.divisor} voxels and a tile is at least "
                             f"twice the overlap, but {self.size} and {self.overlap} were given")

    @classmethod
    def within(cls, budget: int, bytes_per_voxel: float, overlap: int, divisor: int = 1) -> Tiles:
        """The largest tiles on which a network that takes `bytes_per_voxel` stays within `budget` bytes.

        Raises ValueError where not even a tile of twice the overlap does.
        """
        size = int((budget / bytes_per_voxel) ** (1 / 3)) // divisor * divisor
        if size < 2 * overlap:
            least = math.ceil((2 * overlap) ** 3 * bytes_per_voxel / 2**20)
            raise ValueError(f"{budget / 2**20:.0f} MiB hold no tile of {2 * overlap} voxels a side: allow at least "
                             f"{least} MiB")
        return cls(size, overlap, divisor)

    def starts(self, voxels: int) -> list[int]:
        """Where the tiles along an axis of `voxels` voxels begin."""
        size, n, overlap = (v // self.divisor for v in (self.size, voxels, self.overlap))
        if n <= size:
            return [0]
        last = math.ceil((n - size) / (size - overlap))
        return [self.divisor * (i * (n - size) // last) for i in range(last + 1)]

    def weights(self, voxels: int) -> list[tuple[slice, Tensor]]:
        """The tiles along an axis: their voxels, and the weight of each; the weights at a voxel sum to one."""
        starts, size = self.starts(voxels), min(self.size, voxels)
        position, raw = torch.arange(voxels, dtype=torch.float64) + 0.5, []
        for i, start in enumerate(starts):
            weight = ((position > start) & (position < start + size)).double()
            if i:
                weight *= _fade(position - start, starts[i - 1] + size - start)
            if i + 1 < len(starts):
                weight *= _fade(start + size - position, start + size - starts[i + 1])
            raw.append(weight)
        total = torch.stack(raw).sum(0)
        return [(slice(start, start + size), (weight / total)[start:start + size])
                for start, weight in zip(starts, raw)]

    def __call__(self, function: Callable[..., Tensor], *volumes: Tensor) -> Tensor:
        """function(*volumes), computed tile by tile; volumes (B, C, X, Y, Z) of one spatial size, as its result is."""
        axes = [self.weights(n) for n in volumes[0].shape[2:]]
        if all(len(axis) == 1 for axis in axes):
            return function(*volumes)
        for n, tile in enumerate(product(*axes)):
            part: tuple = (..., *(voxels for voxels, _ in tile))
            result = function(*(volume[part] for volume in volumes))
            if not n:
                blended = result.new_zeros(*result.shape[:2], *volumes[0].shape[2:])
            x, y, z = (weight.to(result) for _, weight in tile)
            blended[part] += result * x[:, None, None] * y[:, None] * z
        return blended


def _fade(depth: Tensor, overlap: int) -> Tensor:
    """Weight at `depth` voxels inside a tile whose edge overlaps its neighbour: 0, then rising, then 1."""
    return ((depth - overlap / 4) / (overlap / 2)).clamp(0, 1)
