"""A method of one's own, without a prior: steepest descent on the squared residual, densities kept positive."""

from dataclasses import dataclass

import torch

from phydict.baselines import Baseline
from phydict.units import MU_WATER


@dataclass(frozen=True)
class MyMethod(Baseline):
    """iterations: steps down the gradient, each as long as is best along it."""

    iterations: int = 20
    mu_water: float = MU_WATER
    name: str = "MyMethod"

    def steps(self):
        return self.iterations

    def solve(self, A, y, on_step):
        density = torch.zeros(1, 1, *A.grid.shape).to(y)  # relative to water: HU = 1000 (density - 1)
        for _ in range(self.iterations):
            gradient = A.T(y - A(density))
            length = gradient.square().sum() / A.linear(gradient).square().sum().clamp(min=1e-12)
            density = (density + length * gradient).clamp(min=0)
            on_step()
        return density
