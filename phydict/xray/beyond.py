"""Whether a patient continues above and below a volume, as the X-rays themselves show."""

from __future__ import annotations

from dataclasses import replace

from torch import Tensor

from phydict.grid import Grid
from phydict.linalg.conjugate_gradients import conjugate_gradients
from phydict.xray.boxes import binned_to, in_other_voxels
from phydict.xray.geometry import ConeBeam

SIDE, ITERATIONS, CLEARLY = 32, 10, 1.1
"""Voxels per side and steps of conjugate gradients that tell the two apart, and how many times as much of the X-rays
must be left without `continued` as with it. Of five CTs, from one to sixteen views, it is 0.4 to 0.95 times where the
CT ends in air, and 1.2 to 30 times where its last slices are repeated, at one end or both. Nearer to 1 it only comes in
geometries whose rays hardly leave the volume, for which either does."""

TALLER, MORE_CLEARLY = 0.125, 1.5
"""The share of its height by which a volume is taller at both ends that is to explain the X-rays of a patient who ends
there, and how many times as much of them the volume alone must leave. Of four CTs it is 0.99 to 1.1 times where they
end in it, of flipped views, display values and coarse phantoms 1.47 at most; where they are moved up or down by 96 mm
1.6 to 28, but for one that then reaches little beyond: from 1.1 on."""

LOW = 0.01
"""The share of a display image's pixels at or below what stands for air."""


def with_continuation(xrays: Tensor, beam: ConeBeam, grid: Grid, display: bool) -> ConeBeam:
    """The beam, `continued`, where it is None, as the X-rays (K, V, U) of a patient in the box of `grid` show it: true
    where a volume whose last slices are repeated beyond it clearly explains them better. Of voxels that are not stacked
    upwards nothing is repeated.

    display: whether the X-rays are values whose gain and offset per view are unknown.
    """
    if beam.continued is not None:
        return beam
    if not grid.is_upright:
        return replace(beam, continued=False)
    xrays, coarse = _levelled(xrays) if display else xrays, coarsened(grid)
    alone, repeated = (unexplained(xrays, replace(beam, continued=answer), coarse) for answer in (False, True))
    return replace(beam, continued=CLEARLY * repeated < alone)


def needs_taller(xrays: Tensor, beam: ConeBeam, grid: Grid, display: bool) -> bool:
    """Whether a taller volume, if source and detectors leave room for it, clearly explains the X-rays better, of a
    patient who ends in it. Arguments as those of `with_continuation`."""
    coarse, beam = coarsened(grid), replace(beam, continued=False)
    taller = coarse.grown(0, 0, round(TALLER * coarse.shape[2]))
    if not (grid.is_upright and beam.has_room_for(taller)):
        return False
    xrays = _levelled(xrays) if display else xrays
    return MORE_CLEARLY * unexplained(xrays, beam, taller) < unexplained(xrays, beam, coarse)


def coarsened(grid: Grid) -> Grid:
    """The same box in at most SIDE voxels along each side."""
    return in_other_voxels(grid, [min(n, SIDE) for n in grid.shape])


def unexplained(xrays: Tensor, beam: ConeBeam, grid: Grid) -> float:
    """The norm of what ITERATIONS steps leave of the X-rays."""
    y, A = binned_to(grid, xrays, beam, False)
    x = conjugate_gradients(lambda mu: A.T(A(mu)), A.T(y[None]), ITERATIONS)
    return float((y - A(x)[0]).norm())


def _levelled(display: Tensor) -> Tensor:
    """Display values (K, V, U), those of air near 0 and every view's mean 1."""
    views = display.float().flatten(1)
    low = views.kthvalue(max(1, int(LOW * views.shape[1]))).values
    level = (views.mean(1) - low).clamp(min=1e-12)
    return (display - low[:, None, None]) / level[:, None, None]
