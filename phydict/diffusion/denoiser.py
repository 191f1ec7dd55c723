"""What a sampler asks of a prior: the estimate of the clean state, with text and guidance already inside."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from phydict.diffusion.schedule import CosineSchedule


class Denoiser(Protocol):
    """denoise(x, t) = E[x_0 | x_t = x]; x (B, C, X, Y, Z), t a time in [0, 1] shared by the batch.

    A denoiser that is differentiable where x requires a gradient serves every sampler; DPS alone needs that.
    """

    @property
    def schedule(self) -> CosineSchedule: ...

    def denoise(self, x: Tensor, t: float) -> Tensor: ...


@dataclass(frozen=True)
class GaussianDenoiser:
    """Exact denoiser of a Gaussian prior N(mean, variance) with independent components.

    It makes every sampler testable against closed forms, with no training:
    E[x_0 | x_t] = mean + a v / (a^2 v + s^2) (x_t - a mean), with (a, s) the schedule's scales.
    """

    mean: Tensor
    variance: Tensor
    schedule: CosineSchedule = CosineSchedule()

    def denoise(self, x: Tensor, t: float) -> Tensor:
        a, s = (w.to(x) for w in self.schedule.scales(t))
        gain = a * self.variance / (a * a * self.variance + s * s)
        return self.mean + gain * (x - a * self.mean)


def guided(conditional: Tensor, unconditional: Tensor, scale: float) -> Tensor:
    """Classifier-free guidance on clean estimates (Ho & Salimans 2022, arXiv:2207.12598): u + scale (c - u).

    Equal to guiding the noise estimate, since both are affine in each other at a fixed time.
    """
    return torch.lerp(unconditional, conditional, scale)
