"""The projector of the paper to the letter, for any pose, compiled for the CPU, with its exact adjoint.

PhyDiCT (Dai, Ghosh, Batmanghelich, MICCAI 2026), Eq. 4: with the ray s + lambda (p - s) from source to pixel,

    P(x)[p] = |p - s| sum over m of x(s + (lambda_m + lambda_m+1) / 2 (p - s)) (lambda_m+1 - lambda_m).

The lambda_m are the ray's sorted crossings with the voxel planes: the N + 1 planes per axis that separate N voxels,
at half-integer indices, the two outer faces of the grid among them. So the sum runs over the ray's stretches in each
voxel, from where it enters the grid's outer faces to where it leaves them. x is trilinear between voxel centres with
0 outside the grid: from the outermost centres it falls linearly, to half the voxel's value at the outer face, where
the sum ends. (A volume padded by one voxel of zeros has its sum end where x is 0.)
"""

from __future__ import annotations

import numpy as np

from phydict.xray.projectors.compiled import compiled
from phydict.xray.projectors.tracer import Tracer, aim, clip, nearest


@compiled()
def _sample(volume, x, y, z):
    """The trilinear value at fractional voxel indices."""
    nx, ny, nz = volume.shape
    i, j, k = int(np.floor(x)), int(np.floor(y)), int(np.floor(z))
    fx, fy, fz = x - i, y - j, z - k
    total = 0.0
    for di in range(2):
        if 0 <= i + di < nx:
            wx = fx if di else 1 - fx
            for dj in range(2):
                if 0 <= j + dj < ny:
                    w = wx * (fy if dj else 1 - fy)
                    if k >= 0:
                        total += w * (1 - fz) * volume[i + di, j + dj, k]
                    if k + 1 < nz:
                        total += w * fz * volume[i + di, j + dj, k + 1]
    return total


@compiled()
def _spread(volume, x, y, z, value, bottom, top):
    """Add the adjoint of `_sample` to the slices bottom <= k < top."""
    nx, ny = volume.shape[:2]
    i, j, k = int(np.floor(x)), int(np.floor(y)), int(np.floor(z))
    fx, fy, fz = x - i, y - j, z - k
    for di in range(2):
        if 0 <= i + di < nx:
            wx = value * (fx if di else 1 - fx)
            for dj in range(2):
                if 0 <= j + dj < ny:
                    w = wx * (fy if dj else 1 - fy)
                    if bottom <= k < top:
                        volume[i + di, j + dj, k] += w * (1 - fz)
                    if bottom <= k + 1 < top:
                        volume[i + di, j + dj, k + 1] += w * fz


@compiled()
def _project(volume, image, ray, lengths, low, high):
    start, step = ray[0], np.empty(3)
    voxel, sign = np.empty(3, np.int64), np.empty(3, np.int64)
    cross, delta = np.empty(3), np.empty(3)
    for r in range(image.shape[0]):
        for c in range(image.shape[1]):
            aim(ray, r, c, step)
            t, last = clip(start, step, low, high, voxel, sign, cross, delta)
            total = 0.0
            while t < last:
                a = nearest(cross)
                until = min(cross[a], last)
                if until > t:
                    m = (t + until) / 2
                    total += (until - t) * _sample(volume, start[0] + m * step[0], start[1] + m * step[1],
                                                   start[2] + m * step[2])
                    t = until
                cross[a] += delta[a]
            image[r, c] = total * lengths[r, c]


@compiled()
def _backproject(volume, images, rays, lengths, bottom, top):
    nx, ny, nz = volume.shape
    low, high = (0, 0, max(bottom - 1, 0)), (nx, ny, min(top + 1, nz))  # samples there reach into the slab
    step = np.empty(3)
    voxel, sign = np.empty(3, np.int64), np.empty(3, np.int64)
    cross, delta = np.empty(3), np.empty(3)
    for k in range(images.shape[0]):
        start = rays[k, 0]
        for r in range(images.shape[1]):
            for c in range(images.shape[2]):
                aim(rays[k], r, c, step)
                t, last = clip(start, step, low, high, voxel, sign, cross, delta)
                value = images[k, r, c] * lengths[k, r, c]
                while t < last:
                    a = nearest(cross)
                    until = min(cross[a], last)
                    if until > t:
                        m = (t + until) / 2
                        _spread(volume, start[0] + m * step[0], start[1] + m * step[1], start[2] + m * step[2],
                                (until - t) * value, bottom, top)
                        t = until
                    cross[a] += delta[a]


class Eq4(Tracer):
    """Eq. 4 of the paper; shapes, types and threads as phydict.xray.projectors.tracer.Tracer says."""

    reach = 1
    project, backproject = staticmethod(_project), staticmethod(_backproject)
