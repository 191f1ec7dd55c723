"""How noisy X-rays are, read off the X-rays themselves."""

from __future__ import annotations

import torch
from torch import Tensor

MEDIAN = 0.6745
"""Median of the absolute value of a standard normal number."""


def noise_level(xrays: Tensor) -> Tensor:
    """Standard deviation (K,) of the noise of each view of X-rays (K, V, U), taken as independent between pixels.

    Second differences along rows and columns cancel whatever is linear along either, so that of anatomy only edges are
    left (Immerkaer 1996, doi:10.1006/cviu.1996.0060); their median does not see edges as long as these are few. What
    is finer than the pixels reads as noise. Views with a side below 3 pixels have none.
    """
    if min(xrays.shape[-2:]) < 3:
        return xrays.new_zeros(len(xrays))
    rough = xrays.diff(n=2, dim=-1).diff(n=2, dim=-2)
    return rough.abs().flatten(1).median(1).values / (6 * MEDIAN)
