"""A chest in the scanner, and the free space around it that other things may fill."""

from __future__ import annotations

from functools import cached_property

import numpy as np

from phydict.datasets.phantoms.tubes import Tubes
from phydict.grid import Grid

OCCUPIED = -320.0
"""HU above which a voxel outside the body counts as solid."""

CONTACT = 0.02
"""Share of the skin's columns that reach further back than where the body is taken to rest on the couch."""


class Scene:
    """HU of a chest, to which matter is added outside the body alone.

    hu: (X, Y, Z), RAS+, changed in place. body: (X, Y, Z) bool. field: diameter in mm of the circle around the body's
    axis outside which nothing is added, None for no limit. `axes` are x, y, z in mm from the grid's centre along its
    axes. Nothing is added above the body's first or below its last slice.
    """

    def __init__(self, hu: np.ndarray, body: np.ndarray, grid: Grid, field: float | None = None):
        if not body.any():
            raise ValueError("a scene needs a body, but none of the voxels belongs to one; give a mask of the body")
        self.hu, self.body, self.grid = hu, body, grid
        self.axes = [(np.arange(n) - (n - 1) / 2) * s for n, s in zip(grid.shape, grid.spacing)]
        self.edge = float(np.mean(grid.spacing))
        slices = np.flatnonzero(body.any((0, 1)))
        self.slices = slice(int(slices[0]), int(slices[-1]) + 1)
        self.low, self.high = (self.axes[2][slices[i]] + d * grid.spacing[2] / 2 for i, d in ((0, -1), (-1, 1)))
        in_field = np.ones(grid.shape[:2]) if field is None else self.soft(np.hypot(
            self.axes[0][:, None] - self.middle[0], self.axes[1] - self.middle[1]) - field / 2)
        self.free = (in_field[..., None] * ~body).astype(np.float32)

    @cached_property
    def middle(self) -> tuple[float, float]:
        """x and y in mm of the middle of the box around the body."""
        ends = [self.axes[a][np.flatnonzero(self.body.any(tuple({0, 1, 2} - {a})))[[0, -1]]] for a in (0, 1)]
        return float(ends[0].mean()), float(ends[1].mean())

    @cached_property
    def width(self) -> float:
        """mm from side to side of the widest slice."""
        return float(np.ptp(np.flatnonzero(self.body.any((1, 2)))) + 1) * self.grid.spacing[0]

    @cached_property
    def back(self) -> float:
        """y in mm of the plane on which the body rests."""
        columns = self._edges(self.body)
        return float(np.quantile(columns[np.isfinite(columns)], CONTACT))

    def front(self) -> np.ndarray:
        """y in mm (X, Z) of the foremost surface of the body and of what lies around it in front of the back."""
        solid = self.body | (self.hu > OCCUPIED)
        solid[:, self.axes[1] < self.back] = False
        return -self._edges(solid[:, ::-1], self.hu[:, ::-1])

    def _edges(self, solid: np.ndarray, hu: np.ndarray | None = None) -> np.ndarray:
        """y in mm (X, Z) where each column of `solid`, seen along rising y, begins; inf for an empty column."""
        hu = self.hu if hu is None else hu
        first = solid.argmax(1)
        before = np.take_along_axis(hu, np.maximum(first - 1, 0)[:, None], 1)[:, 0]
        partial = np.clip((before + 1000) / 1000, 0, 1)
        y = self.axes[1][0] + (first - 0.5 - partial) * self.grid.spacing[1]
        return np.where(solid.any(1), y, np.inf)

    def soft(self, distance) -> np.ndarray:
        """Share of each voxel inside a body with signed `distance` mm."""
        return np.clip(0.5 - np.asarray(distance) / self.edge, 0, 1)

    def add(self, density: np.ndarray, box: tuple[slice, ...] = (slice(None),) * 3) -> None:
        """Add matter of `density` (water is 1), averaged over each voxel of `box`, to the share of it that is free."""
        hu, span = self.hu[box], np.zeros((1, 1, self.grid.shape[2]), np.float32)
        span[..., self.slices] = 1
        hu += 1000 * np.clip(-hu / 1000, 0, 1) * self.free[box] * span[:, :, box[2]] * density

    def add_tubes(self, tubes: Tubes) -> None:
        """Add tubes given in mm from the grid's centre."""
        points, volume, hu = tubes.points(float(np.clip(min(self.grid.spacing) / 3, 0.5, 1.0)))
        index = np.rint((points - [axis[0] for axis in self.axes]) / self.grid.spacing).astype(np.int64)
        inside = ((index >= 0) & (index < self.grid.shape)).all(1)
        flat = np.ravel_multi_index(tuple(index[inside].T), self.grid.shape)
        mass = np.bincount(flat, (volume * (1 + hu / 1000))[inside], int(np.prod(self.grid.shape)))
        self.add((mass / np.prod(self.grid.spacing)).reshape(self.grid.shape))
