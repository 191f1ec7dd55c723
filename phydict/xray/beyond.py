"""Whether a patient continues above and below a volume, as the X-rays themselves show."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property

from torch import Tensor

from phydict.grid import Grid
from phydict.linalg.conjugate_gradients import conjugate_gradients
from phydict.xray.boxes import binned_to, in_other_voxels
from phydict.xray.geometry import ConeBeam

SIDE, ITERATIONS, CLEARLY = 32, 10, 1.1
"""Voxels per side, steps of conjugate gradients, and the least ratio of what they leave of the X-rays without
`continued` to what they leave with it for a patient to continue. On five CTs, from one to sixteen views, the ratio is
0.4 to 0.95 where the CT ends in air, and 1.2 to 30 where its last slices are repeated, at one end or both. It is nearer
to 1 only in geometries whose rays hardly leave the volume, where either answer serves."""

TALLER, MORE_CLEARLY = 0.125, 1.5
"""By which share of its height the taller volume exceeds the volume at each end, and the least ratio of what the volume
leaves of the X-rays to what the taller one leaves for that to be needed. On four CTs the ratio is 0.99 to 1.1 where
they end in the volume, with flipped views, display values and coarse phantoms 1.47 at most. Moved up or down by 96 mm
it is 1.6 to 28, but from 1.1 on for one CT that then reaches little beyond."""

LOW = 0.01
"""The share of a display image's pixels at or below what stands for air."""


class Remainders:
    """What volumes in coarse voxels leave of X-rays (K, V, U), and what that tells; each is computed once.

    display: whether the X-rays are values whose gain and offset per view are unknown.
    """

    def __init__(self, xrays: Tensor, beam: ConeBeam, display: bool):
        self.xrays, self.beam, self.display = xrays, beam, display
        self._norms: dict[tuple, float] = {}

    @cached_property
    def _measured(self) -> Tensor:
        return _levelled(self.xrays) if self.display else self.xrays

    def norm(self, grid: Grid, continued: bool) -> float:
        """The norm of what ITERATIONS steps leave of the X-rays in the voxels of a grid, continued beyond it or not."""
        key = grid.shape, grid.affine.tobytes(), continued
        if key not in self._norms:
            y, A = binned_to(grid, self._measured, replace(self.beam, continued=continued), False)
            x = conjugate_gradients(lambda mu: A.T(A(mu)), A.T(y[None]), ITERATIONS)
            self._norms[key] = float((y - A(x)[0]).norm())
        return self._norms[key]

    def continues(self, grid: Grid) -> bool:
        """Whether the patient continues above or below the box of `grid`, as the beam says or, where it does not say,
        the X-rays show: a volume whose last slices are repeated beyond it clearly explains them better. Of voxels that
        are not stacked upwards nothing is repeated."""
        if self.beam.continued is not None:
            return self.beam.continued
        coarse = coarsened(grid)
        return grid.is_upright and CLEARLY * self.norm(coarse, True) < self.norm(coarse, False)

    def needs_taller(self, grid: Grid) -> bool:
        """Whether a taller volume, if source and detectors leave room for it, clearly explains the X-rays better, of a
        patient who ends in it."""
        coarse = coarsened(grid)
        taller = coarse.grown(0, 0, round(TALLER * coarse.shape[2]))
        return (grid.is_upright and self.beam.has_room_for(taller)
                and MORE_CLEARLY * self.norm(taller, False) < self.norm(coarse, False))


def with_continuation(xrays: Tensor, beam: ConeBeam, grid: Grid, display: bool) -> ConeBeam:
    """The beam, `continued`, where it is None, as the X-rays show it; arguments as those of `Remainders`."""
    return replace(beam, continued=Remainders(xrays, beam, display).continues(grid))


def coarsened(grid: Grid) -> Grid:
    """The same box in at most SIDE voxels along each side."""
    return in_other_voxels(grid, [min(n, SIDE) for n in grid.shape])


def _levelled(display: Tensor) -> Tensor:
    """Display values (K, V, U), those of air near 0 and every view's mean 1."""
    views = display.float().flatten(1)
    low = views.kthvalue(max(1, int(LOW * views.shape[1]))).values
    level = (views.mean(1) - low).clamp(min=1e-12)
    return (display - low[:, None, None]) / level[:, None, None]
