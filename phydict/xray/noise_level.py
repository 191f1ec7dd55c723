"""How noisy X-rays are, read off the X-rays themselves."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, pad

MEDIAN = 0.6745
"""Median of the absolute value of a standard normal number."""
BINS = 16
"""Groups of pixels of like value in which the noise is found apart."""


def noise_level(xrays: Tensor) -> Tensor:
    """Standard deviation (K,) of the noise of each view of X-rays (K, V, U), taken as independent between pixels.

    Second differences along rows and columns cancel whatever is linear along either, so that of anatomy only edges are
    left (Immerkaer 1996, doi:10.1006/cviu.1996.0060); their median does not see edges as long as these are few. What
    is finer than the pixels reads as noise. Views with a side below 3 pixels have none.
    """
    if min(xrays.shape[-2:]) < 3:
        return xrays.new_zeros(len(xrays))
    return _roughness(xrays).flatten(1).median(1).values


def noise_by_value(xrays: Tensor) -> Tensor:
    """Standard deviation (K, V, U) of the noise of each pixel of X-rays (K, V, U): that of its view's pixels of like
    value.

    As `noise_level`, in each of BINS equal groups of a view's pixels, sorted by the mean of their neighbourhoods, since
    counted photons leave noise that grows with what is in their way. Views with a side below 3 pixels have none.
    """
    if min(xrays.shape[-2:]) < 3:
        return torch.zeros_like(xrays)
    rough, order = _roughness(xrays), avg_pool2d(xrays, 3, 1).flatten(1).argsort(1)
    found = torch.zeros_like(rough).flatten(1)
    for group in order.tensor_split(BINS, 1):
        if group.shape[1]:
            level = rough.flatten(1).gather(1, group).median(1, keepdim=True).values
            found.scatter_(1, group, level.expand_as(group))
    return pad(found.view_as(rough)[None], (1, 1, 1, 1), "replicate")[0]


def _roughness(xrays: Tensor) -> Tensor:
    """Second differences (K, V - 2, U - 2), scaled to have the noise's standard deviation for their median."""
    return xrays.diff(n=2, dim=-1).diff(n=2, dim=-2).abs() / (6 * MEDIAN)
