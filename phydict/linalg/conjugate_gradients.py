"""Conjugate gradients for symmetric positive systems, one system per case of a batch."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor


def conjugate_gradients(operator: Callable[[Tensor], Tensor], right: Tensor, iterations: int,
                        tolerance: float = 1e-6) -> Tensor:
    """d with operator(d) = right (B, ...), from zero (Hestenes & Stiefel 1952, doi:10.6028/jres.049.044).

    iterations: at most; a case is left alone once its residual has shrunk by `tolerance`. Where the operator is
    singular and `right` in its range, this is the solution of least norm.
    """
    over = tuple(range(1, right.ndim))
    residual, direction, d = right, right, torch.zeros_like(right)
    energy = right.square().sum(over, keepdim=True)
    stop = energy * tolerance**2
    for _ in range(iterations):
        if not (energy > stop).any():
            break
        curved = operator(direction)
        curvature = (direction * curved).sum(over, keepdim=True)
        active = (energy > stop) & (curvature > 0)
        step = torch.where(active, energy / curvature, 0)
        d, residual = d + step * direction, residual - step * curved
        previous, energy = energy, torch.where(active, residual.square().sum(over, keepdim=True), energy)
        direction = residual + torch.where(active, energy / previous, 0) * direction
    return d
