"""Cone-beam views as an orbit: a circle of sources about an axis, and the share that each view and ray has in it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from phydict.grid import Grid
from phydict.xray import ConeBeam

TOLERANCE = 0.01
"""How far, as a share of the source's distance from the axis, views may stand off the circle."""

ONE_PLACE = 1e-6
"""Angle in radians below which views are of one place."""

TAPER = math.radians(10)
"""Angle over which an open arc's ends share with the views that see the same lines from the other side."""


@dataclass(frozen=True, eq=False)
class CircularOrbit:
    """Views of upright detectors on a circle.

    axis (3,): unit vector along the detectors' columns. centre (3,): the point on it level with the sources. radius: mm
    from the axis to the sources. angles (K,): of the sources about the axis, in [0, 2 pi). turns (K,): 1 where angles
    grow along a detector's columns seen from the source, else -1.
    """

    beam: ConeBeam
    axis: np.ndarray
    centre: np.ndarray
    radius: float
    angles: np.ndarray
    turns: np.ndarray

    @staticmethod
    def of(beam: ConeBeam, grid: Grid) -> CircularOrbit:
        """The orbit of a beam. Where the views leave the axis open, as one view does, it is the one nearest to the
        grid's centre, of opposed views the one half-way between their sources. Raises ValueError unless every detector
        is upright and faces one axis at one distance."""
        across, axis = beam.u / np.linalg.norm(beam.u, axis=1, keepdims=True), beam.v[0] / np.linalg.norm(beam.v[0])
        upright = abs(np.cross(beam.v, axis)).max(1) / np.linalg.norm(beam.v, axis=1)
        _demand(upright < 1e-3, "has a detector whose columns are tilted against those of view 0")
        off = (across * (beam.sources - grid.centre)).sum(1)
        centre = grid.centre + np.linalg.lstsq(across, off, rcond=1e-6)[0]
        arm = beam.sources - centre
        if np.linalg.matrix_rank(across, 1e-6) == 1:
            inward = np.cross(axis, across[0])
            depth = arm @ inward
            if depth.min() < 0 < depth.max():
                centre = centre + (depth.min() + depth.max()) / 2 * inward
                arm = beam.sources - centre
        height, arm = arm @ axis, arm - (arm @ axis)[:, None] * axis
        distance = np.linalg.norm(arm, axis=1)
        radius = float(distance.mean())
        _demand(abs((across * arm).sum(1)) < TOLERANCE * radius, "faces no axis that the other views face too")
        _demand(abs(distance - radius) < TOLERANCE * radius, "has its source at another distance from the axis")
        _demand(abs(height - height.mean()) < TOLERANCE * radius, "has its source at another height")
        first = arm[0] / distance[0]
        angles = np.arctan2(arm @ np.cross(axis, first), arm @ first) % (2 * math.pi)
        turns = np.sign((np.cross(axis, beam.normals) * across).sum(1))
        return CircularOrbit(beam, axis, centre + height.mean() * axis, radius, angles, turns)

    def shares(self) -> np.ndarray:
        """The angle (K,) in radians that each view stands for: half the way to both neighbours, and at the ends of an
        open arc half a typical step outwards. Views of one place share alike, and half a turn if all are there."""
        gaps, step, order, arc = self._steps()
        if arc < 1e-6:
            return np.full(len(gaps), math.pi / len(gaps))
        if arc < 2 * math.pi:
            gaps[-1] = step
        shares = np.empty(len(gaps))
        shares[order] = (gaps + np.roll(gaps, 1)) / 2
        beside = np.cos(self.angles[:, None] - self.angles) > math.cos(ONE_PLACE)
        return beside @ shares / beside.sum(1)

    def redundancy(self, tangents: np.ndarray) -> np.ndarray:
        """Weights (K, U) of rays that leave their view's central plane at `tangents` (K, U), counted along u.

        A line that is seen from both sides counts once in all: w = c(b) / (c(b) + c(b')), with b' the angle from where
        the same line runs the other way; c is 1 on a full circle, which makes w one half, and on an open arc 1 inside
        it, falling to 0 over the TAPER at its ends, and 0 beyond them, so that lines seen once have w = 1: full,
        short and limited scans in one formula (Noo, Defrise, Clackdoyle & Kudo 2002, doi:10.1088/0031-9155/47/14/311).
        """
        _gaps, step, order, arc = self._steps()
        if arc >= 2 * math.pi:
            return np.full(tangents.shape, 0.5)
        start = self.angles[order[0]] - step / 2
        fan = self.turns[:, None] * np.arctan(tangents)
        weight, opposite = (self._inside(angle - start, arc) for angle in (
            self.angles[:, None], self.angles[:, None] + math.pi + 2 * fan))
        weight = weight.clip(1e-6)  # a view at the very end of the arc
        return weight / (weight + opposite)

    @staticmethod
    def _inside(way: np.ndarray, arc: float) -> np.ndarray:
        way = way % (2 * math.pi)
        depth = np.minimum(way, arc - way) / TAPER
        return np.where(depth >= 0, np.sin(math.pi / 2 * depth.clip(0, 1)) ** 2, 0)

    def _steps(self) -> tuple[np.ndarray, float, np.ndarray, float]:
        """Gaps (K,) in rad from each view to the next, in the order of angles, the largest last; the typical gap; that
        order; and the arc that the views stand for, which is open where the largest gap exceeds 1.5 typical ones."""
        order = np.argsort(self.angles, kind="stable")
        gaps = np.diff(self.angles[order], append=self.angles[order[0]] + 2 * math.pi)
        last = int(gaps.argmax())
        order, gaps = np.roll(order, -last - 1), np.roll(gaps, -last - 1)
        step = _typical(gaps[:-1])
        arc = 2 * math.pi if gaps[-1] <= 1.5 * step else 2 * math.pi - gaps[-1] + step
        return gaps, step, order, arc


def _typical(gaps: np.ndarray) -> float:
    """A typical gap of gaps (N,), which views that repeat or come in pairs hardly change; 0 if no gap is above 0.

    It is the median of the gaps longer than m / 2, where gaps up to m make up half of the arc.
    """
    ordered = np.sort(gaps)
    filled = ordered.cumsum()
    if not len(gaps) or filled[-1] <= 0:
        return 0.0
    return float(np.median(gaps[gaps > ordered[np.searchsorted(filled, filled[-1] / 2)] / 2]))


def _demand(holds: np.ndarray, what: str) -> None:
    if not holds.all():
        raise ValueError(f"FDK needs upright detectors on one circle, each facing its axis, but view "
                         f"{int((~holds).argmax())} {what}: use sirt, cgls or tv, which take any views")
