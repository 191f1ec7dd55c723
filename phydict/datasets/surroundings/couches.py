"""Couches under the back: hollow shells of carbon fibre with a foam core, pads, second shells, arm rests.

A couch is the same in every slice. Its cross-section is a pile of layers between curves y(x), so each voxel's share is
exact in y. Typical couches of chest CTs weaken X-rays by the equivalent of 5 to 11 mm of water.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from phydict.datasets.surroundings.layers import between, fine
from phydict.datasets.surroundings.scene import Scene

KINDS = {
    "flat narrow": ((370, 440), (15, 50), (0.0, 1e-4), (-955, -880), 0.0),
    "flat wide": ((450, 560), (20, 60), (0.0, 1e-4), (-955, -880), 0.0),
    "curved": ((390, 480), (20, 60), (4e-4, 1.4e-3), (-955, -880), 0.1),
    "foam": ((400, 520), (60, 120), (0.0, 8e-4), (-955, -920), 0.0),
    "PET": ((420, 530), (8, 25), (0.0, 4e-4), (-955, -850), 1.0),
    "radiotherapy": ((500, 540), (45, 60), (0.0, 0.0), (-955, -900), 0.0)}
"""Kind -> mm of width and of thickness, curvature of its surface in 1/mm, HU of its core, share with a second shell."""

SHELL_MM, SHELL_HU = (0.8, 2.8), (-200.0, 300.0)
PAD_MM, PAD_HU = (4.0, 40.0), (-950.0, -850.0)
SHIFT_MM = 30.0


@dataclass(frozen=True)
class Couch:
    """The cross-section of a couch; lengths in mm.

    gap: from the back to the pad, negative where the body sinks in. shift: of its axis along x from the body's.
    curve: height of the surface over the square of x, 1/mm. pad: thickness of the mattress on it. keel: width of the
    bottom's flat part, beyond which it rises to the edges; 0 where the bottom follows the surface. shell, shell_hu:
    its walls. under: (distance of a second shell, its thickness), None for none. rest: (half-distance, slope and
    length) of boards rising at both sides, None for none.
    """

    width: float
    thickness: float
    gap: float
    shift: float
    curve: float
    keel: float
    pad: float
    pad_hu: float
    shell: float
    shell_hu: float
    core_hu: float
    under: tuple[float, float] | None = None
    rest: tuple[float, float, float] | None = None

    @classmethod
    def draw(cls, rng: np.random.Generator) -> Couch:
        width, thicknesses, curve, core, under = list(KINDS.values())[int(rng.integers(len(KINDS)))]
        uniform = rng.uniform
        gap = uniform(-8, 2) if rng.random() < 0.6 else uniform(0, 35)
        thickness = float(uniform(*thicknesses))
        parallel = rng.random() < (0.6 if curve[0] else 0.3)
        return cls(
            float(uniform(*width)), thickness, float(gap), float(np.clip(rng.normal(0, 12), -SHIFT_MM, SHIFT_MM)),
            float(uniform(*curve)), 0.0 if parallel else float(uniform(150, 350)),
            float(uniform(*PAD_MM)) if rng.random() < 0.75 else 0.0, float(uniform(*PAD_HU)),
            float(uniform(*SHELL_MM)), float(uniform(*SHELL_HU)), float(uniform(*core)),
            (float(uniform(8, 50)), float(uniform(30, 90))) if rng.random() < under else None,
            (float(uniform(165, 215)), float(uniform(0.2, 1.8)), float(uniform(60, 150)))
            if rng.random() < 0.15 else None)

    def add_to(self, scene: Scene) -> None:
        """Put it below the body's back."""
        scene.add(self.section(scene.axes[0] - scene.middle[0], scene.axes[1] - scene.back)[..., None])

    def section(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Density (X, Y) relative to water, averaged over each voxel, of voxels with centres `x` (X,) from the body's
        middle and `y` (Y,) from its back, in mm."""
        across = np.abs(fine(x) - self.shift)
        surface = self.curve * across**2 - self.gap
        top = surface - self.pad
        bottom = top - self.thickness if not self.keel else np.minimum(
            top[across.argmin()] - self.thickness + 0.7 * np.maximum(across - self.keel / 2, 0), top - 2 * self.shell)
        section = _density(self.pad_hu) * _layer(across < self.width / 2 - 10, top, surface, y)
        section += self._box(across, self.width, top, bottom, y)
        if self.under:
            distance, thickness = self.under
            lower = np.full(across.shape, bottom.min() - distance)
            section += self._box(across, 0.9 * self.width, lower, lower - thickness, y)
        if self.rest:
            start, slope, length = self.rest
            board = surface + slope * (across - start)
            beside = (across > start) & (across < start + length / np.hypot(1, slope))
            section += _density(self.pad_hu) * _layer(beside, board - 12 * np.hypot(1, slope), board, y)
            section += _density(self.shell_hu) * _layer(beside, board, board + 1.5 * np.hypot(1, slope), y)
        return section

    def _box(self, across: np.ndarray, width: float, top: np.ndarray, bottom: np.ndarray, y: np.ndarray) -> np.ndarray:
        """A hollow shell with its core."""
        inner = across < width / 2 - self.shell
        walls = _layer(across < width / 2, bottom, top, y)
        core = _layer(inner, bottom + self.shell, top - self.shell, y)
        return _density(self.shell_hu) * (walls - core) + _density(self.core_hu) * core


def _layer(where: np.ndarray, low: np.ndarray, high: np.ndarray, y: np.ndarray) -> np.ndarray:
    return between(low, np.where(where, high, low), y)


def _density(hu: float) -> float:
    return 1 + hu / 1000
