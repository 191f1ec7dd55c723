"""Sheets and blankets that lie on the body and hang down at its sides."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from phydict.datasets.surroundings.layers import FINE, between, fine
from phydict.datasets.surroundings.scene import Scene

KINDS = {"sheet": ((0.4, 1.5), (-600, -100)), "clothes": ((1.0, 4.0), (-850, -500)), "blanket": ((4, 20), (-960, -860))}
"""Kind -> mm of thickness and HU."""


@dataclass(frozen=True)
class Cover:
    """A cloth; lengths in mm.

    lift: over the skin. hang: slope at which it leaves the body. folds: (height, wavelength along x, along z, phase).
    end: how far up it reaches, as a share of the scanned height.
    """

    thickness: float
    hu: float
    lift: float
    hang: float
    folds: tuple[float, float, float, float]
    end: float

    @classmethod
    def draw(cls, rng: np.random.Generator) -> Cover:
        thickness, hu = KINDS[str(rng.choice(list(KINDS)))]
        uniform = rng.uniform
        return cls(float(uniform(*thickness)), float(uniform(*hu)), float(uniform(0, 6)), float(uniform(0.8, 4)),
                   (float(uniform(0, 14)), float(uniform(50, 160)), float(uniform(60, 250)), float(uniform(0, 6.3))),
                   1.0 if rng.random() < 0.4 else float(uniform(0.2, 1)))

    def add_to(self, scene: Scene) -> None:
        """Lay it on the body."""
        x, z = fine(scene.axes[0]), scene.axes[2][scene.slices]
        height = self._draped(scene)[:, scene.slices]
        tall, across, along, phase = self.folds
        wave = np.sin(2 * np.pi * (x[:, None] / across + z / along) + phase)
        height = np.maximum(height + self.lift + tall * np.maximum(wave, 0) ** 2, scene.back)
        slope = np.gradient(height, x, axis=0)
        thick = self.thickness * np.sqrt(1 + slope**2)
        ends = np.clip((scene.low + self.end * (scene.high - scene.low) - z) / scene.grid.spacing[2] + 0.5, 0, 1)
        share = between(height, height + thick, scene.axes[1])
        scene.add((1 + self.hu / 1000) * share * ends, (slice(None), slice(None), scene.slices))

    def _draped(self, scene: Scene) -> np.ndarray:
        """y in mm (FINE X, Z) of a cloth that is nowhere steeper than `hang` along x, over the front of the body."""
        front = scene.front()
        front = np.where(np.isfinite(front), front, scene.back - 100)
        rise = (self.hang * scene.axes[0])[:, None]
        falling = np.maximum.accumulate(front + rise, 0) - rise
        rising = np.maximum.accumulate((front - rise)[::-1], 0)[::-1] + rise
        coarse = np.maximum(falling, rising)
        place = np.clip((np.arange(FINE * len(coarse)) + 0.5) / FINE - 0.5, 0, len(coarse) - 1)
        first = np.minimum(place.astype(int), len(coarse) - 2)
        share = (place - first)[:, None]
        return coarse[first] * (1 - share) + coarse[first + 1] * share
