"""Least squares with total variation, by accelerated proximal gradients (FISTA)."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from torch import Tensor

from phydict.baselines.baseline import Baseline, CountingProjector, clip, empty
from phydict.linalg.power_iteration import operator_norm
from phydict.linalg.total_variation import finest_to_own, tv_proximal
from phydict.runtime.ranges import MOST, check_fields
from phydict.units import MU_WATER, HUWindow


@dataclass(frozen=True)
class FISTATV(Baseline):
    """argmin K |A x - y|^2 / (2 |A|^2) + weight TV(x) over densities x inside the window, from zero.

    x is relative to water, K the number of views and |A| the operator's norm (power iteration), so that each view adds
    about as much to the first term. TV is the isotropic total variation: the sum over voxels of the length of the
    forward differences, those along coarser axes scaled down to the finest spacing; since these look one way, a volume
    on flipped axes is not quite the flipped volume, by some 20 HU rms from few views. Beck & Teboulle 2009,
    doi:10.1137/080716542 (FISTA, with the adaptive restart of O'Donoghue & Candes 2015,
    doi:10.1007/s10208-013-9150-3) and doi:10.1109/TIP.2009.2028250 (the proximal step, by its dual).

    Args:
        iterations: of FISTA
        weight: of the total variation; more is smoother. Voxels half as long want about twice of it, X-rays that were
            simulated on the voxels themselves a third, others up to three times
        inner: dual iterations per proximal step, each starting where the last one ended
        window: HU bounds, whose low end of -1000 HU is non-negativity, or None for none
        mu_water: attenuation of water in 1/mm in the X-rays
        name: what results call the method
    """

    citation = ("Beck & Teboulle, Fast Gradient-Based Algorithms for Constrained Total Variation Image Denoising and "
                "Deblurring Problems, IEEE Transactions on Image Processing 18(11), 2009, doi:10.1109/TIP.2009.2028250")

    iterations: int = 400
    weight: float = 2.4e-3
    inner: int = 5
    window: HUWindow | None = HUWindow()
    mu_water: float = MU_WATER
    name: str = "tv"

    def __post_init__(self):
        super().__post_init__()
        check_fields(self, "FISTATV", iterations=(1, math.inf), inner=(1, math.inf), weight=(0, MOST))

    @property
    def volumes(self) -> int:
        return 36  # the proximal step works on gradients and dual of three components each

    def steps(self) -> int:
        return self.iterations

    def solve(self, A: CountingProjector, y: Tensor, on_step: Callable[[], None]) -> Tensor:
        squared_norm = max(1.02 * operator_norm(A.linear, A.T, empty(A, y) + 1, 1e-4, 50) ** 2, 1e-30)  # from below
        scales = finest_to_own(A.grid.spacing)
        def bounded(density: Tensor) -> Tensor:
            return clip(density, self.window)

        x = ahead = bounded(empty(A, y))
        dual, momentum = x.new_zeros(3, *x.shape), 1.0
        for _ in range(self.iterations):
            descended = ahead + A.T(y - A(ahead)) / squared_norm
            new, dual = tv_proximal(descended, self.weight / A.beam.views, scales, bounded, self.inner, dual)
            if ((ahead - new) * (new - x)).sum() > 0:
                momentum = 1.0
            following = (1 + (1 + 4 * momentum**2) ** 0.5) / 2
            ahead = new + (momentum - 1) / following * (new - x)
            x, momentum = new, following
            on_step()
        return x
