"""Hounsfield units, linear attenuation and the prior's range, and the affine maps between them.

    HU = 1000 (mu / mu_water - 1)         definition of the Hounsfield scale
    x  = (2 HU - low - high) / (high - low)   the prior's range [-1, 1] for an HU window [low, high]

All three scales are affine in each other, so a projector that is linear in mu is affine in x.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

MU_WATER = 0.02
"""Linear attenuation of water in 1/mm near 65 keV, the effective energy of a chest X-ray."""

AIR = -1000.0
"""HU of air, and of what lies outside of a CT."""


def hu_to_mu(hu, mu_water: float = MU_WATER):
    """Linear attenuation in 1/mm of `hu` (any array or tensor), not below zero."""
    return (mu_water * (1 + hu / 1000)).clip(0)


def mu_to_hu(mu, mu_water: float = MU_WATER):
    """Hounsfield units of the linear attenuation `mu` in 1/mm (any array or tensor)."""
    return 1000 * (mu / mu_water - 1)


@dataclass(frozen=True)
class HUWindow:
    """The HU interval [low, high] that a prior maps to [-1, 1].

    Args:
        low: HU of x = -1, not below -1000 if every x in [-1, 1] is to have mu >= 0
        high: HU of x = 1
    """

    low: float = -1000.0
    high: float = 1000.0

    def __post_init__(self):
        if not (self.low < self.high and math.isfinite(self.low) and math.isfinite(self.high)):
            raise ValueError(f"an HU window needs low < high, both finite, but [{self.low}, {self.high}] was given")

    def check_air(self, which: str) -> None:
        """Raises ValueError, with the name of `which` window this is, where air, at -1000 HU, lies below it."""
        if self.low > AIR:
            raise ValueError(f"{which} begins at {self.low:g} HU, so that air, which lies at {AIR:g}, would attenuate "
                             f"X-rays: begin it at {AIR:g} or below")

    @property
    def centre(self) -> float:
        return (self.high + self.low) / 2

    @property
    def half_width(self) -> float:
        return (self.high - self.low) / 2

    def to_range(self, hu):
        """HU -> the prior's range [-1, 1]; values outside the window are clipped to its ends."""
        return ((hu - self.centre) / self.half_width).clip(-1, 1)

    def to_hu(self, x):
        """The prior's range -> HU, without clipping."""
        return self.half_width * x + self.centre

    def mu_affine(self, mu_water: float = MU_WATER) -> tuple[float, float]:
        """(a, b) in 1/mm such that mu = a x + b for x in the prior's range."""
        return mu_water * self.half_width / 1000, mu_water * (1 + self.centre / 1000)

    def to_mu(self, x, mu_water: float = MU_WATER):
        """The prior's range -> linear attenuation in 1/mm, without clipping."""
        a, b = self.mu_affine(mu_water)
        return a * x + b
