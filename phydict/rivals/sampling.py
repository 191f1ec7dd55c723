"""Features of X-rays read where each voxel projects."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from phydict.grid import Grid
from phydict.xray import ConeBeam
from phydict.xray.places import detector_places

HIDDEN = -1e4
"""What the maximum over views starts from, below any feature."""


def all_places(grid: Grid, beam: ConeBeam, like: Tensor) -> Tensor:
    """Column and row (K, X, Y, Z, 2) of each voxel's projections, -1 and 1 at the detector's edges."""
    return torch.stack([detector_places(grid, beam, k, like)[1] for k in range(beam.views)])


def seen(places: Tensor) -> Tensor:
    """Which views see which voxels (K, X, Y, Z), as 0 and 1."""
    return (places.abs() <= 1).all(-1).to(places)


def pooled(features: Tensor, places: Tensor, pixels: tuple[int, int], scale: int = 1) -> tuple[Tensor, Tensor]:
    """Mean and maximum (B, C, X, Y, Z), over the views that see a voxel, of features (B, K, C, V', U') at its
    projections; 0 where no view does. The order of the views does not matter.

    places: (K, X, Y, Z, 2). pixels: the detector's (V, U). scale: its pixels along a pixel of the features, of which
    the last may reach beyond the detector.
    """
    rows, columns = (size / (scale * there) for size, there in zip(pixels, features.shape[-2:]))
    share, views = torch.tensor([columns, rows]).to(places), seen(places)
    shape = len(features), features.shape[2], *places.shape[1:4]
    total, largest = places.new_zeros(shape), places.new_full(shape, HIDDEN)
    for k, (place, there) in enumerate(zip(places, views)):
        at = ((place + 1) * share - 1).flatten(0, 1)[None].expand(len(features), -1, -1, -1)
        read = grid_sample(features[:, k].to(places), at, padding_mode="border", align_corners=False)
        read = read.unflatten(2, place.shape[:2])
        total = total + there * read
        largest = torch.where(there > 0, read, HIDDEN).maximum(largest)
    count = views.sum(0)
    return total / count.clamp(min=1), torch.where(count > 0, largest, 0.0)
