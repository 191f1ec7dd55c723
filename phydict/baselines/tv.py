"""Least squares with total variation, by accelerated proximal gradients (FISTA)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from phydict.baselines.baseline import Baseline, CountingProjector, clip, empty, norm
from phydict.units import MU_WATER, HUWindow


@dataclass(frozen=True)
class FISTATV(Baseline):
    """argmin |A x - y|^2 / (2 |A|^2) + weight TV(x) over densities x inside the window, from zero.

    x is relative to water, |A| the operator's norm (power iteration), TV the isotropic total variation: the sum over
    voxels of the length of the forward differences, those along coarser axes scaled down to the finest spacing. Beck
    & Teboulle 2009, doi:10.1137/080716542 (FISTA, with the adaptive restart of O'Donoghue & Candes 2015,
    doi:10.1007/s10208-013-9150-3) and doi:10.1109/TIP.2009.2028250 (the proximal step, by its dual).

    weight: more is smoother; inner: dual iterations per proximal step, each starting where the last one ended; window:
    HU bounds, whose low end of -1000 HU is non-negativity, or None for none.
    """

    citation = ("Beck & Teboulle, Fast Gradient-Based Algorithms for Constrained Total Variation Image Denoising and "
                "Deblurring Problems, IEEE Transactions on Image Processing 18(11), 2009, doi:10.1109/TIP.2009.2028250")

    iterations: int = 400
    weight: float = 3e-4
    inner: int = 5
    window: HUWindow | None = HUWindow()
    mu_water: float = MU_WATER
    name: str = "tv"

    def __post_init__(self):
        super().__post_init__()
        for what in ("iterations", "inner"):
            if getattr(self, what) < 1:
                raise ValueError(f"FISTA-TV needs {what} of at least 1, but {getattr(self, what)} was given")
        if not self.weight >= 0:
            raise ValueError(f"the weight of total variation must not be negative, but {self.weight} was given")

    def steps(self) -> int:
        return self.iterations

    def solve(self, A: CountingProjector, y: Tensor, on_step: Callable[[], None]) -> Tensor:
        lipschitz = max(1.02 * norm(A, y) ** 2, 1e-30)  # power iteration approaches the norm from below
        scales = finest_to_own(A.grid.spacing)
        x = ahead = clip(empty(A, y), self.window)
        dual, momentum = x.new_zeros(3, *x.shape), 1.0
        for _ in range(self.iterations):
            descended = ahead + A.T(y - A(ahead)) / lipschitz
            new, dual = tv_proximal(descended, self.weight, scales, self.window, self.inner, dual)
            if ((ahead - new) * (new - x)).sum() > 0:
                momentum = 1.0
            following = (1 + (1 + 4 * momentum**2) ** 0.5) / 2
            ahead = new + (momentum - 1) / following * (new - x)
            x, momentum = new, following
            on_step()
        return x


def tv_proximal(v: Tensor, weight: float, scales: Sequence[float], window: HUWindow | None, iterations: int,
                dual: Tensor) -> tuple[Tensor, Tensor]:
    """argmin over x in the window of |x - v|^2 / 2 + weight TV(x), and its dual field.

    v: (1, 1, X, Y, Z) densities relative to water. dual: (3, *v.shape), where to start; zeros will do.
    """
    if weight == 0:
        return clip(v, window), dual
    step = 1 / (4 * sum(s**2 for s in scales) * weight)
    ahead, momentum = dual, 1.0
    for _ in range(iterations):
        tried = ahead + step * differences(clip(v - weight * differences_adjoint(ahead, scales), window), scales)
        new = tried / tried.square().sum(0).sqrt().clamp(min=1)
        following = (1 + (1 + 4 * momentum**2) ** 0.5) / 2
        ahead = new + (momentum - 1) / following * (new - dual)
        dual, momentum = new, following
    return clip(v - weight * differences_adjoint(dual, scales), window), dual


def total_variation(x: Tensor, scales: Sequence[float]) -> Tensor:
    """The sum over voxels of the length of the scaled forward differences."""
    return differences(x, scales).square().sum(0).sqrt().sum()


def finest_to_own(spacing: Sequence[float]) -> list[float]:
    """Per axis, the finest spacing divided by its own: what turns differences into slopes of equal unit."""
    return [min(spacing) / s for s in spacing]


def differences(x: Tensor, scales: Sequence[float]) -> Tensor:
    """Scaled forward differences (3, B, 1, X, Y, Z) of x (B, 1, X, Y, Z) along its last three axes, 0 at the end."""
    result = x.new_zeros(3, *x.shape)
    for axis, scale in enumerate(scales):
        n = x.shape[2 + axis] - 1
        result[axis].narrow(2 + axis, 0, n).copy_(scale * x.diff(dim=2 + axis))
    return result


def differences_adjoint(p: Tensor, scales: Sequence[float]) -> Tensor:
    """The exact adjoint of `differences`: (3, B, 1, X, Y, Z) -> (B, 1, X, Y, Z)."""
    result = torch.zeros_like(p[0])
    for axis, scale in enumerate(scales):
        n = p.shape[3 + axis] - 1
        inner = scale * p[axis].narrow(2 + axis, 0, n)
        result.narrow(2 + axis, 0, n).sub_(inner)
        result.narrow(2 + axis, 1, n).add_(inner)
    return result
