"""Draws from the likelihood times a Gaussian around the prior's estimate: the step that DAPS and PnP-DM share."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass

import torch
from torch import Tensor

from phydict.diffusion import Generators, noise_like
from phydict.posterior.normalised import NormalisedMeasurement, nearest_fit
from phydict.runtime.ranges import check_fields


class LikelihoodDraw(ABC):
    """Draws z ~ exp(-|P(z) - y|^2 / (2 noise^2) - |z - x0|^2 / (2 x0_std^2)).

    x0 and z (B, 1, X, Y, Z); progress: how much of the sampling is done, in [0, 1).
    """

    @abstractmethod
    def __call__(self, measurement: NormalisedMeasurement, x0: Tensor, x0_std: float, generator: Generators,
                 progress: float) -> Tensor: ...

    def of_states(self, measurement: NormalisedMeasurement, x0: Tensor, x0_std: float, generator: Generators,
                  progress: float) -> Tensor:
        """A draw for states x0 (B, C, X, Y, Z): of the CT the above, of the other channels, which X-rays do not
        measure, x0 with noise of x0_std."""
        ct, masks = self(measurement, x0[:, :1], x0_std, generator, progress), x0[:, 1:]
        return torch.cat([ct, masks + x0_std * noise_like(masks, generator)], 1)


@dataclass(frozen=True)
class ExactDraw(LikelihoodDraw):
    """The draw itself, since it is Gaussian: data and estimate are perturbed by their noise, then fitted.

    Conjugate gradients start at the perturbed estimate: what the X-rays do not see has its full spread at once, and few
    iterations suffice for the rest. Perturb and optimise: Papandreou & Yuille 2010; cut short, Gilavert et al. 2015,
    arXiv:1409.0606.

    Args:
        iterations: of conjugate gradients; exact with as many as the operator has singular values; 0: the perturbed
            estimate alone
        tolerance: factor by which the residual shrinks, after which they end, in [0, 1]
    """

    iterations: int = 30
    tolerance: float = 1e-4

    def __post_init__(self):
        check_fields(self, "ExactDraw", iterations=(0, math.inf), tolerance=(0, 1))

    def __call__(self, measurement: NormalisedMeasurement, x0: Tensor, x0_std: float, generator: Generators,
                 progress: float) -> Tensor:
        start = x0 + x0_std * noise_like(x0, generator)
        y = measurement.y.expand(len(x0), *measurement.y.shape[1:])
        y = y + measurement.noise * noise_like(y, generator)
        return nearest_fit(measurement, start, (measurement.noise / x0_std) ** 2, self.iterations, self.tolerance, y)
