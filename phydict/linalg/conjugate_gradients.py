"""Conjugate gradients for symmetric positive systems, one system per case of a batch."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

KEPT = 32
"""Residuals for which there is room at first; it doubles where more iterations are done."""


def conjugate_gradients(operator: Callable[[Tensor], Tensor], right: Tensor, iterations: int, tolerance: float = 1e-6,
                        preconditioner: Tensor | float = 1.0, on_step: Callable[[], None] = lambda: None,
                        reorthogonalise: bool = False) -> Tensor:
    """d with operator(d) = right (B, ...), from zero (Hestenes & Stiefel 1952, doi:10.6028/jres.049.044).

    iterations: at most; a case is left alone once its residual has shrunk by `tolerance`, or to what rounding leaves,
    from where on nothing is gained and kept residuals are no longer orthogonal. Where the operator is singular and
    `right` in its range, this is the solution of least norm. preconditioner: diagonal of an approximate inverse; where
    it is 0, d stays 0. on_step: called `iterations` times, as each is done or found needless.
    reorthogonalise: each residual is made orthogonal again to all before it, which in single precision it no longer is
    after a dozen iterations, so that what more of them give turns on the last digit (Golub & Van Loan, Matrix
    Computations, 10.3); takes the memory of up to two right sides for each iteration that is done.
    """
    over = tuple(range(1, right.ndim))
    residual, d = right.clone(), torch.zeros_like(right)
    direction = preconditioner * residual
    energy = (residual * direction).sum(over, keepdim=True)
    stop = energy * max(tolerance, torch.finfo(right.dtype).eps) ** 2
    kept = right.new_empty(min(iterations, KEPT), len(right), right[0].numel()) if reorthogonalise else None
    for n in range(iterations):
        if (energy > stop).any():
            product = operator(direction)
            curvature = (direction * product).sum(over, keepdim=True)
            active = (energy > stop) & (curvature > 0)
            step = torch.where(active, energy / curvature, 0)
            d.addcmul_(step, direction)
            if kept is not None:
                if n == len(kept):
                    kept = torch.cat([kept, torch.empty_like(kept)])
                torch.mul(residual, torch.where(active, energy.rsqrt(), 0), out=kept[n].view_as(residual))
            residual.addcmul_(step, product, value=-1)
            if kept is not None:
                shares = torch.einsum("nbi,bi->nb", kept[:n + 1], (preconditioner * residual).flatten(1))
                residual.sub_(torch.einsum("nb,nbi->bi", shares, kept[:n + 1]).view_as(residual))
            scaled = preconditioner * residual
            previous, energy = energy, torch.where(active, (residual * scaled).sum(over, keepdim=True), energy)
            direction.mul_(torch.where(active, energy / previous, 0)).add_(scaled)
        on_step()
    return d


def may_follow(x: Tensor, direction: Tensor, low: float, high: float) -> Tensor:
    """Whether each value of x in [low, high] may go along `direction`, which those at a bound may not beyond it."""
    return ~((x <= low) & (direction < 0) | (x >= high) & (direction > 0))


def most_kept(iterations: int) -> int:
    """How many residuals, each of the size of the right side, are held at most where so many iterations are done
    orthogonally; while their room doubles both rooms are."""
    room = most = min(iterations, KEPT)
    while room < iterations:
        room, most = 2 * room, 4 * room
    return most
