"""X-rays as images of the plane through the isocentre, and volumes turned from a view's frame into the grid's."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import affine_grid, grid_sample

from phydict.grid import Grid, centred
from phydict.xray import ConeBeam
from phydict.xray.places import detector_places


def view_axes(beam: ConeBeam, view: int) -> np.ndarray:
    """Unit vectors (3, 3) of a view: along its columns, along its rows, from source to detector."""
    u, v = beam.u[view], beam.v[view]
    return np.stack([u / np.linalg.norm(u), v / np.linalg.norm(v), beam.normals[view]])


def plane_places(grid: Grid, beam: ConeBeam, like: Tensor) -> Tensor:
    """Where on the detectors the points (row, column) of each view's plane through the grid's centre are seen:
    (K, N, N, 2), as `detector_places` gives them; points a voxel apart, parallel to the detector, for a cubic grid."""
    n, step = grid.shape[0], grid.spacing[0]
    places = []
    for k in range(beam.views):
        column, row, depth = step * view_axes(beam, k)
        affine = centred(np.stack([row, column, depth], 1), (n, n, 1), grid.centre)
        places.append(detector_places(Grid((n, n, 1), affine=affine), beam, k, like)[1][:, :, 0])
    return torch.stack(places)


def turns(grid: Grid, beam: ConeBeam, like: Tensor) -> Tensor:
    """Maps (K, 3, 4) from the grid to each view's frame (depth, row, column), for `turned`."""
    axes = (grid.affine[:3, :3] / grid.spacing)[:, ::-1]  # as affine_grid orders them: last index first
    theta = [np.concatenate([view_axes(beam, k) @ axes, np.zeros((3, 1))], 1) for k in range(beam.views)]
    return torch.from_numpy(np.stack(theta)).to(like)


def on_planes(y: Tensor, places: Tensor) -> Tensor:
    """X-rays (B, K, V, U) as images (B, K, N, N) of the views' planes, 0 beyond the detectors."""
    images = grid_sample(y.transpose(0, 1).flatten(0, 1)[:, None], places.repeat_interleave(len(y), 0),
                         align_corners=False)
    return images[:, 0].unflatten(0, y.shape[1::-1]).transpose(0, 1)


def turned(volumes: Tensor, theta: Tensor) -> Tensor:
    """Volumes (B, K, C, depth, row, column), each in its view's frame, in the grid's: (B, K, C, X, Y, Z). Rays are
    taken as parallel; 0 where a voxel lies outside a view's cube."""
    flat = volumes.flatten(0, 1).to(theta)
    turn = theta.double().repeat(len(volumes), 1, 1)  # autocast rounds single precision to bfloat16
    grid = affine_grid(turn, list(flat.shape), align_corners=False)
    return grid_sample(flat, grid.to(theta), align_corners=False).unflatten(0, volumes.shape[:2])
