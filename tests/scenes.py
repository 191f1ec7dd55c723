"""Scenes that several tests see: where voxels lie, a ball's exact line integrals, a block of soft tissue."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from phydict.grid import Grid
from phydict.units import MU_WATER, HUWindow
from phydict.xray import ConeBeam

WINDOW = HUWindow(-1000, 600)


def voxel_centres(grid: Grid) -> np.ndarray:
    """World positions (X, Y, Z, 3) in mm."""
    return np.moveaxis(np.indices(grid.shape), 0, -1) @ grid.affine[:3, :3].T + grid.affine[:3, 3]


def ball(beam: ConeBeam, radius: float, centre=(0.0, 0.0, 0.0)) -> Tensor:
    """Exact line integrals (K, V, U) of a ball of water, in mm."""
    ray = beam.pixels() - beam.sources[:, None, None]
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    way = centre - beam.sources
    along = (ray * way[:, None, None]).sum(-1)
    apart = (way**2).sum(-1)[:, None, None] - along**2
    return torch.as_tensor(2 * MU_WATER * np.sqrt(np.clip(radius**2 - apart, 0, None)))


def block(grid: Grid = Grid.cube(16)) -> Tensor:
    """Soft tissue with a hollow, in air: (1, 1, X, Y, Z) in the range [-1, 1] of WINDOW."""
    hu = torch.full((1, 1, *grid.shape), -1000.0)
    hu[:, :, 3:13, 4:12, 2:14] = 40
    hu[:, :, 5:8, 6:10, 5:11] = -800
    return WINDOW.to_range(hu)
