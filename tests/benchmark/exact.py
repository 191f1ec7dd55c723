"""Float64 references for projectors: analytic scenes, and the exact line integrals of a volume model, in plain NumPy.

A volume model says what lies between the voxel centres: "voxels" is piecewise constant, "trilinear" interpolates and
falls to zero one voxel outside the outermost centres. Along a ray the one is constant and the other cubic between its
crossings with the model's planes, so that a midpoint and two Gauss points per stretch integrate them exactly. "eq4" is
the paper's rule: planes between the voxels, the trilinear value at the midpoints.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates

from phydict.xray import ConeBeam, Grid

ELLIPSOIDS = (  # centre and semi-axes in mm, attenuation in 1/mm that it adds
    ((0, 0, 0), (112, 81, 106), 0.020), ((50, 0, 12), (40, 56, 80), -0.016), ((-50, 0, 12), (37, 56, 76), -0.016),
    ((0, -56, 0), (15, 15, 95), 0.012), ((20, 30, -30), (22, 18, 25), 0.016), ((-45, 20, 30), (6, 6, 6), 0.014))
"""A trunk with lungs, spine, heart and a nodule, inside a cube of 250 mm."""

BLOBS = (((10, -20, 15), 18.0, 0.020), ((-45, 30, -40), 14.0, 0.015), ((50, 40, 30), 12.0, 0.025))
"""Centre in mm, standard deviation in mm, peak in 1/mm."""


def ellipsoids(grid: Grid, parts: int = 4) -> np.ndarray:
    """Attenuation (X, Y, Z) of ELLIPSOIDS, each voxel the mean over parts^3 points in it."""
    fine = Grid(tuple(parts * n for n in grid.shape), tuple(s / parts for s in grid.spacing))
    x, y, z = _axes(fine)
    mu = np.zeros(grid.shape)
    for i in range(grid.shape[0]):  # a slab at a time, so that the fine volume is never held
        slab = x[parts * i:parts * (i + 1)]
        for centre, axes, value in ELLIPSOIDS:
            at = [((w - c) / a) ** 2 for w, c, a in zip((slab, y, z), centre, axes)]
            inside = at[0][:, None, None] + at[1][:, None] + at[2] < 1
            mu[i] += value * inside.reshape(parts, grid.shape[1], parts, grid.shape[2], parts).mean((0, 2, 4))
    return mu


def ellipsoid_integrals(beam: ConeBeam) -> np.ndarray:
    """Line integrals (K, V, U) of ELLIPSOIDS: twice the root of the quadratic along each ray, times its length."""
    source, ray = beam.sources[:, None, None], beam.pixels() - beam.sources[:, None, None]
    total = np.zeros(ray.shape[:-1])
    for centre, axes, value in ELLIPSOIDS:
        start, step = (source - centre) / np.array(axes), ray / np.array(axes)
        a, b, c = (step**2).sum(-1), (start * step).sum(-1), (start**2).sum(-1) - 1
        total += value * 2 * np.sqrt(np.clip(b**2 - a * c, 0, None)) / a
    return total * np.linalg.norm(ray, axis=-1)


def blobs(grid: Grid) -> np.ndarray:
    """Attenuation (X, Y, Z) of BLOBS at the voxel centres."""
    x, y, z = _axes(grid)
    return sum(peak * np.exp(-((x[:, None, None] - c[0]) ** 2 + (y[:, None] - c[1]) ** 2 + (z - c[2]) ** 2)
                             / (2 * width**2)) for c, width, peak in BLOBS)


def blob_integrals(beam: ConeBeam) -> np.ndarray:
    """Line integrals (K, V, U) of BLOBS: a Gaussian of each ray's distance from the centre."""
    source, ray = beam.sources[:, None, None], beam.pixels() - beam.sources[:, None, None]
    ray = ray / np.linalg.norm(ray, axis=-1, keepdims=True)
    away = [np.linalg.norm(np.cross(c - source, ray), axis=-1) for c, _, _ in BLOBS]
    return sum(peak * width * np.sqrt(2 * np.pi) * np.exp(-d**2 / (2 * width**2))
               for d, (_, width, peak) in zip(away, BLOBS))


def body(grid: Grid) -> np.ndarray:
    """The ellipsoids with a texture as fine as the voxels: a volume (X, Y, Z) that interpolation does not find easy."""
    texture = gaussian_filter(np.random.default_rng(0).normal(size=grid.shape), 1.0)
    return np.clip(ellipsoids(grid, 2) * (1 + texture), 0, None)


def integrals(mu: np.ndarray, grid: Grid, beam: ConeBeam, model: str, stride: int = 1) -> np.ndarray:
    """Line integrals (K, V/stride, U/stride), rounded up, of `mu` (X, Y, Z) under a model, on every stride-th pixel."""
    ends = beam.pixels()[:, ::stride, ::stride]
    start = grid.index(np.broadcast_to(beam.sources[:, None, None], ends.shape)).reshape(-1, 3)
    step = grid.index(ends).reshape(-1, 3) - start
    first, last = ((0, 0) if model == "trilinear" else (0.5, -0.5))
    crossings = []
    for axis, n in enumerate(grid.shape):
        planes = np.arange(-1 + first, n + 1 + last)  # from where the model is zero on to where it is again
        with np.errstate(divide="ignore", invalid="ignore"):
            crossings.append((planes - start[:, axis, None]) / step[:, axis, None])
    with np.errstate(invalid="ignore"):
        low = np.max([np.minimum(c[:, 0], c[:, -1]) for c in crossings], axis=0)[:, None]
        high = np.min([np.maximum(c[:, 0], c[:, -1]) for c in crossings], axis=0)[:, None]
    t = np.sort(np.clip(np.nan_to_num(np.concatenate(crossings, 1), nan=0.0), low, np.maximum(high, low)), axis=1)
    middle, half = (t[:, 1:] + t[:, :-1]) / 2, (t[:, 1:] - t[:, :-1]) / 2
    nodes = (-1 / np.sqrt(3), 1 / np.sqrt(3)) if model == "trilinear" else (0.0,)
    total = np.zeros(len(start))
    for node in nodes:
        at = start[:, None] + (middle + node * half)[..., None] * step[:, None]
        values = map_coordinates(mu, np.moveaxis(at, -1, 0), order=0 if model == "voxels" else 1,
                                 mode="constant" if model == "voxels" else "grid-constant")
        total += (2 / len(nodes) * half * values).sum(1)
    lengths = np.linalg.norm(ends - beam.sources[:, None, None], axis=-1)
    return total.reshape(lengths.shape) * lengths


def _axes(grid: Grid) -> list[np.ndarray]:
    """World x, y and z in mm of a world-aligned grid's voxel centres."""
    return [origin + s * np.arange(n) for origin, s, n in zip(grid.affine[:3, 3], grid.spacing, grid.shape)]
