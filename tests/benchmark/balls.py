"""Balls that benchmarks put into lungs as nodules, and how much of their contrast a reconstruction shows."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import avg_pool3d

from phydict.grid import Grid

SHELL = 1.5
"""Radius, in a nodule's own, up to which its surroundings reach."""


def nodule(grid: Grid, centre: Sequence[float], diameter: float, finer: int = 3) -> Tensor:
    """Share (X, Y, Z) of each voxel that a ball of `diameter` mm around a world point (mm) fills, sampled `finer` times
    along each side."""
    steps = (np.arange(finer) - (finer - 1) / 2) / finer
    places = [(np.arange(n)[:, None] + steps).ravel() for n in grid.shape]
    middle = grid.index(centre)
    squares = [((place - at) * s) ** 2 for place, at, s in zip(places, middle, grid.spacing)]
    inside = squares[0][:, None, None] + squares[1][:, None] + squares[2] < (diameter / 2) ** 2
    blocks = torch.from_numpy(inside)[None, None].float()
    return avg_pool3d(blocks, finer)[0, 0]


def recovered_contrast(with_nodule: Tensor, without: Tensor, grid: Grid, centre: Sequence[float], diameter: float,
                       contrast: float) -> float:
    """The share of a nodule's contrast (HU) that reconstructions (X, Y, Z) with and without it differ by: their mean
    difference in the ball less that in the shell around it, up to SHELL radii."""
    ball = nodule(grid, centre, diameter)
    shell = (nodule(grid, centre, SHELL * diameter) - ball).clamp(min=0)
    change = with_nodule - without
    inside, around = (float((change * weight).sum() / weight.sum()) for weight in (ball, shell))
    return (inside - around) / contrast
