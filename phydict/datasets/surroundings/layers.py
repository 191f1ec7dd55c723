"""Shares of voxels between curves y(x): exact in y, sampled finely in x."""

from __future__ import annotations

import numpy as np

FINE = 4
"""Samples across a voxel in x."""


def fine(x: np.ndarray) -> np.ndarray:
    """Places (FINE X,) in mm, FINE spread evenly over each voxel, of voxels with centres `x` (X,) in mm."""
    places = (np.arange(FINE) + 0.5) / FINE - 0.5
    return (x[:, None] + places * (x[1] - x[0])).ravel()


def between(low: np.ndarray, high: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Share (X, Y, ...) of each voxel between the heights `low` and `high` (FINE X, ...); `y` (Y,) centres; all mm."""
    step = y[1] - y[0]
    rows = y.reshape(-1, *[1] * (low.ndim - 1))
    share = np.minimum(high[:, None], rows + step / 2)
    share -= np.maximum(low[:, None], rows - step / 2)
    np.maximum(share, 0, out=share)
    return share.reshape(-1, FINE, *share.shape[1:]).mean(1) / step
