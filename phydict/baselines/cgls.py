"""CGLS: conjugate gradients on the least-squares problem, regularised by stopping early."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from torch import Tensor

from phydict.baselines.baseline import Baseline, CountingProjector, bounds, clip, empty
from phydict.linalg.conjugate_gradients import conjugate_gradients, may_follow
from phydict.runtime.ranges import check_fields
from phydict.units import MU_WATER, HUWindow


@dataclass(frozen=True)
class CGLS(Baseline):
    """Towards argmin |A mu - y|^2, by conjugate gradients from zero (Hestenes & Stiefel 1952,
    doi:10.6028/jres.049.044).

    What the views see best is corrected first, so few iterations regularise and many fit the noise.

    Args:
        iterations: of conjugate gradients per restart
        restarts: each frees the voxels inside the bounds or pulled back into them, runs conjugate gradients on those
            alone and clips (More & Toraldo 1991, doi:10.1137/0801008); without bounds one is the classical method
        window: HU bounds, whose low end of -1000 HU is non-negativity, or None for none
        mu_water: attenuation of water in 1/mm in the X-rays
        name: what results call the method
    """

    citation = ("Hestenes & Stiefel, Methods of Conjugate Gradients for Solving Linear Systems, Journal of Research "
                "of the National Bureau of Standards 49(6), 1952, doi:10.6028/jres.049.044")

    iterations: int = 10
    restarts: int = 1
    window: HUWindow | None = None
    mu_water: float = MU_WATER
    name: str = "cgls"

    def __post_init__(self):
        super().__post_init__()
        check_fields(self, "CGLS", iterations=(1, math.inf), restarts=(1, math.inf))

    def steps(self) -> int:
        return self.iterations * self.restarts

    def solve(self, A: CountingProjector, y: Tensor, on_step: Callable[[], None]) -> Tensor:
        density = clip(empty(A, y), self.window)
        for _ in range(self.restarts):
            negative_gradient = A.T(y - A(density))
            free = may_follow(density, negative_gradient, *bounds(self.window))
            density = clip(density + conjugate_gradients(
                lambda d, free=free: free * A.T(A.linear(d)),  # type: ignore[misc]
                free * negative_gradient, self.iterations, on_step=on_step), self.window)
        return density
