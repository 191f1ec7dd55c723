"""Fast cone-beam projection of trilinear volumes for upright detectors, in plain torch, with its exact adjoint.

A view's rays are sampled on planes parallel to its detector. On the plane at depth d a ray's in-plane position depends
on its detector column alone and its axial position on its detector row alone, so trilinear interpolation splits:

    A mu = step / cos * sum over d of (axial linear interpolation at d) o (in-plane bilinear gather at d) mu

The planes lie one voxel of the dominant axis apart (or a whole fraction of it, where rays would cross more than one
voxel from plane to plane): then every voxel meets its planes in the same phase and none is over- or underweighted.
Both factors are sparse matrices that the geometry fixes; the adjoint applies their transposes. Columns go in blocks
whose intermediate (column, depth, axial) values fit the cache.

Outside the grid mu is 0: the interpolant falls linearly from the outermost voxel centres to 0 one voxel further out,
so a row of n equal voxels integrates to n voxels, as for boxes.

The products are short. Where other jobs share the processor, waiting OpenMP threads cost more than they give: set
OMP_WAIT_POLICY=PASSIVE in the environment, or one thread.
"""

from __future__ import annotations

import warnings

import numpy as np
import torch
from scipy.sparse import csr_array

from phydict.grid import Grid
from phydict.xray.geometry import ConeBeam

BLOCK_VALUES = 2**20
"""Intermediate values per block of columns (4 MiB in float32)."""


def is_separable(grid: Grid, beam: ConeBeam) -> bool:
    """Whether every detector's columns of pixels run along the grid's third axis."""
    axis = grid.affine[:3, 2] / grid.spacing[2]
    upright = np.linalg.norm(np.cross(beam.v, axis), axis=1) / np.linalg.norm(beam.v, axis=1)
    return bool((upright < 1e-6).all())


class Separable:
    """The operator for one grid and beam: `forward` (B, X, Y, Z) -> (B, K, V, U) and its adjoint, float32 or float64.

    mu in 1/mm, on any device. Raises ValueError for detectors that do not stand upright on the grid.
    """

    def __init__(self, grid: Grid, beam: ConeBeam):
        if not is_separable(grid, beam):
            raise ValueError("method 'separable' needs detectors whose rows are stacked along the grid's third axis, "
                             "but this beam's are tilted; use method='siddon' or 'auto'")
        self.grid, self.beam = grid, beam
        self._views = [_factors(grid, beam, k) for k in range(beam.views)]
        self._tables: dict[tuple, list] = {}

    def forward(self, mu: torch.Tensor) -> torch.Tensor:
        xrays = mu.new_empty(len(mu), self.beam.views, *self.beam.shape)
        slices = self.grid.shape[2]
        for case, images in zip(mu, xrays):
            plane = case.reshape(-1, slices)
            for image, (blocks, axial, _, weight) in zip(images, self._on(mu)):
                for columns, gather, _ in blocks:
                    samples = torch.mm(gather, plane).view(columns.stop - columns.start, -1)  # columns, depth * axial
                    image[:, columns] = torch.mm(axial, samples.T)
                image *= weight
        return xrays

    def adjoint(self, xrays: torch.Tensor) -> torch.Tensor:
        mu = xrays.new_zeros(len(xrays), *self.grid.shape)
        slices = self.grid.shape[2]
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
                ([(columns, _tensor(gather, like), _tensor(gather.T, like)) for columns, gather in blocks],
                 _tensor(axial, like), _tensor(axial.T, like), torch.as_tensor(weight).to(like))
                for blocks, axial, weight in self._views]
        return self._tables[key]


def _factors(grid: Grid, beam: ConeBeam, k: int) -> tuple[list[tuple[slice, csr_array]], csr_array, np.ndarray]:
    """Blocks of in-plane gathers (columns * depths, X * Y), the axial factor (V, depths * Z) and weights (V, U)."""
    (rows, columns), (nx, ny, nz) = beam.shape, grid.shape
    source, detector, normal, distance = beam.sources[k], beam.detectors[k], beam.normals[k], beam.distances[k]
    column = detector + (np.arange(columns) - (columns - 1) / 2)[:, None] * beam.u[k] - source
    row = detector + (np.arange(rows) - (rows - 1) / 2)[:, None] * beam.v[k] - source
    pixel = column + (row - (detector - source))[:, None]  # (V, U, 3) from the source

    to_index = np.linalg.inv(grid.affine[:3, :3])
    pace = max(np.abs(column @ to_index[:2].T).max(), np.abs(row @ to_index[2]).max()) / distance  # voxels per mm deep
    voxel = np.abs(normal @ grid.affine[:3, :2]).max()  # depth from one voxel to the next along the dominant axis
    step = voxel / np.ceil(voxel * pace - 1e-6)
    corners = (grid.corners() - source) @ normal
    middle = (corners.min() + corners.max()) / 2
    half = int(np.ceil((np.ptp(corners) / 2 + max(grid.spacing[:2])) / step))
    fraction = (middle + (np.arange(2 * half) - half + 0.5) * step) / distance  # of the way from source to detector

    start = grid.index(source)
    along = start[:2] + (column @ to_index[:2].T)[:, None] * fraction[:, None]  # (U, depths, 2) voxel indices
    depths = len(fraction)
    height = start[2] + (row @ to_index[2])[:, None] * fraction  # (V, depths)
    axial = _linear(height, nz)
    axial = _matrix(np.arange(rows)[:, None], [(np.arange(depths) * nz + z, w) for z, w in axial], (rows, depths * nz))

    width = max(1, BLOCK_VALUES // (depths * nz))
    blocks = []
    for first in range(0, columns, width):
        block = slice(first, min(first + width, columns))
        inside = along[block]
        entries = [(x * ny + y, wx * wy) for x, wx in _linear(inside[..., 0], nx)
                   for y, wy in _linear(inside[..., 1], ny)]
        size = inside.shape[0] * depths
        blocks.append((block, _matrix(np.arange(size).reshape(-1, depths), entries, (size, nx * ny))))
    return blocks, axial, step * np.linalg.norm(pixel, axis=-1) / distance


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


def _tensor(matrix, like: torch.Tensor) -> torch.Tensor:
    matrix = matrix.tocsr()
    matrix.sort_indices()
    index = [torch.as_tensor(part.astype(np.int32)) for part in (matrix.indptr, matrix.indices)]
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Sparse CSR tensor support is in beta state")
        return torch.sparse_csr_tensor(*index, torch.as_tensor(matrix.data).to(like.dtype), matrix.shape,
                                       device=like.device, check_invariants=False)
