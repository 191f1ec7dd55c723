"""ECG leads with their electrodes, cables and plastic tubes on the chest."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from phydict.datasets.phantoms.tubes import Tubes
from phydict.datasets.surroundings.scene import Scene

KINDS = {"cable": ((0.6, 1.5), (300, 3000), 0.0), "tube": ((2.0, 6.0), (-50, 200), 0.6)}
"""Kind -> mm of radius, HU of the wall, share of the cross-section that is air."""


@dataclass(frozen=True)
class Lead:
    """A thin curve on the skin: a Bezier curve of three points (x, z), shares of the body's half-width and of the
    scanned height, with radius in mm, HU, the share of its cross-section that is air, and an electrode at its start."""

    points: tuple[tuple[float, float], ...]
    radius: float
    hu: float
    hollow: float
    electrode: bool

    @classmethod
    def draw(cls, rng: np.random.Generator, electrode: bool = True) -> Lead:
        radius, hu, hollow = KINDS["cable" if electrode or rng.random() < 0.5 else "tube"]
        start = (rng.uniform(-0.7, 0.7), rng.uniform(0.1, 0.9))
        end = ((np.sign(rng.normal()) * 1.0, rng.uniform(0, 1)) if rng.random() < 0.5
               else (rng.uniform(-1, 1), float(rng.integers(2))))
        middle = [(a + b) / 2 + rng.uniform(-reach, reach) for a, b, reach in zip(start, end, (0.4, 0.3))]
        points = tuple((float(x), float(z)) for x, z in (start, middle, end))
        return cls(points, float(rng.uniform(*radius)), float(rng.uniform(*hu)), hollow, electrode)

    @classmethod
    def draw_set(cls, rng: np.random.Generator) -> list[Lead]:
        """Three to six ECG leads, one or two cables or tubes, or both."""
        leads = [cls.draw(rng) for _ in range(int(rng.integers(3, 7)))] if rng.random() < 0.7 else []
        loose = int(rng.integers(1, 3)) if not leads or rng.random() < 0.3 else 0
        return leads + [cls.draw(rng, electrode=False) for _ in range(loose)]

    def add_to(self, scene: Scene) -> None:
        """Lay it on the front of the body, where there is any."""
        share = np.linspace(0, 1, 60)[:, None]
        start, middle, end = np.array(self.points)
        curve = (1 - share) ** 2 * start + 2 * share * (1 - share) * middle + share**2 * end
        x = scene.middle[0] + curve[:, 0] * scene.width / 2
        z = scene.low + curve[:, 1] * (scene.high - scene.low)
        points = np.stack([x, self._skin(scene, x, z) + self.radius, z], 1)
        points = points[np.isfinite(points[:, 1])]
        if len(points) < 2:
            return
        parts = [Tubes.chain(points, self.radius, hu=self.hu, core_hu=-1000, core=self.hollow)]
        if self.electrode:
            parts += [Tubes.of(points[0], points[0] + [0, 2, 0], 14, hu=50),
                      Tubes.of(points[0], points[0] + [0, 5, 0], 2.2, hu=3000)]
        scene.add_tubes(Tubes.join(parts))

    @staticmethod
    def _skin(scene: Scene, x: np.ndarray, z: np.ndarray) -> np.ndarray:
        """y in mm of the body's front at x and z, bilinear; not finite beside the body."""
        front = scene.front()
        index = [np.clip((place - axis[0]) / step, 0, len(axis) - 1.001) for place, axis, step in
                 zip((x, z), scene.axes[::2], scene.grid.spacing[::2])]
        (i, j), (s, t) = (np.array(part) for part in zip(*((k.astype(int), k - k.astype(int)) for k in index)))
        with np.errstate(invalid="ignore"):
            return ((front[i, j] * (1 - s) + front[i + 1, j] * s) * (1 - t)
                    + (front[i, j + 1] * (1 - s) + front[i + 1, j + 1] * s) * t)
