"""How well line integrals fit: relative residuals."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

EPS_LINE_INTEGRAL = 1e-3
"""A line integral, 0.05 mm of water, below which misfits are not relative to what is measured, but to this."""


def view_norms(views: Tensor) -> Tensor:
    return views.flatten(-2).norm(dim=-1)


def shared_norms(views: Tensor) -> Tensor:
    """Norms (..., K) of what pixels of views (..., K, V, U) share with their neighbours: those of views without noise
    that changes little from pixel to pixel, and about 0 for white noise."""
    products = torch.cat([(views[..., 1:, :] * views[..., :-1, :]).flatten(-2),
                          (views[..., 1:] * views[..., :-1]).flatten(-2)], -1)
    return (products.mean(-1).clamp(min=0) * (views.shape[-1] * views.shape[-2])).sqrt()


def misfits(reprojection: Tensor, xrays: Tensor, norms: Callable[[Tensor], Tensor] = view_norms) -> dict:
    """Relative residual |P - y| / |y| of line integrals (K, V, U): over all views and per view; by shared_norms,
    without what is noise."""
    residual, size = norms(reprojection - xrays), view_sizes(xrays)
    return {"misfit": float(residual.norm() / size.norm()), "misfit_per_view": (residual / size).tolist()}


def worst_misfit(projections: Tensor, xrays: Tensor, norms: Callable[[Tensor], Tensor] = view_norms) -> Tensor:
    """The largest relative residual over all views of projections (B, K, V, U) of X-rays (1, K, V, U), a scalar."""
    return (norms(projections - xrays).norm(dim=-1) / view_sizes(xrays).norm(dim=-1)).max()


def view_sizes(xrays: Tensor) -> Tensor:
    """Norms (..., K) of views (..., K, V, U), of which none counts as smaller than one of EPS_LINE_INTEGRAL in every
    pixel."""
    return view_norms(xrays).clamp(min=EPS_LINE_INTEGRAL * math.sqrt(xrays.shape[-1] * xrays.shape[-2]))
