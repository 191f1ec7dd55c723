"""The exact line integrals of piecewise-constant voxels as a stored sparse matrix, for small fixed geometries.

The same operator as phydict.xray.projectors.siddon, on any device: A and its transpose are built once by the compiled
tracer and kept as CSR, so that a projection is one sparse product with one writer per result. Building costs as much as
some tens of projections by ray tracing; it pays where one geometry is projected again and again.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from scipy.sparse import csr_array

from phydict.grid import Grid
from phydict.xray.geometry import ConeBeam
from phydict.xray.projectors.compiled import compiled
from phydict.xray.projectors.csr import csr_tensor, index_type
from phydict.xray.projectors.tracer import aim, clip, nearest, ray_lengths, rays_in_voxels, run


class SystemMatrix:
    """The operator for one grid and beam: `forward` (B, X, Y, Z) -> (B, K, V, U) and its adjoint, float32 or float64.

    mu in 1/mm, on any device. memory: bytes that A and its transpose may take. Raises ValueError with the bytes when
    they need more; float64 needs 3/2 of float32's.
    """

    def __init__(self, grid: Grid, beam: ConeBeam, memory: int):
        self.grid, self.beam, self.memory = grid, beam, memory
        self._lengths = ray_lengths(beam)
        self._crossed = _crossed_voxels(grid, beam)
        self._tables: dict[tuple, tuple[torch.Tensor, torch.Tensor]] = {}
        self._check(torch.float32)

    def forward(self, mu: torch.Tensor) -> torch.Tensor:
        matrix, _ = self._on(mu)
        return _products(matrix, mu).view(len(mu), self.beam.views, *self.beam.shape)

    def adjoint(self, xrays: torch.Tensor) -> torch.Tensor:
        _, transpose = self._on(xrays)
        return _products(transpose, xrays).view(len(xrays), *self.grid.shape)

    def _on(self, like: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """A and its transpose in the precision and on the device of `like`, made once."""
        key = like.dtype, like.device
        if key not in self._tables:
            self._make_room(like.dtype)
            matrix = self._build(np.float32 if like.dtype == torch.float32 else np.float64)
            self._tables[key] = csr_tensor(matrix, like), csr_tensor(matrix.T, like)
        return self._tables[key]

    def _build(self, kind: type[np.floating]) -> csr_array:
        """A with the rays (views, rows, columns) as rows, its values in mm."""
        rays, shape = rays_in_voxels(self.grid, self.beam), (self._crossed.size, math.prod(self.grid.shape))
        ends = np.cumsum(self._crossed).reshape(self._crossed.shape)
        voxels = np.empty(ends.flat[-1], index_type(int(ends.flat[-1]), shape[1]))
        values = np.empty(len(voxels), kind)
        run([(_fill, self.grid.shape, ray, lengths, ends[k] - self._crossed[k], voxels, values)
             for k, (ray, lengths) in enumerate(zip(rays, self._lengths))])
        starts = np.concatenate([[0], ends.reshape(-1)]).astype(voxels.dtype)
        return csr_array((values, voxels, starts), shape=shape)

    def _make_room(self, dtype: torch.dtype) -> None:
        """Forget the tables of other precisions and devices where the memory does not hold these beside them."""
        self._check(dtype)
        if sum(self._bytes(held) for held, _ in self._tables) + self._bytes(dtype) > self.memory:
            self._tables.clear()

    def _bytes(self, dtype: torch.dtype) -> int:
        return _table_bytes(self._crossed, math.prod(self.grid.shape), dtype)

    def _check(self, dtype: torch.dtype) -> None:
        needed = self._bytes(dtype)
        if needed > self.memory:
            raise ValueError(f"the system matrix needs {needed:,} bytes in {str(dtype).removeprefix('torch.')}, but "
                             f"the memory budget is {self.memory:,} bytes; use another method or raise memory")

    @staticmethod
    def bytes_for(grid: Grid, beam: ConeBeam, dtype: torch.dtype) -> int:
        """Bytes of A and its transpose, without building them."""
        return _table_bytes(_crossed_voxels(grid, beam), math.prod(grid.shape), dtype)


def _products(matrix: torch.Tensor, cases: torch.Tensor) -> torch.Tensor:
    """The matrix (M, N) times each of the cases (B, ...) of N numbers: (B, M)."""
    products = cases.new_empty(len(cases), matrix.shape[0])
    for product, case in zip(products, cases):
        product.copy_(torch.mv(matrix, case.reshape(-1)))
    return products


def _crossed_voxels(grid: Grid, beam: ConeBeam) -> np.ndarray:
    """How many voxels (K, V, U) each ray crosses, int64; at an edge it may count voxels that it only touches."""
    crossed = np.zeros((beam.views, *beam.shape), np.int64)
    run([(_count, grid.shape, ray, crossed[k]) for k, ray in enumerate(rays_in_voxels(grid, beam))])
    return crossed


def _table_bytes(crossed: np.ndarray, voxels: int, dtype: torch.dtype) -> int:
    entries = int(crossed.sum())
    index = np.dtype(index_type(entries, max(voxels, crossed.size))).itemsize
    return 2 * entries * (dtype.itemsize + index) + (crossed.size + voxels + 2) * index


@compiled()
def _count(shape, ray, crossed):
    start, step = ray[0], np.empty(3)
    voxel, sign = np.empty(3, np.int64), np.empty(3, np.int64)
    cross, delta = np.empty(3), np.empty(3)
    for r in range(crossed.shape[0]):
        for c in range(crossed.shape[1]):
            aim(ray, r, c, step)
            t, last = clip(start, step, (0, 0, 0), shape, voxel, sign, cross, delta)
            while t < last:
                crossed[r, c] += 1
                a = nearest(cross)
                t = max(t, cross[a])
                cross[a] += delta[a]
                voxel[a] += sign[a]
                if voxel[a] < 0 or voxel[a] >= shape[a]:
                    break


@compiled()
def _fill(shape, ray, lengths, offsets, voxels, values):
    """The voxels that a view's rays cross and the mm inside them, from each ray's offset on, as `_count` counts."""
    start, step = ray[0], np.empty(3)
    voxel, sign = np.empty(3, np.int64), np.empty(3, np.int64)
    cross, delta = np.empty(3), np.empty(3)
    for r in range(lengths.shape[0]):
        for c in range(lengths.shape[1]):
            aim(ray, r, c, step)
            t, last = clip(start, step, (0, 0, 0), shape, voxel, sign, cross, delta)
            entry = offsets[r, c]
            while t < last:
                a = nearest(cross)
                voxels[entry] = (voxel[0] * shape[1] + voxel[1]) * shape[2] + voxel[2]
                values[entry] = max(min(cross[a], last) - t, 0.0) * lengths[r, c]
                entry += 1
                t = max(t, cross[a])
                cross[a] += delta[a]
                voxel[a] += sign[a]
                if voxel[a] < 0 or voxel[a] >= shape[a]:
                    break
