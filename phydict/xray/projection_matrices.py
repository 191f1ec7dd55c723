"""Projection matrices of C-arms and computer vision as a ConeBeam."""

from __future__ import annotations

import numpy as np

from phydict.xray.geometry import ConeBeam
from phydict.xray.stated import MOST_MM, pixel_sizes

LEAST_VOLUME = 1e-12
"""Of the left 3x3 part of a matrix, relative to the product of its rows' lengths: below, it has no source."""
SQUARE = 1e-4
"""Cosine of the angle between rows and columns up to which they are perpendicular."""
MOST_ASPECT = 10
"""No pixel is so many times as long as it is wide."""
ALIKE = 0.01
"""Share by which a pixel's height over its width may differ from what the matrix says."""


def beam_of_matrices(matrices: np.ndarray, shape: tuple[int, int], pixel: float | tuple[float, float]) -> ConeBeam:
    """The beam of matrices (K, 3, 4) that take world mm (x, y, z, 1) to multiples of (column, row, 1), where pixel (0,
    0) is centred on (0, 0) and a matrix may have any factor (Hartley & Zisserman, Multiple View Geometry, 2003, 6.2).

    shape: (V, U) pixels and pixel: (row height, column width) in mm, which the matrices do not hold.
    Raises ValueError, with the view, for matrices without a source, whose source lies level with the world's origin, or
    whose pixels have another height over width.
    """
    height, width = pixel_sizes(pixel)
    poses = [_pose(view, matrix, height, width, shape) for view, matrix in enumerate(matrices)]
    sources, detectors, u, v = (np.stack(part) for part in zip(*poses))
    return ConeBeam(sources, detectors, u, v, shape)


def are_matrices(numbers: np.ndarray) -> bool:
    """Whether rows of 12 numbers (K, 12) are projection matrices, by all of which pixels are rectangles, and not
    source, detector's centre, u and v."""
    left = numbers.reshape(-1, 3, 4)[:, :, :3]
    if not (abs(numbers) < MOST_MM).all() or not (
            abs(np.linalg.det(left)) > LEAST_VOLUME * np.linalg.norm(left, axis=2).prod(1)).all():
        return False
    rays = np.linalg.inv(left)
    return _are_rectangles(rays[:, :, 0], rays[:, :, 1]) and not _are_rectangles(numbers[:, 6:9], numbers[:, 9:])


def _are_rectangles(u: np.ndarray, v: np.ndarray) -> bool:
    """Whether each u (K, 3) is perpendicular to its v and less than MOST_ASPECT times as long, and v as u."""
    width, height = (np.linalg.norm(side, axis=1) for side in (u, v))
    sides = np.maximum(width, height) < MOST_ASPECT * np.minimum(width, height)
    return bool((sides & (abs((u * v).sum(1)) < SQUARE * width * height)).all())


def _pose(view: int, matrix: np.ndarray, height: float, width: float, shape: tuple[int, int]) -> tuple[np.ndarray, ...]:
    """Source, detector's centre, u and v of one matrix."""
    depth = matrix[2, 3]  # of the world's origin, which lies in front of the source
    scale = np.linalg.norm(matrix[:, :3], axis=1).prod()
    if not abs(np.linalg.det(matrix[:, :3])) > LEAST_VOLUME * scale or depth == 0:
        raise ValueError(f"view {view}: the projection matrix {matrix.tolist()} has no source in front of which the "
                         "world's origin lies; give one from world mm to (column, row, 1)")
    rays = np.linalg.inv(np.sign(depth) * matrix[:, :3])  # of pixel (c, r): rays @ (c, r, 1)
    rays *= width / np.linalg.norm(rays[:, 0])
    high = float(np.linalg.norm(rays[:, 1]))
    if abs(high / height - 1) > ALIKE:
        raise ValueError(f"view {view}: by its projection matrix pixels of {width:g} mm width are {high:.4g} mm high, "
                         f"but a pixel of [{height:g}, {width:g}] mm was given")
    source = -np.linalg.solve(matrix[:, :3], matrix[:, 3])
    centre = rays @ ((shape[1] - 1) / 2, (shape[0] - 1) / 2, 1.0)
    return source, source + centre, rays[:, 0], rays[:, 1]
