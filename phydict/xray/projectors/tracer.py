"""What the compiled ray tracers share: where rays enter a box of voxels, the order of their crossings, the threads.

Siddon 1985, Med Phys 12:252 (doi:10.1118/1.595715), by incremental crossings in float64. A voxel is a box of half a
spacing either side of its centre, and a ray runs from the source (t = 0) to its pixel's centre (t = 1). Boxes are
half-open: a ray that runs exactly in the face between two voxels belongs to the one with the higher index, and a ray
in the upper outer face of the grid misses it.

`project` clips the rays to the box that holds all non-zero voxels. `backproject` splits the volume into slabs along
the third axis and clips every ray to its slab: each voxel has one writer, so no result depends on the number of
threads.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import torch

from phydict.grid import Grid
from phydict.xray.geometry import ConeBeam
from phydict.xray.projectors.compiled import compiled

SLAB = 8
"""Voxels along the third axis that one task of the adjoint writes."""


class Tracer:
    """The operator for one grid and beam: `forward` (B, X, Y, Z) -> (B, K, V, U) and its adjoint, float32 or float64.

    mu in 1/mm. Runs on the CPU, on as many threads as torch does; tensors of other devices are carried over and back.

    reach: voxels beside the one that a ray is in whose values count.
    project(volume, image, ray, lengths, low, high) fills the image (V, U) with a view's integrals through the voxels
    low <= index < high. backproject(volume, images, rays, lengths, low, high) adds the adjoint of images (K, V, U) to
    the slices low <= k < high of the volume. Both are compiled and release the GIL.
    """

    reach: int
    project: Callable
    backproject: Callable

    def __init__(self, grid: Grid, beam: ConeBeam):
        self.grid, self.beam, self.rays = grid, beam, rays_in_voxels(grid, beam)
        self._lengths = ray_lengths(beam)

    def forward(self, mu: torch.Tensor) -> torch.Tensor:
        volumes = _array(mu)
        xrays = np.zeros((len(volumes), self.beam.views, *self.beam.shape), volumes.dtype)
        boxes = [support(volume, self.reach) for volume in volumes]
        run([(self.project, volumes[b], xrays[b, k], self.rays[k], self._lengths[k], *box)
             for b, box in enumerate(boxes) if box for k in range(self.beam.views)])
        return torch.from_numpy(xrays).to(mu.device)

    def adjoint(self, xrays: torch.Tensor) -> torch.Tensor:
        images = _array(xrays)
        volumes = np.zeros((len(images), *self.grid.shape), images.dtype)
        slices = self.grid.shape[2]
        run([(self.backproject, volumes[b], images[b], self.rays, self._lengths, low, min(low + SLAB, slices))
             for b in range(len(images)) for low in range(0, slices, SLAB)])
        return torch.from_numpy(volumes).to(xrays.device)


def _array(x: torch.Tensor) -> np.ndarray:
    return np.ascontiguousarray(x.detach().cpu().numpy())


def rays_in_voxels(grid: Grid, beam: ConeBeam) -> np.ndarray:
    """(K, 4, 3) voxel indices: each view's source, its first pixel, and the steps along its columns and its rows."""
    to_index = np.linalg.inv(grid.affine[:3, :3])
    first = beam.detectors - (beam.shape[1] - 1) / 2 * beam.u - (beam.shape[0] - 1) / 2 * beam.v
    return np.stack([grid.index(beam.sources), grid.index(first), beam.u @ to_index.T, beam.v @ to_index.T], 1)


def ray_lengths(beam: ConeBeam) -> np.ndarray:
    """(K, V, U) mm from each view's source to its pixels."""
    return np.linalg.norm(beam.pixels() - beam.sources[:, None, None], axis=-1)


def support(volume: np.ndarray, reach: int) -> tuple[tuple[int, ...], tuple[int, ...]] | None:
    """The box low <= index < high of a volume's (X, Y, Z) non-zero voxels, `reach` voxels larger on every side but
    within the grid; None for an empty volume."""
    filled = volume != 0
    if not filled.any():
        return None
    across = filled.any(2)
    ends = [np.flatnonzero(line)[[0, -1]] for line in (across.any(1), across.any(0), filled.any((0, 1)))]
    return (tuple(max(int(end[0]) - reach, 0) for end in ends),
            tuple(min(int(end[1]) + 1 + reach, n) for end, n in zip(ends, volume.shape)))


def run(tasks: list[tuple]) -> None:
    """Run (function, *arguments) tasks on torch's number of threads."""
    threads = min(torch.get_num_threads(), len(tasks))
    if threads < 2:
        for function, *arguments in tasks:
            function(*arguments)
        return
    with ThreadPoolExecutor(threads) as pool:
        for done in [pool.submit(*task) for task in tasks]:
            done.result()


@compiled()
def aim(ray, row, column, step):
    """Fill the way from the source to a pixel, in voxel indices."""
    for a in range(3):
        step[a] = ray[1, a] + column * ray[2, a] + row * ray[3, a] - ray[0, a]


@compiled()
def clip(start, step, low, high, voxel, sign, cross, delta):
    """Set up one ray, start + t step in voxel indices, and return its interval of t inside the box.

    The box holds the voxels low <= index < high. Fills per axis the first voxel, the direction of travel, the t of
    the next crossing and the t between crossings. An empty interval means that the ray misses the box.
    """
    first, last = 0.0, 1.0
    for a in range(3):
        near, far = low[a] - 0.5, high[a] - 0.5
        if abs(step[a]) < 1e-12:
            if start[a] < near or start[a] >= far:
                return 1.0, 0.0
        else:
            one, two = (near - start[a]) / step[a], (far - start[a]) / step[a]
            first, last = max(first, min(one, two)), min(last, max(one, two))
    if first >= last:
        return 1.0, 0.0
    for a in range(3):
        still = abs(step[a]) < 1e-12
        way = 0.0 if still else first * step[a]
        voxel[a] = min(max(int(np.floor(start[a] + way + 0.5)), low[a]), high[a] - 1)
        if still:
            sign[a], cross[a], delta[a] = 0, np.inf, np.inf
        else:
            sign[a] = 1 if step[a] > 0 else -1
            cross[a] = (voxel[a] + 0.5 * sign[a] - start[a]) / step[a]
            delta[a] = 1 / abs(step[a])
    return first, last


@compiled()
def nearest(cross):
    """The axis whose crossing comes next."""
    if cross[0] <= cross[1]:
        return 0 if cross[0] <= cross[2] else 2
    return 1 if cross[1] <= cross[2] else 2
