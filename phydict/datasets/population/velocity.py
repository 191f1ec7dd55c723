"""Stationary velocity fields in a box: their flows, the inverses of these, and Jacobians.

    exp(v)     the flow of v after unit time, by scaling and squaring (Arsigny et al. 2006, 10.1007/11866565_113)
    exp(-v)    its inverse

Fields are tensors (3, X, Y, Z) on voxels that fill the box; places and lengths are in half-widths of the box, along its
axes, so that the box is [-1, 1]^3 whatever its millimetres and voxels. Velocities beyond the box are those at its edge.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn import functional as F

STEPS = 7
"""Squarings: a flow is made of 2^STEPS small steps."""


def places(shape) -> Tensor:
    """Where the centres of `shape` voxels lie: (3, X, Y, Z) in [-1, 1]."""
    axes = [(torch.arange(n) + 0.5) * 2 / n - 1 for n in shape]
    return torch.stack(torch.meshgrid(*axes, indexing="ij"))


def sample(image: Tensor, points: Tensor, padding: str = "border") -> Tensor:
    """An image (C, X, Y, Z) at `points` (3, ...), by linear interpolation. padding: "border" or "zeros" beyond it."""
    return F.grid_sample(image[None], points.movedim(0, -1).flip(-1)[None], padding_mode=padding,
                         align_corners=False)[0]


def resize(image: Tensor, shape) -> Tensor:
    """An image (C, X, Y, Z) on other voxels of the same box: averaged onto fewer, interpolated onto more."""
    if any(new < old for new, old in zip(shape, image.shape[1:])):
        return F.adaptive_avg_pool3d(image, tuple(shape))
    return F.interpolate(image[None], tuple(shape), mode="trilinear", align_corners=False)[0]


def flow(velocity: Tensor) -> Tensor:
    """exp(v) - identity: the displacement (3, X, Y, Z) of each voxel's centre."""
    start, moved = places(velocity.shape[1:]), velocity / 2**STEPS
    for _ in range(STEPS):
        moved = moved + sample(moved, start + moved)
    return moved


def smooth(field: Tensor, width: float) -> Tensor:
    """A field averaged by a Gaussian of `width` voxels, as if its edge went on beyond the box."""
    reach = math.ceil(3 * width)
    kernel = torch.exp(-torch.arange(-reach, reach + 1) ** 2 / (2 * width**2))
    for axis in range(3):
        shape, pad = [1] * 5, [0] * 6
        shape[2 + axis], pad[4 - 2 * axis], pad[5 - 2 * axis] = len(kernel), reach, reach
        field = F.conv3d(F.pad(field[:, None], pad, mode="replicate"), (kernel / kernel.sum()).view(shape))[:, 0]
    return field


def jacobian(points: Tensor) -> Tensor:
    """Determinants (X - 1, Y - 1, Z - 1) of a map given by where it takes voxels' centres, `points` (3, X, Y, Z)."""
    shape = points.shape[1:]
    steps = [points.diff(dim=a + 1)[(slice(None), *(slice(0, m - 1) for m in shape))] * shape[a] / 2 for a in range(3)]
    return torch.linalg.det(torch.stack(steps, -1).permute(1, 2, 3, 0, 4))
