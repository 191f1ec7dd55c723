"""Laws that any linear operator must keep, as reusable assertions, and the total variation.

An operator here is a function of one tensor, with its adjoint given as a second function.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch

from phydict.linalg.total_variation import UNIT, differences


def random_like(shape, dtype=torch.float64, seed: int = 0) -> torch.Tensor:
    """Standard normal numbers of `shape`, the same for the same seed."""
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64).to(dtype)


def assert_adjoint(forward, adjoint, shape_in, dtype=torch.float64, tolerance: float = 1e-10) -> None:
    """<A x, y> = <x, A' y> relative to |A x| |y|, for signed and for positive random x and y."""
    for positive in (False, True):
        x = random_like(shape_in, dtype, seed=1)
        y = random_like(forward(x).shape, dtype, seed=2)
        if positive:
            x, y = x.abs(), y.abs()
        ax, aty = forward(x), adjoint(y)
        assert ax.dtype == dtype and aty.dtype == dtype and aty.shape == x.shape
        left, right = (ax.double() * y.double()).sum(), (x.double() * aty.double()).sum()
        scale = ax.double().norm() * y.double().norm()
        assert scale > 0, "the operator maps a random volume to zero: the law would hold for any adjoint"
        assert abs(left - right) <= tolerance * scale, f"<Ax,y> = {left:.12g}, <x,A'y> = {right:.12g}"


def assert_linear(forward, shape_in, dtype=torch.float64, tolerance: float = 1e-12) -> None:
    """A(2 x - 3 y) = 2 A x - 3 A y."""
    x, y = random_like(shape_in, dtype, seed=3), random_like(shape_in, dtype, seed=4)
    expected = 2 * forward(x) - 3 * forward(y)
    assert (forward(2 * x - 3 * y) - expected).norm() <= tolerance * expected.norm()


def assert_gradient_is_adjoint(forward, adjoint, shape_in, dtype=torch.float64, tolerance: float = 1e-12) -> None:
    """The gradient of |A x - y|^2 / 2 is A'(A x - y), and differentiating once more gives A'A."""
    x = random_like(shape_in, dtype, seed=5).requires_grad_()
    residual = forward(x) - random_like(forward(x).shape, dtype, seed=6)
    (gradient,) = torch.autograd.grad(residual.square().sum() / 2, x, create_graph=True)
    expected = adjoint(residual.detach())
    assert (gradient - expected).norm() <= tolerance * expected.norm()
    direction = random_like(shape_in, dtype, seed=7)
    (curvature,) = torch.autograd.grad((gradient * direction).sum(), x)
    expected = adjoint(forward(direction))
    assert (curvature - expected).norm() <= tolerance * expected.norm()


def total_variation(x: torch.Tensor, scales: Sequence[float] = UNIT, eps: float = 0.0) -> torch.Tensor:
    """The sum over voxels of sqrt(|forward differences|^2 + eps^2)."""
    return (eps**2 + differences(x, scales).square().sum(0)).sqrt().sum()
