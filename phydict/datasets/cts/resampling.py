"""Resampling by voxel averages.

Every new voxel is the exact mean, over its box, of the linear interpolation between the old voxels. It is anti-aliased
when shrinking, smooth when enlarging, and every old voxel keeps its weight, so means are preserved.
"""

from __future__ import annotations

import numpy as np
import scipy

from phydict.grid import Grid


def to_grid(volume: np.ndarray, affine: np.ndarray, grid: Grid, pad: float) -> np.ndarray:
    """Resample a volume (X, Y, Z) with its 4x4 affine onto `grid` by voxel averages; `pad` lies outside.

    Where the axes are parallel the averages are exact. Otherwise the volume is averaged along its own axes to half
    the grid's spacing, interpolated linearly at eight points per new voxel, and those are averaged.
    """
    spacing = np.linalg.norm(affine[:3, :3], axis=0)
    order = np.abs(spacing[:, None] * np.linalg.solve(affine, grid.affine)[:3, :3]).argmax(0)
    if len(set(order)) == 3:  # the old axes as the new ones they run along are stacked
        volume, affine, spacing = volume.transpose(order), affine[:, [*order, 3]], spacing[order]
    relative = np.linalg.inv(affine) @ grid.affine
    scale = np.diag(relative)[:3]
    slant = (np.abs(relative[:3, :3] - np.diag(scale)) @ np.asarray(grid.shape)).max()
    if slant < 0.1:
        return _average(volume, relative[:3, 3], scale, grid.shape, pad)
    step = np.maximum(1.0, min(grid.spacing) / 2 / spacing)
    shape = np.ceil(np.asarray(volume.shape) / step).astype(int) + 1
    first = (np.asarray(volume.shape) - 1) / 2 - step * (shape - 1) / 2
    volume = _average(volume, first, step, shape, pad)
    half = np.eye(4)
    half[:3, :3] /= 2
    half[:3, 3] = -0.25
    fine = relative @ half
    fine[:3] /= step[:, None]
    fine[:3, 3] -= first / step
    fine = scipy.ndimage.affine_transform(volume, fine[:3, :3], fine[:3, 3], tuple(2 * n for n in grid.shape), order=1,
                                          mode="constant", cval=pad)
    x, y, z = grid.shape
    return fine.reshape(x, 2, y, 2, z, 2).mean((1, 3, 5))


def _average(volume, first, step, shape, pad: float) -> np.ndarray:
    """Means over boxes of `step` old voxels, the first centred at the old index `first`, along the volume's axes."""
    weights = [_weights(n, f, s, m) for n, f, s, m in zip(volume.shape, first, step, shape)]
    inside = np.einsum("i,j,k->ijk", *(w.sum(1) for w in weights))
    x, y, z = weights
    volume = np.asarray(volume, np.float32)
    volume = (volume.reshape(-1, volume.shape[2]) @ z.T).reshape(*volume.shape[:2], -1)
    volume = y @ volume
    volume = (x @ volume.reshape(volume.shape[0], -1)).reshape(inside.shape)
    return volume + np.float32(pad) * (1 - inside)


def _weights(old: int, first: float, step: float, new: int) -> np.ndarray:
    """(new, old): the integral of each old voxel's hat function over each new voxel, over the new voxel's width."""
    centre = first + step * np.arange(new)[:, None] - np.arange(old)
    width = abs(step)

    def integral(u):
        u = u.clip(-1, 1)
        return 0.5 + u - np.sign(u) * u**2 / 2

    return ((integral(centre + width / 2) - integral(centre - width / 2)) / width).astype(np.float32)


def covering_grid(shape, affine: np.ndarray, spacing: float) -> Grid:
    """The grid along the world's axes with `spacing` mm that covers a volume of `shape` with its 4x4 affine."""
    ends = np.stack(np.meshgrid(*[(-0.5, n - 0.5) for n in shape], indexing="ij"), -1).reshape(-1, 3)
    corners = ends @ affine[:3, :3].T + affine[:3, 3]
    low, high = corners.min(0), corners.max(0)
    voxels = np.maximum(1, np.ceil((high - low) / spacing - 1e-6).astype(int))
    cover = np.diag([spacing, spacing, spacing, 1.0])
    cover[:3, 3] = (low + high) / 2 - spacing * (voxels - 1) / 2
    return Grid(tuple(voxels), affine=cover)


def moved_to(grid: Grid, centre: np.ndarray) -> Grid:
    """`grid` moved so that its centre lies at the world position `centre` (3,) in mm."""
    affine = grid.affine.copy()
    affine[:3, 3] += centre - grid.centre
    return Grid(grid.shape, affine=affine)
