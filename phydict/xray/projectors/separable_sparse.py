"""The separable projector as sparse products, for any device; phydict.xray.projectors.separable explains the operator.

Both factors are sparse matrices that the geometry fixes; the adjoint applies their transposes. Columns go in blocks
whose intermediate (column, depth, axial) values fit the cache.
"""

from __future__ import annotations

import numpy as np
import torch
from scipy.sparse import csr_array

from phydict.xray.projectors.csr import csr_tensor

BLOCK_VALUES = 2**24
"""Intermediate values per block of columns (64 MiB in float32)."""


class SparseFactors:
    """`forward` (B, X, Y, Z) -> (B, K, V, U) and its adjoint, for rays as phydict.xray.projectors.separable.Rays has
    them."""

    def __init__(self, grid: tuple[int, int, int], detector: tuple[int, int], starts: np.ndarray, columns: np.ndarray,
                 rows: np.ndarray, planes: np.ndarray):
        self.grid, self.detector = grid, detector
        self._views = [_factors(grid, *view) for view in zip(starts, columns, rows, planes)]
        self._tables: dict[tuple, list] = {}

    def forward(self, mu: torch.Tensor) -> torch.Tensor:
        xrays = mu.new_empty(len(mu), len(self._views), *self.detector)
        slices = self.grid[2]
        for case, images in zip(mu, xrays):
            plane = case.reshape(-1, slices)
            for image, (blocks, axial, _, weight) in zip(images, self._on(mu)):
                for columns, gather, _ in blocks:
                    samples = torch.mm(gather, plane).view(columns.stop - columns.start, -1)  # columns, depth * axial
                    image[:, columns] = torch.mm(axial, samples.T)
                image *= weight
        return xrays

    def adjoint(self, xrays: torch.Tensor) -> torch.Tensor:
        mu = xrays.new_zeros(len(xrays), *self.grid)
        slices = self.grid[2]
        for case, images in zip(mu, xrays):
            plane = case.view(-1, slices)
            for image, (blocks, _, spread, weight) in zip(images, self._on(xrays)):
                image = image * weight
                for columns, _, scatter in blocks:
                    samples = torch.mm(spread, image[:, columns].contiguous()).T.reshape(-1, slices)
                    plane.addmm_(scatter, samples)
        return mu

    def _on(self, like: torch.Tensor) -> list:
        """The tables in the precision and on the device of `like`, made once."""
        key = like.dtype, like.device
        if key not in self._tables:
            self._tables[key] = [
                ([(columns, csr_tensor(gather, like), csr_tensor(gather.T, like)) for columns, gather in blocks],
                 csr_tensor(axial, like), csr_tensor(axial.T, like), torch.as_tensor(weight).to(like))
                for blocks, axial, weight in self._views]
        return self._tables[key]


def _factors(grid: tuple[int, int, int], start: np.ndarray, columns: np.ndarray, rows: np.ndarray,
             planes: np.ndarray) -> tuple[list[tuple[slice, csr_array]], csr_array, np.ndarray]:
    """Blocks of in-plane gathers (columns * depths, X * Y), the axial factor (V, depths * Z) and weights (V, U)."""
    nx, ny, nz = grid
    depths = int(planes[2])
    fraction = planes[0] + np.arange(depths) * planes[1]
    along = start[:2] + columns[:, None, :2] * fraction[:, None]  # (U, depths, 2) voxel indices
    height = start[2] + rows[:, :1] * fraction  # (V, depths)
    axial = [(np.arange(depths) * nz + z, w) for z, w in _linear(height, nz)]

    width = max(1, BLOCK_VALUES // (depths * nz))
    blocks = []
    for first in range(0, len(columns), width):
        inside = along[first:first + width]
        entries = [(x * ny + y, wx * wy) for x, wx in _linear(inside[..., 0], nx)
                   for y, wy in _linear(inside[..., 1], ny)]
        size = len(inside) * depths
        blocks.append((slice(first, first + len(inside)),
                       _matrix(np.arange(size).reshape(-1, depths), entries, (size, nx * ny))))
    length = np.sqrt(columns[:, 2] + rows[:, 1:] ** 2)
    return blocks, _matrix(np.arange(len(rows))[:, None], axial, (len(rows), depths * nz)), planes[1] * length


def _linear(position: np.ndarray, size: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """The two neighbours of each fractional index and their weights; neighbours outside the grid weigh 0."""
    low = np.floor(position).astype(np.int64)
    ends = ((low, 1 - (position - low)), (low + 1, position - low))
    return [(index.clip(0, size - 1), np.where((index >= 0) & (index < size), weight, 0)) for index, weight in ends]


def _matrix(rows: np.ndarray, entries: list[tuple[np.ndarray, np.ndarray]], shape: tuple[int, int]) -> csr_array:
    """The sparse matrix with one (column, weight) per row position and entry; weights of 0 are left out."""
    rows = np.concatenate([np.broadcast_to(rows, weight.shape).ravel() for _, weight in entries])
    columns = np.concatenate([column.ravel() for column, _ in entries])
    weights = np.concatenate([weight.ravel() for _, weight in entries])
    kept = weights > 0
    return csr_array((weights[kept], (rows[kept], columns[kept])), shape=shape)
