"""Arms that lie beside the body."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from phydict.datasets.surroundings.scene import Scene

SKIN_HU, FAT_HU, MUSCLE_HU, CORTEX_HU, MARROW_HU = 20.0, -103.0, 50.0, 1000.0, -30.0


@dataclass(frozen=True)
class Arm:
    """An arm along the body's side; lengths in mm.

    side: 1 right, -1 left. radius, bone: of the arm and its bone. fat: under the skin. gap: from the body. height: of
    its axis over the back, beyond its radius. tilt: mm outwards and forwards per mm downwards. top: where it begins
    under the top of the scan.
    """

    side: int
    radius: float
    bone: float
    fat: float
    gap: float
    height: float
    tilt: tuple[float, float]
    top: float

    @classmethod
    def draw(cls, rng: np.random.Generator, side: int) -> Arm:
        uniform = rng.uniform
        return cls(side, float(uniform(34, 56)), float(uniform(9.5, 13)), float(uniform(3, 14)), float(uniform(0, 20)),
                   float(uniform(0, 60)), (float(uniform(-0.05, 0.12)), float(uniform(-0.1, 0.25))),
                   float(uniform(0, 60)))

    @classmethod
    def draw_pair(cls, rng: np.random.Generator) -> list[Arm]:
        """Both arms, or one in a third of the draws."""
        sides = [(1, -1), (1, -1), (1,), (1, -1), (1, -1), (-1,)][int(rng.integers(6))]
        return [cls.draw(rng, side) for side in sides]

    def add_to(self, scene: Scene) -> None:
        """Put it beside the body."""
        x, y, z = scene.axes[0][:, None, None], scene.axes[1][:, None], scene.axes[2]
        down = scene.high - z
        lying = scene.back + self.radius + self.height
        beside = scene.middle[0] + self.side * (self._reach(scene, lying) + self.radius + self.gap)
        radius = self.radius * np.clip(1.05 - 0.0009 * down, 0.6, 1)
        axis = np.hypot(x - beside - self.side * self.tilt[0] * down, y - lying - self.tilt[1] * down)
        distance = np.maximum(axis - radius, (self.top - down) * 0.7)
        density: float | np.ndarray = 0.0
        inner = -1000.0
        for depth, hu in ((distance, SKIN_HU), (distance + 1.6, FAT_HU), (distance + self.fat, MUSCLE_HU),
                          (np.maximum(axis - self.bone, distance + self.fat), CORTEX_HU),
                          (np.maximum(axis - 0.55 * self.bone, distance + self.fat), MARROW_HU)):
            density = density + (hu - inner) / 1000 * scene.soft(depth)
            inner = hu
        scene.add(np.asarray(density))

    def _reach(self, scene: Scene, lying: float) -> float:
        """mm from the body's middle to its side at the arm's height, in the lower half of the scan."""
        low, high = scene.slices.start, (scene.slices.start + scene.slices.stop) // 2 + 1
        near = np.abs(scene.axes[1] - lying) < self.radius
        columns = scene.body[:, near, low:high].any((1, 2))
        if not columns.any():
            return scene.width / 2
        edges = scene.axes[0][np.flatnonzero(columns)[[0, -1]]] + [-scene.edge / 2, scene.edge / 2]
        return float(self.side * (edges[1 if self.side > 0 else 0] - scene.middle[0]))
