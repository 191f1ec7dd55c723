"""SIRT: simultaneous iterative reconstruction with positivity, the classical yardstick without a prior."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from phydict.baselines.baseline import Baseline, CountingProjector, empty
from phydict.runtime.ranges import check_fields
from phydict.units import MU_WATER


@dataclass(frozen=True)
class SIRT(Baseline):
    """mu <- max(0, mu + C A.T R (y - A mu)), R and C the inverse row and column sums of A (Gregor & Benson 2008,
    doi:10.1109/TMI.2008.923696), from zero.

    Args:
        iterations: how many; more fit the views better and, on noisy data, the noise too
        mu_water: attenuation of water in 1/mm in the X-rays
        name: what results call the method
    """

    citation = ("Gregor & Benson, Computational Analysis and Improvement of SIRT, IEEE Transactions on Medical Imaging "
                "27(7), 2008, doi:10.1109/TMI.2008.923696")

    iterations: int = 1000
    mu_water: float = MU_WATER
    name: str = "sirt"

    def __post_init__(self):
        super().__post_init__()
        check_fields(self, "SIRT", iterations=(1, math.inf))

    def steps(self) -> int:
        return self.iterations

    def solve(self, A: CountingProjector, y: Tensor, on_step: Callable[[], None]) -> Tensor:
        density = empty(A, y)
        sums = A.linear(density + 1), A.T(torch.ones_like(y))
        rows, columns = (1 / w.clamp(min=1e-6 * float(w.max())) for w in sums)
        for _ in range(self.iterations):
            density = (density + columns * A.T(rows * (y - A(density)))).clamp(min=0)
            on_step()
        return density
