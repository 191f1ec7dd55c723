"""Total variation: forward differences and their adjoint, the proximal step, and the quadratic that touches a smoothed
one from above.

Differences are scaled per axis: 1 / spacing makes slopes of them, 0 leaves an axis out.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

UNIT = (1.0, 1.0, 1.0)


def differences(x: Tensor, scales: Sequence[float] = UNIT) -> Tensor:
    """Scaled forward differences (3, B, 1, X, Y, Z) of x (B, 1, X, Y, Z) along its last three axes, 0 at the end."""
    result = x.new_empty(3, *x.shape)
    for axis, scale in enumerate(scales, 2):
        difference, n = result[axis - 2], x.shape[axis] - 1
        difference.narrow(axis, 0, n).copy_(x.diff(dim=axis))
        difference.narrow(axis, n, 1).zero_()
        if scale != 1:
            difference.mul_(scale)
    return result


def differences_adjoint(p: Tensor, scales: Sequence[float] = UNIT) -> Tensor:
    """The exact adjoint of `differences`: (3, B, 1, X, Y, Z) -> (B, 1, X, Y, Z)."""
    result = torch.zeros_like(p[0])
    for axis, scale in enumerate(scales, 2):
        _add_adjoint(result, p[axis - 2].narrow(axis, 0, p.shape[1 + axis] - 1), axis, scale)
    return result


def _add_adjoint(result: Tensor, flux: Tensor, axis: int, scale: float) -> None:
    """Adds, in place, the adjoint of the forward differences along one axis, of what lies between its voxels."""
    n = flux.shape[axis]
    result.narrow(axis, 0, n).sub_(flux, alpha=scale)
    result.narrow(axis, 1, n).add_(flux, alpha=scale)


def finest_to_own(spacing: Sequence[float]) -> list[float]:
    """Per axis, the finest spacing divided by its own: what turns differences into slopes of equal unit."""
    return [min(spacing) / s for s in spacing]


def tv_proximal(v: Tensor, weight: float, scales: Sequence[float], clip: Callable[[Tensor], Tensor], iterations: int,
                dual: Tensor) -> tuple[Tensor, Tensor]:
    """argmin over x of |x - v|^2 / 2 + weight TV(x) where clip(x) = x, and its dual field (Beck & Teboulle 2009,
    doi:10.1109/TIP.2009.2028250).

    v: (1, 1, X, Y, Z). clip: the nearest admissible volume. dual: (3, *v.shape), where to start; zeros will do.
    """
    if weight == 0:
        return clip(v), dual
    step = 1 / (4 * sum(s**2 for s in scales) * weight)
    ahead, momentum = dual, 1.0
    for _ in range(iterations):
        descended = clip(v - differences_adjoint(ahead, scales).mul_(weight))
        new = differences(descended, scales).mul_(step).add_(ahead)
        new.div_(new.square().sum(0).sqrt_().clamp_(min=1))
        following = (1 + (1 + 4 * momentum**2) ** 0.5) / 2
        ahead = torch.sub(new, dual).mul_((momentum - 1) / following).add_(new)
        dual, momentum = new, following
    return clip(v - differences_adjoint(dual, scales).mul_(weight)), dual


class TVQuadraticMajorizer:
    """The quadratic sum over voxels of w |forward differences|^2 / 2, w = 1 / sqrt(slope^2 + eps^2) taken at `x`.

    Up to a constant it lies above the smoothed total variation and has its value and gradient at x, so that minimising
    it lowers the variation (lagged diffusivity, Vogel & Oman 1996, doi:10.1137/0917016).
    """

    def __init__(self, x: Tensor, eps: float, scales: Sequence[float] = UNIT):
        self.scales = scales
        squares = torch.full_like(x, eps**2)
        for axis, scale in enumerate(scales, 2):
            slopes = x.diff(dim=axis).mul_(scale)
            squares.narrow(axis, 0, x.shape[axis] - 1).addcmul_(slopes, slopes)
        self.weights = squares.rsqrt_()

    def gradient(self, x: Tensor) -> Tensor:
        """The quadratic's gradient at x, which is linear: adjoint of differences (w differences), an axis at a time."""
        result = torch.zeros_like(x)
        for axis, scale in enumerate(self.scales, 2):
            flux = x.diff(dim=axis).mul_(self.weights.narrow(axis, 0, x.shape[axis] - 1))
            _add_adjoint(result, flux, axis, scale**2)
        return result

    def diagonal(self) -> Tensor:
        """The diagonal of the quadratic's matrix: what `gradient` makes of a voxel there itself."""
        result = torch.zeros_like(self.weights)
        for axis, scale in enumerate(self.scales, 2):
            n = result.shape[axis] - 1
            inner = self.weights.narrow(axis, 0, n)
            result.narrow(axis, 0, n).add_(inner, alpha=scale**2)
            result.narrow(axis, 1, n).add_(inner, alpha=scale**2)
        return result
