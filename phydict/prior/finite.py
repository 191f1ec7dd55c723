"""Weights that hold NaN or infinite values, found before anything is made of them."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor


def not_finite(weights: Mapping[str, Tensor]) -> str:
    """The first of the weights that is not finite, and how many values that concerns; empty where all are."""
    for name, weight in weights.items():
        if weight.dtype == torch.float4_e2m1fn_x2 or weight.layout != torch.strided or weight.is_meta or (
                weight.is_quantized):
            return f"{name} holds no plain numbers"
        if weight.is_floating_point() and weight.itemsize < 2:
            weight = weight.float()  # torch does not ask those of 8 bits
        if not weight.isfinite().all():
            return f"{name} has {int((~weight.isfinite()).sum())} NaN or infinite values of {weight.numel()}"
    return ""


def check_finite(weights: Mapping[str, Tensor], file: object) -> None:
    """Raises ValueError, naming the tensor, where the weights that `file` holds are not finite."""
    if broken := not_finite(weights):
        raise ValueError(f"'{file}' holds weights that are not finite ({broken}), so that nothing can come of it: give "
                         "an earlier checkpoint, or another prior")
