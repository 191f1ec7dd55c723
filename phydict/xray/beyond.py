"""Whether a patient goes on above and below a volume, as the X-rays themselves show."""

from __future__ import annotations

from dataclasses import replace

from torch import Tensor

from phydict.grid import Grid
from phydict.linalg.conjugate_gradients import conjugate_gradients
from phydict.runtime.warning import Remark, warn
from phydict.xray.boxes import in_other_voxels, seen_by
from phydict.xray.geometry import ConeBeam

SIDE, ITERATIONS, CLEARLY = 32, 10, 1.1
"""Voxels per side and steps of conjugate gradients that tell the two apart, and how many times as much of the X-rays
must be left without `continued` as with it. Of five CTs, from one to sixteen views, it is 0.4 to 0.95 times where the
CT ends in air, and 1.2 to 30 times where its last slices are repeated, at one end or both. Nearer to 1 it only comes in
geometries whose rays hardly leave the volume, for which either does."""

LOW = 0.01
"""The share of a display image's pixels at or below what stands for air."""


def asked(xrays: Tensor, beam: ConeBeam, grid: Grid, display: bool) -> ConeBeam:
    """The beam, `continued`, where it is None, as the X-rays (K, V, U) of a patient in the box of `grid` show it: true
    where a volume whose last slices are repeated beyond it clearly explains them better, which is said in a remark.

    display: whether the X-rays are values whose gain and offset per view are unknown.
    """
    if beam.continued is not None:
        return beam
    coarse = coarsened(grid)
    xrays = _levelled(xrays) if display else xrays
    ends, goes_on = (unexplained(xrays, replace(beam, continued=answer), coarse) for answer in (False, True))
    continued = CLEARLY * goes_on < ends
    if continued:
        warn("the X-rays show that the patient goes on above or below the volume: each column is taken to go on there "
             "as its last voxel does (`continued: false` in geometry.yaml, in Python of the ConeBeam, if it ends)",
             Remark)
    return replace(beam, continued=continued)


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
