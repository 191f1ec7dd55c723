"""The linear map from attenuation to X-rays, its exact adjoint, and autograd through both."""

from __future__ import annotations

import torch

from phydict.grid import Grid
from phydict.xray.geometry import ConeBeam
from phydict.xray.separable import Separable, is_separable
from phydict.xray.siddon import Siddon

METHODS = ("auto", "separable", "siddon")


class Projector:
    """A: attenuation mu (B, 1, X, Y, Z) in 1/mm on `grid` -> line integrals (B, K, V, U) along the rays of `beam`.

    `A(mu)` and the exact adjoint `A.T(xrays)` are differentiable (to any order) in float32 and float64; geometry is
    computed once, in float64. mu is 0 outside the grid.
    method: "separable" is the fast one: trilinear volumes, upright detectors, any device (phydict.xray.separable);
    "siddon" integrates piecewise-constant voxels exactly for any pose, on the CPU (phydict.xray.siddon);
    "auto" takes "separable" where the poses permit it. `A.method` tells which one runs.
    Raises ValueError when a source or detector lies inside the volume, or the method does not suit the beam.
    """

    def __init__(self, grid: Grid, beam: ConeBeam, method: str = "auto"):
        if method not in METHODS:
            raise ValueError(f"there is no projector method {method!r}; choose one of {', '.join(METHODS)}")
        beam.check(grid)
        if method == "auto":
            method = "separable" if is_separable(grid, beam) else "siddon"
        self.grid, self.beam, self.method = grid, beam, method
        self._operator = Separable(grid, beam) if method == "separable" else Siddon(grid, beam)
        self._norm: float | None = None

    def __call__(self, mu: torch.Tensor) -> torch.Tensor:
        """Line integrals (B, K, V, U) of mu (B, 1, X, Y, Z)."""
        _check(mu, (1, *self.grid.shape), "mu")
        return _Linear.apply(mu[:, 0], self._operator, False)

    def T(self, xrays: torch.Tensor) -> torch.Tensor:
        """The exact adjoint: xrays (B, K, V, U) -> (B, 1, X, Y, Z), with <A mu, y> = <mu, A.T y>."""
        _check(xrays, (self.beam.views, *self.beam.shape), "xrays")
        return _Linear.apply(xrays, self._operator, True)[:, None]

    def norm(self) -> float:
        """The largest singular value of A, by power iteration to a relative change of 1e-5 (computed once).

        A has no negative weights, so its leading singular vector has none either and a constant start reaches it.
        """
        if self._norm is None:
            mu = torch.ones(1, 1, *self.grid.shape)
            norm, last = 0.0, -1.0
            for _ in range(200):
                if abs(norm - last) <= 1e-5 * norm:
                    break
                mu, last = self.T(self(mu / mu.norm())), norm
                norm = float(mu.norm()) ** 0.5
            self._norm = norm
        return self._norm


class _Linear(torch.autograd.Function):
    """y = A x or A' x; the gradient of the one is the other, so nothing is stored."""

    @staticmethod
    def forward(ctx, x, operator, transposed):
        ctx.operator, ctx.transposed = operator, transposed
        return operator.adjoint(x) if transposed else operator.forward(x)

    @staticmethod
    def backward(ctx, gradient):
        return _Linear.apply(gradient, ctx.operator, not ctx.transposed), None, None


def _check(x: torch.Tensor, shape: tuple[int, ...], name: str) -> None:
    if tuple(x.shape[1:]) != shape or x.ndim != len(shape) + 1:
        raise ValueError(f"{name} must be (batch, {', '.join(map(str, shape))}), but shape {tuple(x.shape)} was given")
    if x.dtype not in (torch.float32, torch.float64):
        raise ValueError(f"{name} must be float32 or float64, but {x.dtype} was given; convert it with .float()")
