"""A volume that continues above and below its voxels, each column as its last voxel does."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from torch import Tensor
from torch.nn.functional import pad

from phydict.grid import Grid
from phydict.xray.geometry import ConeBeam

RAYS = 64
"""Rays along each side of a detector, those at its ends among them, of which the farthest is taken."""


class Continued:
    """The projection, and its adjoint, of a volume (B, X, Y, Z) whose first and last slices are repeated `slices` times
    beyond it, by the operator of the taller grid."""

    def __init__(self, operator: Any, slices: int):
        self.operator, self.slices = operator, slices

    def forward(self, mu: Tensor) -> Tensor:
        return self.operator.forward(pad(mu, (self.slices, self.slices, 0, 0, 0, 0), mode="replicate"))

    def adjoint(self, xrays: Tensor) -> Tensor:
        tall, n = self.operator.adjoint(xrays), self.slices
        back = tall[..., n:-n].clone()
        back[..., 0] += tall[..., :n].sum(-1)
        back[..., -1] += tall[..., -n:].sum(-1)
        return back


def reach_beyond(beam: ConeBeam, grid: Grid) -> int:
    """How many slices above or below a grid the detector's rays meet, at most, while they are over its columns."""
    rows, columns = (np.linspace(-(n - 1) / 2, (n - 1) / 2, min(n, RAYS)) for n in beam.shape)
    pixels = beam.detectors[:, None, None] + rows[:, None, None] * beam.v[:, None, None] + (
        columns[:, None] * beam.u[:, None, None])
    source = grid.index(beam.sources)[:, None, None]
    ray = grid.index(pixels) - source
    with np.errstate(divide="ignore", invalid="ignore"):  # rays along a face or beside the columns
        faces = [(face - source[..., :2]) / ray[..., :2] for face in (-1.0, np.array(grid.shape[:2]))]
        enters = np.fmax.reduce(np.fmin(*faces), -1, initial=0.0)
        leaves = np.fmin.reduce(np.fmax(*faces), -1, initial=1.0)
        heights = [(source[..., 2] + t * ray[..., 2])[enters < leaves] for t in (enters, leaves)]
    low, high = np.min(heights, initial=0.0), np.max(heights, initial=grid.shape[2] - 1)
    return math.ceil(max(-low, high - (grid.shape[2] - 1)))
