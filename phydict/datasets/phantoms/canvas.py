"""Painting anatomy on a voxel grid: partial-volume shares of bodies given by distances, pipes and thin tubes."""

from __future__ import annotations

import numpy as np
import scipy

from phydict.datasets.phantoms.thorax import Thorax, ellipsoid
from phydict.datasets.phantoms.tubes import Tubes
from phydict.grid import Grid
from phydict.units import AIR


class Texture:
    """Smooth noise of unit variance fixed in the thorax's frame: a random lattice of `pitch` mm, interpolated."""

    def __init__(self, seed: int, stream: int, pitch: float):
        count = int(np.ceil(640 / pitch))
        self.lattice = np.random.default_rng([seed, 4, stream]).standard_normal((count,) * 3).astype(np.float32)
        self.lattice *= 1.8
        self.pitch = pitch

    def __call__(self, x, y, z) -> np.ndarray:
        places = np.stack(np.broadcast_arrays(x, y, z)).astype(np.float32) / self.pitch
        return scipy.ndimage.map_coordinates(self.lattice, places, order=1, mode="grid-wrap")


class Canvas:
    """The HU volume being painted, and where its voxels are in the thorax's frame.

    `axes` are x, y, z in mm, thin arrays that broadcast to the volume where the grid follows the world's axes; y is
    that of a thorax that its spine does not bend, `straight_y` that of the scanner.
    """

    def __init__(self, thorax: Thorax, grid: Grid):
        self.thorax, self.grid = thorax, grid
        self.edge = float(np.mean(grid.spacing))
        self.voxel = float(np.prod(grid.spacing))
        self.pitch = float(np.clip(min(grid.spacing) / 3, 0.5, 2.0))
        self.hu = np.full(grid.shape, AIR, np.float32)
        matrix, start = grid.affine[:3, :3], grid.affine[:3, 3] - thorax.offset
        index = np.meshgrid(*(np.arange(n, dtype=np.float32) for n in grid.shape), indexing="ij", sparse=True)
        self.axes = []
        for row, origin in zip(matrix, start):
            used = [c * i for c, i in zip(row, index) if abs(c) > 1e-6] or [0 * index[0]]
            self.axes.append(np.asarray(sum(used) + origin, np.float32))
        self.straight_y = self.axes[1]
        self.axes[1] = self.straight_y - np.float32(thorax.bend(self.axes[2]))

    def soft(self, distance) -> np.ndarray:
        """Share of each voxel inside a body with signed `distance` mm."""
        return np.clip(0.5 - np.asarray(distance, np.float32) / self.edge, 0, 1)

    def sheet(self, distance, thickness: float) -> np.ndarray:
        """Share of each voxel inside a sheet of `thickness` mm around the surface distance = 0."""
        return self.soft(np.abs(distance) - thickness / 2) - self.soft(np.abs(distance) + thickness / 2)

    def paint(self, share, value, box=..., into: np.ndarray | None = None) -> None:
        """Mix `value` HU into `box` of the volume, or of the volume `into`, by the voxels' `share`."""
        target = self.hu if into is None else into
        target[box] += share * (value - target[box])

    def box(self, low, high) -> tuple[tuple[slice, ...], list[np.ndarray]]:
        """The voxels around the box low..high (mm) and their x, y, z."""
        low, high = np.asarray(low) - self.edge, np.asarray(high) + self.edge
        bend = self.thorax.bend(np.linspace(low[2], high[2], 9))
        low, high = low + [0, bend.min(), 0], high + [0, bend.max(), 0]
        corners = np.stack(np.meshgrid(*zip(low, high), indexing="ij"), -1).reshape(-1, 3) + self.thorax.offset
        index = self.grid.index(corners)
        first = np.clip(np.floor(index.min(0)).astype(int), 0, self.grid.shape)
        last = np.clip(np.ceil(index.max(0)).astype(int) + 1, first, self.grid.shape)
        box = tuple(slice(a, b) for a, b in zip(first, last))
        return box, [axis[tuple(s if n > 1 else slice(None) for s, n in zip(box, axis.shape))] for axis in self.axes]

    def blob(self, centre, half, axes=np.eye(3)) -> tuple[tuple[slice, ...], np.ndarray]:
        """(box, share) of an ellipsoid."""
        half = np.broadcast_to(np.asarray(half, float), 3)
        reach = np.sqrt(((np.asarray(axes) * half[:, None]) ** 2).sum(0))
        box, (x, y, z) = self.box(np.asarray(centre) - reach, np.asarray(centre) + reach)
        return box, self.soft(ellipsoid(x, y, z, centre, axes, half))

    def pipe(self, points, radius, wall: float = 0.0) -> tuple[tuple[slice, ...], np.ndarray]:
        """(box, share) of a wide round tube through `points` (M, 3) with `radius` mm, a number or one per point."""
        points = np.asarray(points, float)
        radius = np.broadcast_to(np.asarray(radius, float), len(points)) + wall
        box, (x, y, z) = self.box(points.min(0) - radius.max(), points.max(0) + radius.max())
        distance = None
        for a, b, r0, r1 in zip(points[:-1], points[1:], radius[:-1], radius[1:]):
            line = b - a
            t = np.clip(((x - a[0]) * line[0] + (y - a[1]) * line[1] + (z - a[2]) * line[2]) / (line @ line), 0, 1)
            d = np.sqrt((x - a[0] - t * line[0]) ** 2 + (y - a[1] - t * line[1]) ** 2 + (z - a[2] - t * line[2]) ** 2)
            d = d - r0 - t * (r1 - r0)
            distance = d if distance is None else np.minimum(distance, d)
        return box, self.soft(distance)

    def fill(self, tubes: Tubes) -> tuple[np.ndarray, np.ndarray]:
        """Share of each voxel inside thin tubes, and their mean HU there."""
        points, volume, hu = tubes.points(self.pitch)
        points[:, 1] += self.thorax.bend(points[:, 2])
        index = np.rint(self.grid.index(points + self.thorax.offset)).astype(np.int64)
        inside = ((index >= 0) & (index < self.grid.shape)).all(1)
        flat = np.ravel_multi_index(tuple(index[inside].T), self.grid.shape)
        size = int(np.prod(self.grid.shape))
        share = np.bincount(flat, volume[inside] / self.voxel, size)
        value = np.bincount(flat, volume[inside] / self.voxel * hu[inside], size) / np.maximum(share, 1e-9)
        return (np.minimum(share, 1).reshape(self.grid.shape).astype(np.float32),
                value.reshape(self.grid.shape).astype(np.float32))
