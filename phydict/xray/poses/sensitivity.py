"""What a move of its ends changes in a ray's line integral: a trilinear ray sampler with exact derivatives.

A ray from the source s to its pixel p is sampled at s + t (p - s), at the same t whatever the pose:

    L = |p - s| dt * sum over t of mu(s + t (p - s))
    dL/ds = -(p - s) / |p - s|^2 L + |p - s| dt * sum over t of (1 - t) grad mu,    dL/dp likewise with t

mu is trilinear between voxel centres and falls to 0 one voxel beyond the outermost ones. Where a beam is continued, its
last slices are repeated above and below as far as rays meet them.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from phydict.grid import Grid
from phydict.xray.geometry import ConeBeam
from phydict.xray.poses.unknowns import derivative, moved
from phydict.xray.projectors.compiled import compiled
from phydict.xray.projectors.continued import reach_beyond
from phydict.xray.projectors.tracer import aim, ray_lengths, rays_in_voxels, run

PACE = 1.0
"""Voxels from sample to sample, at most, along the longest way of a view."""


def pose_derivatives(mu: Tensor, grid: Grid, beam: ConeBeam, values: np.ndarray) -> tuple[Tensor, Tensor]:
    """Line integrals (K, V, U) of mu (X, Y, Z) in 1/mm through `moved(beam, values)`, and their derivatives
    (K, 8, V, U) per mm and degree with respect to `values` (K, 8).

    In the type of mu, float32 or float64; on the CPU.
    """
    there = moved(beam, values)
    slices = reach_beyond(there, grid) if beam.continued else 0
    grid = grid.grown(0, 0, slices)
    volume = np.pad(np.pad(mu.detach().numpy(), ((0, 0), (0, 0), (slices, slices)), "edge"), 1)
    images = np.zeros((beam.views, *beam.shape), volume.dtype)
    ends = np.zeros((beam.views, *beam.shape, 2, 3), volume.dtype)
    rays = rays_in_voxels(grid, beam)  # the nominal beam's: the samples stay where they are in t
    longest = np.abs(rays[:, 1] - rays[:, 0]).max(1) + np.abs(rays[:, 2]).max(1) * beam.shape[1] + np.abs(
        rays[:, 3]).max(1) * beam.shape[0]
    counts = np.ceil(longest / PACE).astype(np.int64)
    run([(_integrate, volume, image, end, ray, count)
         for image, end, ray, count in zip(images, ends, rays_in_voxels(grid, there), counts)])
    lengths = torch.as_tensor(ray_lengths(there)).to(mu)
    ray = torch.as_tensor(there.pixels() - there.sources[:, None, None]).to(mu)
    integrals = lengths * torch.as_tensor(images)
    gradients = torch.as_tensor(ends) @ torch.as_tensor(np.linalg.inv(grid.affine[:3, :3])).to(mu)
    gradients = gradients * lengths[..., None, None]
    stretch = ray * (integrals / lengths**2)[..., None]
    gradients = gradients + torch.stack([-stretch, stretch], -2)  # (K, V, U, 2, 3)
    change = derivative(beam, values).to(mu)
    rows, columns = (torch.arange(n).to(mu) - (n - 1) / 2 for n in beam.shape)
    pixel = gradients[..., 1, :]
    derivatives = torch.einsum("kvua,kam->kmvu", gradients[..., 0, :], change[:, 0])
    derivatives += torch.einsum("kvua,kam->kmvu", pixel, change[:, 1])
    derivatives += torch.einsum("kvua,u,kam->kmvu", pixel, columns, change[:, 2])
    derivatives += torch.einsum("kvua,v,kam->kmvu", pixel, rows, change[:, 3])
    return integrals, derivatives


@compiled()
def _integrate(volume, image, ends, ray, count):
    """Fills image (V, U) with the mean over a ray, of `count` samples, of a volume with a margin of one empty voxel,
    and ends (V, U, 2, 3) with what moves of its source and its pixel by a voxel add to that."""
    way, index, part, gradient = np.empty(3), np.empty(3, np.int64), np.empty(3), np.empty(3)
    for r in range(image.shape[0]):
        for c in range(image.shape[1]):
            aim(ray, r, c, way)
            near, far = 0.0, 1.0
            for a in range(3):
                low, high = -1 - ray[0, a], volume.shape[a] - 2 - ray[0, a]
                if abs(way[a]) > 1e-12:
                    near, far = max(near, min(low / way[a], high / way[a])), min(far, max(low / way[a], high / way[a]))
                elif low >= 0 or high <= 0:
                    far = 0.0
            for n in range(max(0, int(near * count - 0.5)), min(count, int(far * count + 1.5))):
                t, inside = (n + 0.5) / count, True
                for a in range(3):
                    place = ray[0, a] + t * way[a] + 1
                    inside = inside and 0 < place < volume.shape[a] - 1
                    index[a] = int(place)
                    part[a] = place - index[a]
                if inside:
                    value = _sample(volume, index, part, gradient)
                    image[r, c] += value / count
                    for a in range(3):
                        ends[r, c, 0, a] += (1 - t) * gradient[a] / count
                        ends[r, c, 1, a] += t * gradient[a] / count


@compiled()
def _sample(volume, index, part, gradient):
    """The trilinear value at index + part; fills its gradient (3,) per voxel."""
    i, j, k = index
    x, y, z = part
    a, b, c, d = volume[i, j, k], volume[i, j, k + 1], volume[i, j + 1, k], volume[i, j + 1, k + 1]
    e, f, g, h = (volume[i + 1, j, k], volume[i + 1, j, k + 1], volume[i + 1, j + 1, k], volume[i + 1, j + 1, k + 1])
    near_low, near_high, far_low, far_high = a + z * (b - a), c + z * (d - c), e + z * (f - e), g + z * (h - g)
    near, far = near_low + y * (near_high - near_low), far_low + y * (far_high - far_low)
    gradient[0] = far - near
    gradient[1] = (1 - x) * (near_high - near_low) + x * (far_high - far_low)
    gradient[2] = (1 - x) * ((1 - y) * (b - a) + y * (d - c)) + x * ((1 - y) * (f - e) + y * (h - g))
    return near + x * (far - near)
