"""Total variation, smoothed so that it has a gradient, and the quadratic that touches it from above."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn.functional import pad


def differences(x: Tensor, axes: Sequence[int] = (2, 3, 4)) -> list[Tensor]:
    """Forward differences of x (B, 1, X, Y, Z) along `axes`, each one voxel shorter along its axis."""
    return [x.diff(dim=axis) for axis in axes]


def differences_adjoint(d: list[Tensor], axes: Sequence[int] = (2, 3, 4)) -> Tensor:
    """The adjoint of `differences`."""
    return -sum(pad(one, [0, 0] * (4 - axis) + [1, 1]).diff(dim=axis) for axis, one in zip(axes, d))


def smoothed_tv(x: Tensor, eps: float) -> Tensor:
    """The sum over voxels of sqrt(|forward differences|^2 + eps^2)."""
    return (eps**2 + _squared_slope(x)).sqrt().sum()


class TVQuadraticMajorizer:
    """The quadratic sum over voxels of w |forward differences|^2 / 2, w = 1 / sqrt(slope^2 + eps^2) taken at `x`.

    Up to a constant it lies above the smoothed total variation and has its value and gradient at x, so that minimising
    it lowers the variation (lagged diffusivity, Vogel & Oman 1996, doi:10.1137/0917016).
    """

    def __init__(self, x: Tensor, eps: float):
        w = 1 / (eps**2 + _squared_slope(x)).sqrt()
        self.weights = [w.narrow(axis, 0, w.shape[axis] - 1) for axis in (2, 3, 4)]

    def gradient(self, x: Tensor) -> Tensor:
        """The quadratic's gradient at x, which is linear."""
        return differences_adjoint([w * d for w, d in zip(self.weights, differences(x))])

    def diagonal(self) -> Tensor:
        """The diagonal of the quadratic's matrix: what `gradient` makes of a voxel there itself."""
        ends = [([0, 0] * (4 - axis) + [0, 1], [0, 0] * (4 - axis) + [1, 0]) for axis in (2, 3, 4)]
        return sum(pad(w, below) + pad(w, above) for w, (below, above) in zip(self.weights, ends))


def _squared_slope(x: Tensor) -> Tensor:
    total = torch.zeros_like(x)
    for axis, d in zip((2, 3, 4), differences(x)):
        total.narrow(axis, 0, d.shape[axis]).add_(d.square())
    return total
