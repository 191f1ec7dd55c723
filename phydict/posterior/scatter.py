"""Reconstructing again with scatter subtracted, where X-rays without it cannot be explained."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from phydict.posterior.measurement import Measurement

SCATTER_THRESHOLD = 2.5
"""The residual of X-rays, in units of their noise, from which on scatter is estimated: on the CTs that it was chosen on
ideal ones have 1.4 at most (those without noise whatever the grid cannot hold), polychromatic ones 1.4 to 3.5, those
with scatter of 6 % 2.7 to 17, fewer views less."""

SCATTER_GAIN = 0.6
"""What scatter, subtracted, must bring that residual down to, as a share of it, to be believed: on training CTs at 3 mm
a tube's spectrum alone is explained as scatter down to 0.52 to 0.83, scatter of 2 % down to 0.24 to 0.47."""


def with_scatter(measurement: Measurement, first: Callable[[], Tensor], again: Callable[[], Tensor]) -> Tensor:
    """The states of `first`; where their CTs miss the X-rays by more than SCATTER_THRESHOLD times their noise, those of
    `again`, run with scatter subtracted, if they miss less than SCATTER_GAIN of it."""
    measurement.reset_scatter(False)
    z = first()
    if not measurement.can_estimate_scatter:
        return z
    residual = measurement.normalised_residual(z[:, :1])
    if (residual > SCATTER_THRESHOLD).any():
        plain = measurement.fitted
        measurement.reset_scatter(True)
        second = again()
        better = (residual > SCATTER_THRESHOLD) & (
            measurement.normalised_residual(second[:, :1]) < SCATTER_GAIN * residual)
        if not better.any():
            measurement.fitted = plain
        z = torch.where(better, second, z)
    return z
