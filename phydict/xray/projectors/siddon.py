"""Exact cone-beam projection of piecewise-constant voxels for any pose, compiled for the CPU, with its exact adjoint.

Siddon 1985, Med Phys 12:252 (doi:10.1118/1.595715). Outside the grid mu is 0. phydict.xray.projectors.tracer walks the
rays.
"""

from __future__ import annotations

import numpy as np

from phydict.xray.projectors.compiled import compiled
from phydict.xray.projectors.tracer import Tracer, aim, clip, nearest


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
                    total += (until - t) * volume[voxel[0], voxel[1], voxel[2]]
                    t = until
                voxel[a] += sign[a]
                if cross[a] >= last or voxel[a] < low[a] or voxel[a] >= high[a]:
                    break
                cross[a] += delta[a]
            image[r, c] = total * lengths[r, c]


@compiled()
def _backproject(volume, images, rays, lengths, bottom, top):
    low, high = (0, 0, bottom), (volume.shape[0], volume.shape[1], top)
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
                        volume[voxel[0], voxel[1], voxel[2]] += (until - t) * value
                        t = until
                    voxel[a] += sign[a]
                    if cross[a] >= last or voxel[a] < low[a] or voxel[a] >= high[a]:
                        break
                    cross[a] += delta[a]


class Siddon(Tracer):
    """Line integrals of boxes of constant mu; shapes, types and threads as phydict.xray.projectors.tracer.Tracer
    says."""

    reach = 0
    project, backproject = staticmethod(_project), staticmethod(_backproject)
