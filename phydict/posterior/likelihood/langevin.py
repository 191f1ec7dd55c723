"""Unadjusted Langevin dynamics on the likelihood times a Gaussian around the prior's estimate."""

from __future__ import annotations

import math
from dataclasses import dataclass

from torch import Tensor

from phydict.diffusion import Generators, noise_like
from phydict.posterior.likelihood.likelihood_draw import LikelihoodDraw
from phydict.posterior.normalised import NormalisedMeasurement
from phydict.runtime.ranges import LEAST, MOST, check_fields


@dataclass(frozen=True)
class Langevin(LikelihoodDraw):
    """Langevin steps z <- z + step score(z) + sqrt(2 step) noise from the estimate, as published with DAPS and PnP-DM;
    score is the gradient of the log density.

    A step is cut to 1 / (1 / noise^2 + 1 / x0_std^2), beyond which the dynamics overshoot, and at twice which they
    diverge. Short of convergence z stays near the estimate; a direction of precision p then has variance
    1 / p / (1 - step p / 2) instead of 1 / p.

    Args:
        iterations: steps at each noise level
        step: size of a step, for an operator of norm 1
        last_share: the share of it that is left at the end of the sampling, to which it shrinks linearly
    """

    iterations: int = 100
    step: float = 1e-4
    last_share: float = 0.01

    def __post_init__(self):
        check_fields(self, "Langevin", iterations=(1, math.inf), step=(LEAST, MOST), last_share=(LEAST, 1))

    def __call__(self, measurement: NormalisedMeasurement, x0: Tensor, x0_std: float, generator: Generators,
                 progress: float) -> Tensor:
        step, z = min(self.step * (1 - progress * (1 - self.last_share)), 1 / (measurement.noise**-2 + x0_std**-2)), x0
        for _ in range(self.iterations):
            misfit = measurement.adjoint(measurement.y - measurement.project(z))
            score = misfit / measurement.noise**2 + (x0 - z) / x0_std**2
            z = z + step * score + (2 * step) ** 0.5 * noise_like(z, generator)
        return z
