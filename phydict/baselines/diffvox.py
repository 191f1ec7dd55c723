"""DiffVox's recipe: the voxels themselves optimised by Adam through the projector."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import softplus

from phydict.baselines.baseline import Baseline, CountingProjector, clip, empty
from phydict.runtime.ranges import LEAST, MOST, check_fields
from phydict.units import MU_WATER, HUWindow

SHIFT, SHARPNESS = 0.3, 20.0
"""Density = softplus(x - SHIFT) of this sharpness: x = 0 is nearly vacuum, and no density is negative."""


@dataclass(frozen=True)
class DiffVox(Baseline):
    """argmin over x of mean |A d - y| + smoothness mean |grad d|, d = softplus(x - 0.3), by Adam from zero.

    d is relative to water, A d and y are in mm of water, and |grad d| is the sum of the absolute differences between
    neighbours along the three axes. Parametrisation, losses and schedule are those of Momeni et al. 2024
    (arXiv:2411.19224): Adam at 0.01, raised to it and lowered again linearly (one cycle). They take batches of
    rays for 50 epochs; here every step sees all rays. Their smoothness is 15 mm, on finer voxels and more views.

    Args:
        iterations: steps of Adam, each of all rays
        smoothness: weight of |grad d|, mm of water
        learning_rate: Adam's, at its highest
        window: HU bounds of the result, or None for none
        mu_water: attenuation of water in 1/mm in the X-rays
        name: what results call the method
    """

    citation = ("Momeni et al., Voxel-Based Differentiable X-Ray Rendering Improves Self-Supervised 3D CBCT "
                "Reconstruction, 2024, arXiv:2411.19224")

    iterations: int = 1000
    smoothness: float = 50.0
    learning_rate: float = 0.01
    window: HUWindow | None = HUWindow()
    mu_water: float = MU_WATER
    name: str = "diffvox"

    def __post_init__(self):
        super().__post_init__()
        check_fields(self, "DiffVox", iterations=(1, math.inf), smoothness=(0, MOST), learning_rate=(LEAST, MOST))

    def steps(self) -> int:
        return self.iterations

    @torch.enable_grad()
    def solve(self, A: CountingProjector, y: Tensor, on_step: Callable[[], None]) -> Tensor:
        x = empty(A, y).requires_grad_()
        adam = torch.optim.Adam([x], self.learning_rate)
        cycle = torch.optim.lr_scheduler.OneCycleLR(adam, self.learning_rate, self.iterations,
                                                    anneal_strategy="linear")
        for _ in range(self.iterations):
            adam.zero_grad()
            density = softplus(x - SHIFT, SHARPNESS)
            with torch.no_grad():
                gradient = A.T((A(density) - y).sign()) / y.numel()  # of the data term, by the adjoint
            roughness = sum(density.diff(dim=axis).abs().sum() for axis in (2, 3, 4)) / density.numel()
            ((gradient * density).sum() + self.smoothness * roughness).backward()
            adam.step()
            cycle.step()
            on_step()
        return clip(softplus(x.detach() - SHIFT, SHARPNESS), self.window)
