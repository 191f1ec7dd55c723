"""Conjugate gradients for symmetric positive systems, one system per case of a batch."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor


def conjugate_gradients(operator: Callable[[Tensor], Tensor], right: Tensor, iterations: int, tolerance: float = 1e-6,
                        preconditioner: Tensor | float = 1.0, on_step: Callable[[], None] = lambda: None) -> Tensor:
    """d with operator(d) = right (B, ...), from zero (Hestenes & Stiefel 1952, doi:10.6028/jres.049.044).

    iterations: at most; a case is left alone once its residual has shrunk by `tolerance`. Where the operator is
    singular and `right` in its range, this is the solution of least norm. preconditioner: diagonal of an approximate
    inverse; where it is 0, d stays 0. on_step: called `iterations` times, as each is done or found needless.
    """
    over = tuple(range(1, right.ndim))
    residual, d = right.clone(), torch.zeros_like(right)
    direction = preconditioner * residual
    energy = (residual * direction).sum(over, keepdim=True)
    stop = energy * tolerance**2
    for _ in range(iterations):
        if (energy > stop).any():
            product = operator(direction)
            curvature = (direction * product).sum(over, keepdim=True)
            active = (energy > stop) & (curvature > 0)
            step = torch.where(active, energy / curvature, 0)
            d.addcmul_(step, direction)
            residual.addcmul_(step, product, value=-1)
            scaled = preconditioner * residual
            previous, energy = energy, torch.where(active, (residual * scaled).sum(over, keepdim=True), energy)
            direction.mul_(torch.where(active, energy / previous, 0)).add_(scaled)
        on_step()
    return d
