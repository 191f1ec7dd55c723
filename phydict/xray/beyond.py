"""Whether a patient goes on above and below a volume, as the X-rays themselves show."""

from __future__ import annotations

from dataclasses import replace

from torch import Tensor

from phydict.grid import Grid
from phydict.linalg.conjugate_gradients import conjugate_gradients
from phydict.xray.boxes import in_other_voxels, seen_by
from phydict.xray.geometry import ConeBeam

SIDE, ITERATIONS, CLEARLY = 32, 10, 1.1
"""Voxels per side and steps of conjugate gradients that tell the two apart, and how many times as much of the X-rays
must be left without `continued` as with it. Of five CTs, from one to sixteen views, it is 0.4 to 0.95 times where the
CT ends in air, and 1.2 to 30 times where its last slices are repeated, at one end or both. Nearer to 1 it only comes in
geometries whose rays hardly leave the volume, for which either does."""

TALLER = 0.125
"""The share of its height by which a volume is taller at both ends that is to explain the X-rays of a patient who ends
there. Of four CTs the volume alone leaves 0.99 to 1.1 times as much of them as the taller one where they end in it, 1.1
or more where they reach as far as 96 mm beyond it."""

LOW = 0.01
"""The share of a display image's pixels at or below what stands for air."""


def reaches_beyond(xrays: Tensor, beam: ConeBeam, grid: Grid, display: bool) -> bool:
    """Whether the patient in the box of `grid` is found above or below it too: as the beam says of `continued`, or else
    where a taller volume, or one whose last slices are repeated beyond it, clearly explains the X-rays (K, V, U)
    better. Other arguments as those of `asked`."""
    if beam.continued is not None:
        return beam.continued
    coarse = coarsened(grid)
    return _explains(xrays, beam, coarse, display, coarse, True) or _explains(
        xrays, beam, coarse, display, coarse.grown(0, 0, round(TALLER * coarse.shape[2])), False)


def asked(xrays: Tensor, beam: ConeBeam, grid: Grid, display: bool) -> ConeBeam:
    """The beam, `continued`, where it is None, as the X-rays (K, V, U) of a patient in the box of `grid` show it: true
    where a volume whose last slices are repeated beyond it clearly explains them better.

    display: whether the X-rays are values whose gain and offset per view are unknown.
    """
    if beam.continued is not None:
        return beam
    coarse = coarsened(grid)
    return replace(beam, continued=_explains(xrays, beam, coarse, display, coarse, True))


def _explains(xrays: Tensor, beam: ConeBeam, grid: Grid, display: bool, other: Grid, continued: bool) -> bool:
    """Whether the other grid, continued or not, clearly explains the X-rays better than the grid alone."""
    xrays = _levelled(xrays) if display else xrays
    return CLEARLY * unexplained(xrays, replace(beam, continued=continued), other) < unexplained(
        xrays, replace(beam, continued=False), grid)


def coarsened(grid: Grid) -> Grid:
    """The same box in at most SIDE voxels along each side."""
    return in_other_voxels(grid, [min(n, SIDE) for n in grid.shape])


def unexplained(xrays: Tensor, beam: ConeBeam, grid: Grid) -> float:
    """The norm of what ITERATIONS steps leave of the X-rays."""
    y, A = seen_by(grid, xrays.float(), beam, False)
    x = conjugate_gradients(lambda mu: A.T(A(mu)), A.T(y[None]), ITERATIONS)
    return float((y - A(x)[0]).norm())


def _levelled(display: Tensor) -> Tensor:
    """Display values (K, V, U), those of air near 0 and every view's mean 1."""
    views = display.float().flatten(1)
    low = views.kthvalue(max(1, int(LOW * views.shape[1]))).values
    level = (views.mean(1) - low).clamp(min=1e-12)
    return (display - low[:, None, None]) / level[:, None, None]
