"""Exact cone-beam projection of piecewise-constant voxels for any pose, compiled for the CPU, with its exact adjoint.

Siddon 1985, Med Phys 12:252 (doi:10.1118/1.595715), by incremental crossings in float64. A voxel is a box of half a
spacing either side of its centre; outside the grid mu is 0.

The adjoint splits the volume into slabs along the third axis and clips every ray to its slab: each voxel has one
writer, so the result does not depend on the number of threads.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import torch
from numba import njit

from phydict.grid import Grid
from phydict.xray.geometry import ConeBeam

SLAB = 8
"""Voxels along the third axis that one task of the adjoint writes."""


class Siddon:
    """The operator for one grid and beam: `forward` (B, X, Y, Z) -> (B, K, V, U) and its adjoint, float32 or float64.

    mu in 1/mm, on the CPU. Runs on as many threads as torch does.
    """

    def __init__(self, grid: Grid, beam: ConeBeam):
        self.grid, self.beam = grid, beam
        to_index = np.linalg.inv(grid.affine[:3, :3])
        first = (beam.detectors - (beam.shape[1] - 1) / 2 * beam.u - (beam.shape[0] - 1) / 2 * beam.v)
        self._rays = np.stack([grid.index(beam.sources), grid.index(first), beam.u @ to_index.T, beam.v @ to_index.T],
                              1)  # (K, 4, 3) voxel indices: source, first pixel, steps along the columns and the rows
        self._lengths = np.linalg.norm(beam.pixels() - beam.sources[:, None, None], axis=-1)

    def forward(self, mu: torch.Tensor) -> torch.Tensor:
        volumes = _array(mu)
        xrays = np.empty((len(volumes), self.beam.views, *self.beam.shape), volumes.dtype)
        _run([(_project, volumes[b], xrays[b, k], self._rays[k], self._lengths[k])
              for b in range(len(volumes)) for k in range(self.beam.views)])
        return torch.from_numpy(xrays)

    def adjoint(self, xrays: torch.Tensor) -> torch.Tensor:
        images = _array(xrays)
        volumes = np.zeros((len(images), *self.grid.shape), images.dtype)
        slabs = range(0, self.grid.shape[2], SLAB)
        _run([(_backproject, volumes[b], images[b], self._rays, self._lengths, low, min(low + SLAB, self.grid.shape[2]))
              for b in range(len(images)) for low in slabs])
        return torch.from_numpy(volumes)


def _array(x: torch.Tensor) -> np.ndarray:
    if x.device.type != "cpu":
        raise ValueError(f"method 'siddon' runs on the CPU, but a tensor on {x.device} was given; "
                         "use method='separable' or move the tensor with .cpu()")
    return np.ascontiguousarray(x.detach().numpy())


def _run(tasks: list[tuple]) -> None:
    """Run (function, *arguments) tasks on torch's number of threads; the compiled functions release the GIL."""
    with ThreadPoolExecutor(min(torch.get_num_threads(), len(tasks)) or 1) as pool:
        for done in [pool.submit(*task) for task in tasks]:
            done.result()


@njit(nogil=True, cache=True)
def _enter(start, step, shape, low, high, voxel, sign, cross, delta):
    """Set up one ray: start + t step, 0 <= t <= 1, in voxel indices: return its interval of t inside the box.

    The box is [0, X) x [0, Y) x [low, high). Fills per axis the first voxel, the direction of travel, the t of the
    next crossing and the t between crossings. An empty interval means that the ray misses the box.
    """
    first, last = 0.0, 1.0
    for a in range(3):
        near, far = -0.5, shape[a] - 0.5
        if a == 2:
            near, far = low - 0.5, high - 0.5
        if abs(step[a]) < 1e-12:
            if start[a] < near or start[a] >= far:
                return 1.0, 0.0
        else:
            one, two = (near - start[a]) / step[a], (far - start[a]) / step[a]
            first, last = max(first, min(one, two)), min(last, max(one, two))
    if first >= last:
        return 1.0, 0.0
    for a in range(3):
        near, far = (low, high) if a == 2 else (0, shape[a])
        voxel[a] = min(max(int(np.floor(start[a] + first * step[a] + 0.5)), near), far - 1)
        if abs(step[a]) < 1e-12:
            sign[a], cross[a], delta[a] = 0, np.inf, np.inf
        else:
            sign[a] = 1 if step[a] > 0 else -1
            cross[a] = (voxel[a] + 0.5 * sign[a] - start[a]) / step[a]
            delta[a] = 1 / abs(step[a])
    return first, last


@njit(nogil=True, cache=True)
def _nearest(cross):
    if cross[0] <= cross[1]:
        return 0 if cross[0] <= cross[2] else 2
    return 1 if cross[1] <= cross[2] else 2


@njit(nogil=True, cache=True)
def _project(volume, image, ray, lengths):
    shape = volume.shape
    voxel, sign = np.empty(3, np.int64), np.empty(3, np.int64)
    cross, delta = np.empty(3), np.empty(3)
    for r in range(image.shape[0]):
        for c in range(image.shape[1]):
            step = ray[1] + c * ray[2] + r * ray[3] - ray[0]
            t, last = _enter(ray[0], step, shape, 0, shape[2], voxel, sign, cross, delta)
            total = 0.0
            while t < last:
                a = _nearest(cross)
                until = min(cross[a], last)
                if until > t:
                    total += (until - t) * volume[voxel[0], voxel[1], voxel[2]]
                    t = until
                if cross[a] >= last:
                    break
                voxel[a] += sign[a]
                if voxel[a] < 0 or voxel[a] >= shape[a]:
                    break
                cross[a] += delta[a]
            image[r, c] = total * lengths[r, c]


@njit(nogil=True, cache=True)
def _backproject(volume, images, rays, lengths, low, high):
    shape = volume.shape
    voxel, sign = np.empty(3, np.int64), np.empty(3, np.int64)
    cross, delta = np.empty(3), np.empty(3)
    for k in range(images.shape[0]):
        ray = rays[k]
        for r in range(images.shape[1]):
            for c in range(images.shape[2]):
                step = ray[1] + c * ray[2] + r * ray[3] - ray[0]
                t, last = _enter(ray[0], step, shape, low, high, voxel, sign, cross, delta)
                value = images[k, r, c] * lengths[k, r, c]
                while t < last:
                    a = _nearest(cross)
                    until = min(cross[a], last)
                    if until > t:
                        volume[voxel[0], voxel[1], voxel[2]] += (until - t) * value
                        t = until
                    if cross[a] >= last:
                        break
                    voxel[a] += sign[a]
                    if voxel[a] < 0 or voxel[a] >= shape[a] or (a == 2 and (voxel[a] < low or voxel[a] >= high)):
                        break
                    cross[a] += delta[a]
