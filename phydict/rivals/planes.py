"""X-rays as images of the plane through the isocentre, and volumes turned from a view's frame into the grid's."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import affine_grid, embedding_bag, grid_sample

from phydict.grid import Grid, centred
from phydict.xray import ConeBeam
from phydict.xray.places import detector_places

UPRIGHT = 1e-6
"""Parts of a row's direction that may lie across the grid's last axis and be passed over."""


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
    """Maps from the grid to each view's frame, for `turned`: (K, 3, 4), or (K, 2, 2) of the axial slices
    where the rows of all views run straight down."""
    axes = (grid.affine[:3, :3] / grid.spacing)[:, ::-1]  # as affine_grid orders them: last index first
    theta = np.stack([np.concatenate([view_axes(beam, k) @ axes, np.zeros((3, 1))], 1) for k in range(beam.views)])
    if np.abs(theta[:, 1] - [-1, 0, 0, 0]).max() < UPRIGHT:
        theta = theta[:, ::2, 1:3]
    return torch.from_numpy(theta).to(like)


def on_planes(y: Tensor, places: Tensor) -> Tensor:
    """X-rays (B, K, V, U) as images (B, K, N, N) of the views' planes, 0 beyond the detectors."""
    images = grid_sample(y.transpose(0, 1).flatten(0, 1)[:, None], places.repeat_interleave(len(y), 0),
                         align_corners=False)
    return images[:, 0].unflatten(0, y.shape[1::-1]).transpose(0, 1)


def turned(volumes: Tensor, theta: Tensor) -> Tensor:
    """Volumes (B, K, C, depth, row, column), each in its view's frame, in the grid's: (B, K, C, X, Y, Z). Rays are
    taken as parallel; 0 where a voxel lies outside a view's cube."""
    if theta.shape[1] == 2:
        return torch.stack([_slices_turned(volumes[:, [k]], theta[[k]]) for k in range(len(theta))], 1)
    flat = volumes.flatten(0, 1).to(theta)
    turn = theta.double().repeat(len(volumes), 1, 1)  # autocast rounds single precision to bfloat16
    grid = affine_grid(turn, list(flat.shape), align_corners=False)
    return grid_sample(flat, grid.to(theta), align_corners=False).unflatten(0, volumes.shape[:2])


def turned_mean(volumes: Tensor, theta: Tensor) -> Tensor:
    """The mean of `turned` over the views (B, C, X, Y, Z)."""
    if theta.shape[1] == 2:
        return _slices_turned(volumes, theta) / len(theta)
    return turned(volumes, theta).mean(1)


def _slices_turned(volumes: Tensor, theta: Tensor) -> Tensor:
    """The sum of `turned` over upright views: slices are turned in their plane, all rows and channels at once, which
    takes a CPU a tenth of what sampling in three dimensions does."""
    cases, channels, size = len(volumes), *volumes.shape[2:4]
    places, shares = _corners(theta, size)
    table = volumes.permute(1, 3, 5, 0, 4, 2).to(theta).flatten(3).flatten(0, 2)
    made = embedding_bag(places, table, per_sample_weights=shares, mode="sum").view(size, size, cases, size, channels)
    return made.flip(3).permute(2, 4, 0, 1, 3)


def _corners(theta: Tensor, size: int) -> tuple[Tensor, Tensor]:
    """Around each (x, y) of the grid, the four (depth, column) of every view, as indices of a table (K, N, N), and
    their bilinear shares: (N^2, 4 K) each."""
    device = theta.device
    centres = (2 * torch.arange(size, device=device, dtype=torch.float64) + 1) / size - 1
    x, y = torch.meshgrid(centres, centres, indexing="ij")
    turn = theta.double().flip(1)[..., None, None]  # depth before column
    at = ((turn[:, :, 1] * x + turn[:, :, 0] * y + 1) * size - 1) / 2
    steps = torch.tensor([[0, 0], [0, 1], [1, 0], [1, 1]], device=device)[:, None, :, None, None]
    corners = at.floor() + steps  # (4, K, 2, N, N)
    shares = (1 - (at - corners).abs()).prod(2) * ((corners >= 0) & (corners < size)).all(2)
    depth, column = corners.long().clamp(0, size - 1).unbind(2)
    views = torch.arange(len(theta), device=device)[:, None, None]
    places = (views * size + depth) * size + column
    return places.flatten(0, 1).flatten(1).T, shares.to(theta).flatten(0, 1).flatten(1).T
