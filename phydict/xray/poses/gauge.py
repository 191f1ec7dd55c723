"""What no X-ray shows: the whole scene moved, and how far along its rays a detector stands.

A rotation and a shift of all views together with the volume change no line integral: six numbers of all views' poses
cannot be found from X-rays, and are chosen. Behind the volume, a detector drawn back along its rays measures the same.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from phydict.grid import Grid
from phydict.xray.geometry import ConeBeam

STEPS = 20
"""Of reweighted least squares, each of which halves what is left or better."""

STEP = 1e-4
"""mm and degrees of the differences that stand for derivatives."""

ROOM_MM = 1.0
"""Between a box and a detector drawn back behind it."""


def moved_as_a_whole(beam: ConeBeam, motion: np.ndarray) -> ConeBeam:
    """The beam moved as a whole: turned about the origin by the vector motion[3:] in degrees, then shifted by
    motion[:3] in mm."""
    turn = Rotation.from_rotvec(np.radians(motion[3:])).as_matrix().T
    return beam.at(beam.sources @ turn + motion[:3], beam.detectors @ turn + motion[:3], beam.u @ turn, beam.v @ turn)


def reprojection_errors(beam: ConeBeam, other: ConeBeam, points: np.ndarray) -> np.ndarray:
    """Root mean square distance (K,) in mm on the detector between points' shadows in two beams."""
    return np.sqrt(((beam.shadows(points) - other.shadows(points)) ** 2).sum(2).mean(1))


def aligned(beam: ConeBeam, to: ConeBeam, points: np.ndarray) -> ConeBeam:
    """The beam carried as a whole to where its shadows of `points` are most like those of another.

    The sum of the views' root mean square distances is least (reweighted least squares), so that a few views far off
    do not carry the others away.
    """
    for _ in range(STEPS):
        here, wanted = beam.shadows(points), to.shadows(points)
        jacobian = np.stack([(moved_as_a_whole(beam, STEP * unit).shadows(points) - here).ravel() / STEP
                             for unit in np.eye(6)], 1)
        apart = wanted - here
        weights = 1 / (np.sqrt((apart**2).sum(2).mean(1)) + 0.05)
        root = np.sqrt(np.broadcast_to(weights[:, None, None], apart.shape)).ravel()
        motion = np.linalg.lstsq(jacobian * root[:, None], apart.ravel() * root, rcond=1e-9)[0]
        beam = moved_as_a_whole(beam, motion)
        if np.abs(motion).max() < 1e-6:
            break
    return beam


def drawn_back(beam: ConeBeam, grid: Grid) -> ConeBeam:
    """The beam whose detectors that reach into a grid's box are drawn back along their rays to behind it, and whose
    pixels grow with that, so that no ray changes."""
    reach, distance = beam.depths(grid).max(0), beam.distances
    stretch = np.where(reach < distance, 1, (reach + ROOM_MM) / distance)[:, None]
    return beam.at(beam.sources, beam.detectors + (stretch - 1) * (beam.detectors - beam.sources), stretch * beam.u,
                   stretch * beam.v)


def obstructed(beam: ConeBeam, grid: Grid) -> np.ndarray:
    """The views (K,) whose source reaches into a grid's box, or whose detector lies before its middle, so that drawing
    it back does not help."""
    depth = beam.depths(grid)
    return (depth.min(0) <= 0) | (depth.mean(0) >= beam.distances)
