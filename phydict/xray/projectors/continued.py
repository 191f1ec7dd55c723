"""A volume that continues above and below its voxels, each column as its last voxel does."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from torch import Tensor
from torch.nn.functional import pad

from phydict.grid import Grid
from phydict.xray.geometry import LEAST_MM, ConeBeam


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
    up = grid.affine[:3, 2] / grid.spacing[2]
    across = beam.normals - np.outer(beam.normals @ up, up)
    across *= np.hypot(*(grid.extent[:2] / 2)) / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), LEAST_MM)
    rows, columns = ((n - 1) / 2 * step for n, step in zip(beam.shape, (beam.v, beam.u)))
    places = []
    for side in (-across, across):  # where rays come over the columns, and where they leave them
        depth = ((grid.centre + side - beam.sources) * beam.normals).sum(1) / beam.distances
        for pixel in (rows + columns, rows - columns, columns - rows, -rows - columns):
            ray = beam.detectors + pixel - beam.sources
            places.append(grid.index(beam.sources + depth.clip(0, 1)[:, None] * ray)[:, 2])
    return max(0, math.ceil(max(-np.min(places), np.max(places) - (grid.shape[2] - 1))))
