"""The whole scene moved: what no X-ray shows.

A rotation and a shift of all views together with the volume change no line integral: six numbers of all views' poses
cannot be found from X-rays, and are chosen.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from phydict.xray.geometry import ConeBeam

STEPS = 20
"""Of reweighted least squares, each of which halves what is left or better."""


STEP = 1e-4
"""mm and degrees of the differences that stand for derivatives."""


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
