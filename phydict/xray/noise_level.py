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
    """Standard deviation (K, V, U) of the noise of each pixel of X-rays (K, V, U), taken as independent between pixels.

    Second differences along rows and columns cancel whatever is linear along either, so that of anatomy only edges are
    left (Immerkaer 1996, doi:10.1006/cviu.1996.0060); their median does not see edges as long as these are few. It is
    taken apart in BINS equal groups of a view's pixels, sorted by the mean of their neighbourhoods, since counted
    photons leave noise that grows with what is in their way. What is finer than the pixels reads as noise.

    Of views with a side below 3 pixels the differences are those along the other, and the median is that of all; with
    both below 3 they have none.
    """
    if min(xrays.shape[-2:]) < 3:
        axis = -1 if xrays.shape[-1] >= 3 else -2
        if xrays.shape[axis] < 3:
            return torch.zeros_like(xrays)
        rough = (xrays.diff(n=2, dim=axis).abs() / (6**0.5 * MEDIAN)).flatten(1)
        return rough.median(1).values[:, None, None].expand_as(xrays)
    rough = (xrays.diff(n=2, dim=-1).diff(n=2, dim=-2).abs() / (6 * MEDIAN)).flatten(1)
    levels = torch.zeros_like(rough)
    for group in avg_pool2d(xrays, 3, 1).flatten(1).argsort(1).tensor_split(BINS, 1):
        if group.shape[1]:
            level = rough.gather(1, group).median(1, keepdim=True).values
            levels.scatter_(1, group, level.expand_as(group))
    return pad(levels.view(xrays.shape[0], 1, xrays.shape[1] - 2, -1), (1, 1, 1, 1), "replicate")[:, 0]
