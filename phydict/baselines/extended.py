"""More voxels than are wanted where the X-rays show that the patient does not end with these."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from phydict.baselines.tv import FISTATV
from phydict.grid import Grid
from phydict.reconstruction import Delegating, Reconstruction, Reconstructor
from phydict.runtime.warning import Remark, heard, warn
from phydict.xray.beyond import Remainders, coarsened
from phydict.xray.binning import binned, binning
from phydict.xray.boxes import along, binned_to, in_other_voxels, lacking
from phydict.xray.geometry import ConeBeam
from phydict.xray.projectors.continued import reach_beyond
from phydict.xray.projectors.projector import Projector

UP, STEP = 48.0, 4
"""The most millimetres that are reconstructed above and below the volume, and how many voxels are added at each end at
a time: a number that the shipped networks can halve."""

LEAST_VIEWS = 4
"""Views from which on total variation tells what stands beside the volume from what is in it."""

MORE, LEAST = 0.25, 0.06
"""The largest and smallest share of the volume's width that is looked at on each side of it, the smallest only where
the geometry leaves so much room."""

FULL, LEAST_PIXELS = 0.3, 4
"""Something is seen beside the volume where at least LEAST_PIXELS pixels, of a detector binned to the coarse voxels,
read FULL more than the line integral of a volume full of water. On three CTs of 420 to 460 mm, from four views, 6 or
more do; on CTs that end inside 2 at most, which scatter, wrong poses and drift do not raise."""

SUSPECT = 2.0
"""Something unseen is looked for where conjugate gradients leave so many times more of the X-rays in the volume than in
the wider one: 2.6 or more where arms stand there, 1.3 at most where nothing does."""

TRIES, EXPLAINED, GROSS, MUCH = 50, 1.45, 0.055, 2.5
"""Iterations of total variation that decide, and what they must find.

EXPLAINED: for what is seen, the least ratio of the misfit in the volume to that in the wider one. It is 1.39 to 1.6 on
the wide CTs from four views and 2.1 or more from eight; 1.02 at most on patients who fill the volume; 1.38 on a tube's
X-rays from four views and 1.13 from eight.
GROSS, MUCH: for what is not seen, the least misfit in the volume and the least such ratio. They are 0.05 to 0.14 and
2.9 or more with arms; 0.053 and 3.3 at most on X-rays with half as much scatter as signal or with a detector 8 mm
off."""

REST = 0.15
"""The most that a box may leave unexplained, as a share of what the widest one explains and the volume does not. On
four CTs with arms of 42 mm beside the volume, 48 mm more leave 0.03 to 0.13, and 24 mm 0.16 to 0.37."""

CONTINUES = "the X-rays show that the patient continues above or below the volume"
OVERRULED = "`continued: false` in geometry.yaml, in Python of the ConeBeam, if the patient ends"


@dataclass(frozen=True)
class Extended(Delegating):
    """`base` on voxels that reach beyond those that are wanted (extended field of view), and its volumes cut to these.

    Args:
        base: the method
        target: the voxels on which it works
        kept: those that are wanted, which are the same or in their middle
        room_mm: how far at both ends of each axis the base reaches beyond the box that it would else have
    """

    base: Reconstructor
    target: Grid
    kept: Grid
    room_mm: tuple[float, float, float]

    def steps(self) -> int:
        return self.base.steps()

    def reconstruct(self, xrays: Tensor, projector: Projector, report: str = "", display: bool = False,
                    seed: int = 0, on_step: Callable[[], None] = lambda: None) -> Reconstruction:
        found = self.base.reconstruct(xrays, projector, report, display, seed, on_step)
        if found.carried is not None and not holds(self.kept, found.carried.centre):
            warn("what was found as dense as metal lies outside the volume that is kept, which does not hold it: check "
                 "the geometry, of which a wrong one shows such things where nothing is")
        return replace(found, grid=self.kept, extended_mm=self.room_mm, volume=self._cut(found.volume),
                       masks=None if found.masks is None else self._cut(found.masks),
                       deviation=None if found.deviation is None else self._cut(found.deviation),
                       intervals={level: self._cut(width) for level, width in found.intervals.items()})

    def _cut(self, volume: Tensor) -> Tensor:
        x, y, z = (slice((n - kept) // 2, (n + kept) // 2) for n, kept in zip(self.target.shape, self.kept.shape))
        return volume[..., x, y, z].clone()


def holds(grid: Grid, point: np.ndarray) -> bool:
    """Whether a point (3,) in mm lies in the box of voxels."""
    index = grid.index(point)
    return bool(((index >= -0.5) & (index <= np.array(grid.shape) - 0.5)).all())


def covering(method: Reconstructor, box: Grid) -> Reconstructor:
    """The method, of which the voxels of its survey, or else its own, hold a box along the same axes, if it takes as
    many more as that needs, in whole steps."""
    volume = method.survey or method.grid
    if volume is None or not along(volume, box):
        return method
    x, y, z = (STEP * math.ceil(n / STEP) for n in lacking(volume, box))
    return (method.with_room(x, y, z) if x or y or z else None) or method


@torch.no_grad()
def extended(method: Reconstructor, grid: Grid, xrays: Tensor, beam: ConeBeam, display: bool
             ) -> tuple[Reconstructor, Grid, ConeBeam]:
    """The method, its voxels and the beam; or, where the X-rays (K, V, U) show that the patient continues beyond the
    volume, which a remark states, a method on more voxels that cuts the result to `grid`, and the beam of these. A
    method that takes no more voxels, or has no memory for them, stays as it is.

    Above and below, the patient continues where the beam says so or, where it does not say, the X-rays show it
    (`Remainders`). Beside the volume, of line integrals of LEAST_VIEWS views or more, where source and detectors
    leave room: it is seen where rays that hardly meet the volume show more than water that fills it, and else has to
    explain much.
    """
    volume = method.survey or grid
    factor = binning(coarsened(volume), beam)
    left = Remainders(binned(xrays, factor), beam.binned(factor), display)
    answered = left.continues(volume)
    takes_more = method.with_room(STEP, STEP, 0) or method.with_room(0, 0, STEP)
    room = _room(volume, left, method.mu_water) if takes_more else (0, 0, 0)
    wider = method.with_room(*room) if any(room) else None
    whole = grid if wider is None else wider.grid or grid.grown(*room)
    if wider is None or not wider.has_memory_for(whole):
        if answered and beam.continued is None:
            warn(f"{CONTINUES}: each column is taken to continue there as its last voxel ({OVERRULED})", Remark)
        return method, grid, beam.with_continued(answered)
    x, y, z = (n * float(length) for n, length in zip(room, volume.spacing))
    if z and beam.continued is None:
        warn(f"{CONTINUES}: {z:g} mm more are reconstructed at both ends and cut off ({OVERRULED})", Remark)
    if x:
        warn("the X-rays show that something stands beside the volume, such as a wider patient, arms or a couch: "
             f"{x:g} mm more are reconstructed at each side and cut off", Remark)
    return Extended(wider, whole, grid, (x, y, z)), whole, beam.with_continued(left.continues(volume.grown(*room)))


def _room(volume: Grid, left: Remainders, mu_water: float) -> tuple[int, int, int]:
    """How many voxels more the volume needs at both ends of each axis."""
    beam, aside = left.beam, 0 if left.display else _columns(volume, left, mu_water)
    wide = volume.grown(aside, aside, 0)
    if not (left.continues(wide) or (beam.continued is None and left.needs_taller(wide))):
        return aside, aside, 0
    slices = STEP * math.ceil(min(reach_beyond(beam, wide), UP / volume.spacing[2]) / STEP)
    while slices and not beam.has_room_for(wide.grown(0, 0, slices)):
        slices -= STEP
    return aside, aside, slices


def _columns(volume: Grid, left: Remainders, mu_water: float) -> int:
    """How many voxels more the volume needs at each of its four sides to hold what stands there; 0 where nothing does
    that the X-rays show."""
    if not volume.is_upright:
        return 0
    answered = left.continues(volume)
    xrays, beam = left.xrays, replace(left.beam, continued=answered)
    across = max(volume.shape[:2])
    room = [n for n in range(STEP, int(MORE * across) + 1, STEP) if beam.has_room_for(volume.grown(n, n, 0))]
    if beam.views < LEAST_VIEWS or not room or room[-1] < LEAST * across:
        return 0
    coarse, wide = _coarse(volume, 0), _coarse(volume, room[-1])
    y, A = binned_to(coarse, xrays, replace(beam, continued=True), False)
    full = mu_water * A(torch.ones(1, 1, *coarse.shape).to(y))[0]
    seen = int((y > full + FULL).sum()) >= LEAST_PIXELS
    most, least = (left.norm(grid, answered) for grid in (coarse, wide))
    if not seen and most < SUSPECT * least:
        return 0
    with warnings.catch_warnings(), heard():  # the method will say itself what is doubtful of the X-rays
        warnings.simplefilter("ignore")
        tv = FISTATV(iterations=TRIES, mu_water=mu_water)
        alone, together = (tv.reconstruct(*binned_to(grid, xrays, beam, False)).misfit for grid in (coarse, wide))
    if not ((seen and alone > EXPLAINED * together) or alone > max(GROSS, MUCH * together)):
        return 0
    enough = least + REST * (most - least)
    return next(n for n in room if n == room[-1] or left.norm(_coarse(volume, n), answered) < enough)


def _coarse(volume: Grid, columns: int) -> Grid:
    """The box of a volume with so many columns of its voxels more at its sides, in voxels of `coarsened`'s size."""
    wide = volume.grown(columns, columns, 0)
    return in_other_voxels(wide, [math.ceil(n * few / of) for n, few, of in zip(
        wide.shape, coarsened(volume).shape, volume.shape)])
