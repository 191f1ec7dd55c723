"""Watching a reconstruction: what is not finite, what went away from the X-rays, what they do not fit."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from statistics import median
from typing import Protocol

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import max_pool3d

from phydict.grid import Grid
from phydict.runtime.warning import warn
from phydict.units import HUWindow
from phydict.xray.residuals import misfits, shared_norms, worst_misfit

EMPTY_MISFIT, RISE_FACTOR, RISE_MIN = 1.0, 2.0, 0.1
"""A misfit has risen where it is more than RISE_FACTOR times its smallest so far, that of an empty volume included, and
more than RISE_MIN."""

OUTLIER_RATIO, BAD_VIEW, BAD_FIT, BAD_GUESS = 2.0, 0.01, 0.1, 0.5
"""A view is doubted where its misfit is more than OUTLIER_RATIO times the median of all and, noise left out, more than
BAD_VIEW; all of them are where the misfit without noise is more than BAD_FIT, or, of a method that projects nothing
while it computes, more than BAD_GUESS. Trained rivals, which are such methods, give 0.04 to 0.43, and other patients'
chests 0.41 in the middle (tests/benchmark)."""

BONE, CEILING, CEILING_ML = 1000, 0.98, (2.0, 300.0)
"""Where so many ml, from least to most, hold CEILING or more of a range that reaches BONE in HU, something denser is
suspected. In 264 scenes of training CTs, phantoms and two CTs kept from training, from 1 to 24 views, some with beam
hardening and a wrong scale, 1.3 ml did at most; with 6 to 19 ml of metal in one of those two, from 128^3 voxels, 16 to
75 ml from eight views and 35 ml from four, with 1.6 ml of metal 1.7 ml."""


class Operator(Protocol):
    """What a Guard asks of a case's operator.

    y: the X-rays (1, K, V, U); last_projection: the last projections (B, K, V, U) of volumes, not of directions, or
    None.
    """

    y: Tensor
    last_projection: Tensor | None


class Guard:
    """Watches a reconstruction step by step by what its method computes anyway: nothing is projected for its sake.

    To be called after each step, and calls on_step; `estimate` is to be set to what the denoiser last estimated.
    sees_xrays: whether the method looks at the X-rays even where it projects nothing.
    misfits: step -> misfit of what was last projected in it, the largest of a batch, where anything was.
    """

    def __init__(self, operator: Operator, on_step: Callable[[], None], steps: int, sees_xrays: bool = False):
        self.operator, self.on_step, self.steps, self.sees_xrays = operator, on_step, steps, sees_xrays
        self.estimate: Tensor | None = None
        self.diverged_at: int | None = None
        self.reset()

    def reset(self) -> None:
        """Steps are counted from 1 again: further samples are drawn."""
        self.step, self.operator.last_projection = 0, None
        self.misfits: dict[int, float] = {}

    def __call__(self) -> None:
        """A step is done. Raises FloatingPointError where what was estimated or projected in it is not finite."""
        self.step += 1
        projection, self.operator.last_projection = self.operator.last_projection, None
        estimate, self.estimate = self.estimate, None
        if estimate is not None:
            self._check(estimate)
        if projection is not None:
            misfit = worst_misfit(projection, self.operator.y)
            self._check(misfit)
            self.misfits[self.step] = float(misfit)
        self.on_step()

    def finish(self, volumes: Tensor, misfit: float | None = None) -> None:
        """The last step is done and gave `volumes`, of this misfit if it is known.

        Raises FloatingPointError where they are not finite, and warns where the misfit has risen.
        """
        self._check(volumes)
        if misfit is not None:
            self._check(torch.tensor(misfit))
        if misfit is not None and self.misfits:
            self.misfits[min(max(self.misfits) + 1, self.step)] = misfit
        risen = risen_from(self.misfits)
        if risen is not None and self.diverged_at is None:
            self.diverged_at = risen
            before = min([EMPTY_MISFIT, *(value for step, value in self.misfits.items() if step < risen)])
            now = list(self.misfits.values())[-1]
            warn(f"the misfit rose from {before:.3g} to {now:.3g}, from step {risen} of {self.steps} on: the "
                 "volume went away from the X-rays")

    def score(self, volumes: Tensor | None, reprojection: Tensor, xrays: Tensor) -> dict:
        """The last step is done: how its result fits, as fields of a Reconstruction.

        volumes: what it gave, None where parts of it were finished before; reprojection and xrays (1, K, V, U): of the
        result, and as they were measured. Raises and warns as `finish` and `check_fit` do.
        """
        reprojection, xrays = reprojection[0].cpu(), xrays[0].cpu()
        fit = misfits(reprojection, xrays)
        if volumes is not None:
            self.finish(volumes, fit["misfit"])
        self.check_fit(fit["misfit_per_view"], **misfits(reprojection, xrays, shared_norms))
        return fit | {"xrays": xrays, "reprojection": reprojection, "diverged_at": self.diverged_at}

    def check_fit(self, with_noise: Sequence[float], misfit: float, misfit_per_view: Sequence[float]) -> None:
        """Warns where a method that looked at the X-rays and did not diverge fits one view, or all, badly.

        with_noise: misfit of each view; misfit, misfit_per_view: without what is noise.
        """
        if self.diverged_at is not None:
            return
        if not self.misfits:
            if self.sees_xrays and misfit > BAD_GUESS:
                warn(f"no volume was found that explains the X-rays (misfit {misfit:.2g}), and the method does not "
                     "correct what it finds by them: check the units of its result, the X-rays' scale and geometry, "
                     "and that it is made for such views and for so few of them")
            return
        view, ratio = worst_view(with_noise)
        if ratio > OUTLIER_RATIO and misfit_per_view[view] > BAD_VIEW:
            warn(f"view {view} (counted from 0) fits {ratio:.1f} times worse than the median view: check "
                 "whether it is flipped, shifted or another's, and its geometry")
        elif misfit > BAD_FIT:
            warn(f"no volume was found that explains the X-rays (misfit {misfit:.2g}): check their scale and "
                 "geometry, that they are not display values, and that the body fits into the volume")

    def _check(self, values: Tensor) -> None:
        if not values.isfinite().all():
            raise FloatingPointError(f"the reconstruction is not finite from step {self.step} of {self.steps} on: use "
                                     "smaller steps, less guidance or another prior")


def check_ceiling(x: Tensor, grid: Grid, window: HUWindow) -> None:
    """Warns where a result x (X, Y, Z) in the prior's range holds more at its upper end than bone does."""
    dense = x >= CEILING
    size = millilitres(dense, grid)
    if window.high >= BONE and CEILING_ML[0] <= size <= CEILING_ML[1]:
        place = grid.affine[:3, :3] @ np.median(dense.nonzero().double().cpu().numpy(), 0) + grid.affine[:3, 3]
        warn(f"{size:.1f} ml are as dense as {window.high:g} HU, the densest that the method knows, most of it "
             f"around ({', '.join(f'{mm:.0f}' for mm in place)}) mm: where that is metal or another dense object, its "
             "density is not found, and what lies beside it is wrong by more than the intervals say")


HALF_MASS, SAMPLED = (0.52, 1.35), 2**18
"""Between which densities relative to water half of a chest's mass lies in a reconstruction, and in how many of the
voxels it is looked for. In 31 scenes of a training CT from four or eight views, scatter, tubes of 80 and 120 kVp, noise
of up to 10 %, narrow detectors and children of 0.4 times its size among them, it was 0.84 to 1.16 by phydict_learned,
from eight 0.58 to 1.15 by phydict_fast, tv and SIRT; of two CTs with decadic logarithms 0.36 to 0.43."""

SCALED_VIEWS, UNGUIDED_VIEWS = 4, 8
"""From how many views on a reconstruction tells so, by a method with a prior and without one: from fewer a small
patient of right line integrals and a large one of too small ones look alike."""


def check_line_integral_scale(volume: Tensor, misfit: float) -> None:
    """Warns where a volume in HU (X, Y, Z) that explains the X-rays, with this misfit, is far lighter or denser than a
    chest, as of line integrals on another scale."""
    density = half_mass_density(volume)
    low, high = HALF_MASS
    if misfit <= BAD_FIT and not low < density < high:
        kind = "light" if density < 1 else "dense"
        warn(f"the volume is too {kind} for a chest: half of its mass is in voxels below {density:.2f} times the "
             "density of water, in chests below about 1 time: check the scale of the line integrals, natural "
             "logarithms of air over signal (of decadic ones `scale` is 2.3026), and mu_water, water's attenuation in "
             "1/mm")


def half_mass_density(volume: Tensor) -> float:
    """The density relative to water below which half of the mass of HU (X, Y, Z) lies; about SAMPLED voxels tell."""
    hu = volume.flatten()[::max(1, volume.numel() // SAMPLED)]
    density = (1 + hu.double() / 1000).clamp(min=0).sort().values
    mass = density.cumsum(0)
    return float(density[torch.searchsorted(mass, mass[-1] / 2)])


def millilitres(mask: Tensor, grid: Grid) -> float:
    """The volume of a mask's voxels."""
    return float(mask.sum()) * float(np.prod(grid.spacing)) / 1000


def worst_view(misfit_per_view: Sequence[float]) -> tuple[int, float]:
    """The view that fits worst, and how many times the median misfit of all views its own is."""
    view = max(range(len(misfit_per_view)), key=misfit_per_view.__getitem__)
    return view, misfit_per_view[view] / max(median(misfit_per_view), 1e-12)


def risen_from(misfits: dict[int, float]) -> int | None:
    """The step from which on the misfits (step -> misfit) stayed clearly above the smallest before them, to the last;
    None where the last is not."""
    smallest, first = EMPTY_MISFIT, None
    for step, misfit in misfits.items():
        risen = misfit > max(RISE_FACTOR * smallest, RISE_MIN)
        first, smallest = (first or step) if risen else None, min(smallest, misfit)
    return first


AIR_BELOW, RIM, ALIKE, MOST_OTHER = -900, 2, 100, 0.12
"""HU below which is air; how many voxels from air a body's own HU begin; HU around the median of these that count as
one material, and the share of them that may be of others for it to be one material in air. From 2 to 16 views of a
phantom and a CT kept from training, of their own size down to 0.42 of it, it is 0.26 or more; of balls and cylinders of
water, oil and plastic of 30 to 150 mm radius 0.1 at most."""


def one_material(volume: Tensor) -> bool:
    """Whether a volume in HU (X, Y, Z) is air, or one material in air, such as a phantom of water; no chest is."""
    near_air = max_pool3d((volume < AIR_BELOW).float()[None, None], 2 * RIM + 1, 1, RIM)[0, 0] > 0
    inner = volume[~near_air]
    if not len(inner):
        return True
    return int(((inner - inner.median()).abs() > ALIKE).sum()) < MOST_OTHER * len(inner)
