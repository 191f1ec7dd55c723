"""Where on a detector the rays through a grid's voxels end."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from phydict.grid import Grid
from phydict.xray.geometry import ConeBeam

LEAST_DEPTH = 1e-3
"""Least distance from the source, as a share of the detector's, at which a voxel is taken to lie."""


def detector_places(grid: Grid, beam: ConeBeam, view: int, like: Tensor) -> tuple[Tensor, Tensor]:
    """Of each voxel's centre, its distance (X, Y, Z) in mm from the source across the detector's plane, and where its
    ray meets the detector: column and row (X, Y, Z, 2), -1 and 1 at the detector's edges, as grid_sample takes them
    without align_corners. Both have the type and device of `like`."""
    axes = [torch.arange(m) for m in grid.shape]
    start = grid.affine[:3, 3] - beam.sources[view]

    def along(direction: np.ndarray) -> Tensor:
        """The voxels' coordinate (X, Y, Z) from the source along a direction."""
        x, y, z = (s * axis.to(like) for s, axis in zip(direction @ grid.affine[:3, :3], axes))
        return x[:, None, None] + y[:, None] + z + direction @ start

    distance = beam.distances[view]
    depth = along(beam.normals[view]).clamp(min=LEAST_DEPTH * distance)
    places = []
    for step, size in ((beam.u[view], beam.shape[1]), (beam.v[view], beam.shape[0])):
        unit = step / (step @ step)  # from mm to pixels
        pixel = along(unit) * (distance / depth) - unit @ (beam.detectors[view] - beam.sources[view])
        places.append(2 * pixel / size)
    return depth, torch.stack(places, -1)
