"""What every reconstruction method promises, and what it returns."""

from __future__ import annotations

import math
import time
import warnings
import zlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields, is_dataclass, replace
from pathlib import Path
from statistics import median
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from phydict import profiling
from phydict.runtime.files import whole_file
from phydict.grid import Grid
from phydict.units import MU_WATER
from phydict.xray import ConeBeam, Projector

EMPTY, RISE, RISEN = 1.0, 2.0, 0.1
"""A misfit has risen where it is more than RISE times its smallest so far, that of an empty volume included, and more
than RISEN."""
ALONE, LARGE = 2.0, 0.1
"""Where a view's misfit is more than ALONE times the median of all, that view is doubted; where the misfit is more than
LARGE, all of them are."""
CHEST = 1.0, 20.0
"""Between these lies the largest line integral of a chest: 50 mm and 1 m of water."""
NOTHING = 1e-3
"""A line integral, 0.05 mm of water, below which misfits are not relative to what is measured, but to this."""


class Stopwatch:
    """Seconds spent per named stage of a reconstruction."""

    def __init__(self):
        self.seconds: dict[str, float] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        began = time.perf_counter()
        try:
            with profiling.stage(name):
                yield
        finally:
            self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - began


@dataclass(frozen=True)
class Reconstruction:
    """A reconstructed CT volume and the figures that say how far to trust it.

    volume: HU (X, Y, Z) on `grid`; misfit: relative residual |A mu - y| / |y| over all views, and misfit_per_view;
    seconds: per stage; network_calls, projector_calls: denoiser evaluations and applications of A or A.T to all
    views; xrays, reprojection: line integrals (K, V, U), measured (calibrated where they were display values) and
    of the volume; masks: soft anatomy masks (M, X, Y, Z) in [0, 1] where the method gives them; deviation: HU
    (X, Y, Z), the standard deviation of the samples of which the volume is the mean, where there are several;
    diverged_at: the step, counted from 1, from which on the misfit had risen until the end, None where it had not;
    precision: what the networks computed in, or, without any, the X-rays' type;
    scatter: the mean share of the pixels' signal that was subtracted as scatter, and is no longer in xrays.
    """

    volume: Tensor
    grid: Grid
    method: str
    seed: int
    misfit: float
    misfit_per_view: list[float]
    seconds: dict[str, float]
    xrays: Tensor
    reprojection: Tensor
    network_calls: int = 0
    projector_calls: int = 0
    masks: Tensor | None = None
    deviation: Tensor | None = None
    diverged_at: int | None = None
    scatter: float = 0.0
    precision: str = "float32"

    def save_nifti(self, path: str | Path) -> None:
        """Writes the volume as float32 HU with the grid's affine (RAS+ mm), replacing the file only when complete."""
        save_nifti(path, self.volume.numpy(), self.grid)


def save_nifti(path: str | Path, volume: np.ndarray, grid: Grid) -> None:
    """Writes `volume` (X, Y, Z) on `grid` as NIfTI (.nii or .nii.gz), replacing the file only when complete."""
    import nibabel

    image = nibabel.Nifti1Image(np.asarray(volume, np.float32), grid.affine)
    image.header.set_xyzt_units("mm", "sec")
    image.set_sform(grid.affine, code="scanner")
    image.set_qform(grid.affine, code="scanner")
    with whole_file(Path(path)) as part:
        nibabel.save(image, part)


class Reconstructor(ABC):
    """Turns X-rays into a CT volume. Implementations are dataclasses of settings; one object serves many cases.

    full_detector: whether the method wants every pixel, instead of a detector binned to what the grid can hold.
    mu_water: attenuation in 1/mm that water has in the X-rays; between it and HU lies this factor.
    citation: authors, title, venue and DOI or arXiv number of the method's publication.
    """

    full_detector = False
    citation = ""
    mu_water: float = MU_WATER

    def __post_init__(self):
        if not 0 < self.mu_water < math.inf:
            raise ValueError(f"mu_water, the attenuation of water in 1/mm, is above 0 and about {MU_WATER}, but "
                             f"{self.mu_water} was given")

    def assuming(self, mu_water: float) -> Reconstructor:
        """The same method for X-rays in which water attenuates `mu_water` in 1/mm."""
        return replace(self, mu_water=mu_water)

    @abstractmethod
    def reconstruct(self, xrays: Tensor, projector: Projector, report: str = "", display: bool = False,
                    seed: int = 0, on_step: Callable[[], None] = lambda: None) -> Reconstruction:
        """Reconstruct one case.

        xrays: line integrals (K, V, U), or, with display=True, values that are affine in them with an unknown gain
        and offset per view. report: radiology text, "" for none. seed: the only source of randomness.
        on_step: called once per step, `steps()` times in all. Raises ValueError when grid or views do not fit.
        """

    @abstractmethod
    def steps(self) -> int:
        """How often `reconstruct` calls on_step."""


def case_seed(seed: int, case: str) -> int:
    """The seed of a case of infer.py's test and ablate, by the run's seed and the case's id: zlib.crc32 of the text
    "<seed>/<id>". It decides the noise of the case's X-rays and their reconstruction, whatever the method and the other
    cases are."""
    return zlib.crc32(f"{seed}/{case}".encode())


def check_seed(seed: int) -> None:
    """Raises ValueError unless a seed is a whole number that random generators take."""
    if not isinstance(seed, int) or not 0 <= seed < 2**63:
        raise ValueError(f"a seed is a whole number from 0 to 2^63 - 1, but {seed} was given")


def check_xrays(xrays: Tensor, beam: ConeBeam) -> None:
    """Raises ValueError unless the X-rays (K, V, U) are finite, as many and as large as the beam's views, and none of
    them is blank, but for X-rays that are 0 everywhere."""
    expected = (beam.views, *beam.shape)
    if tuple(xrays.shape) != expected:
        raise ValueError(f"the geometry describes {expected[0]} views of {expected[1]} x {expected[2]} pixels, "
                         f"but the X-rays have shape {tuple(xrays.shape)}: give images and geometry that match")
    if not xrays.isfinite().all():
        raise ValueError("the X-rays contain NaN or infinite pixels: repair or remove those views first")
    blank = xrays.flatten(1).amin(1) == xrays.flatten(1).amax(1)
    if blank.any() and xrays.any():
        which = "every view" if blank.all() else f"view {int(blank.nonzero()[0])}"
        raise ValueError(f"{which} holds the same value in every pixel, as a missing or saturated image does: leave it "
                         "out of the X-rays and of the geometry")


def check_air(xrays: Tensor) -> None:
    """Warns where views (K, V, U) look inverted: more than half of the pixels in their outermost columns, where air is
    seen, or what is thin where the detector is narrow, lie in the uppermost tenth of their range (median view)."""
    views = xrays.float().flatten(1)
    views = views[:, ::max(1, views.shape[1] // 10_000)]
    rank = max(1, views.shape[1] // 100)
    low, high = views.kthvalue(rank).values, views.kthvalue(views.shape[1] + 1 - rank).values
    width = max(1, xrays.shape[2] // 50)
    sides = torch.cat([xrays[..., :width], xrays[..., -width:]], -1).flatten(1)
    share = (sides > (high - 0.1 * (high - low))[:, None]).float().mean(1)
    if share.median() > 0.5:
        warnings.warn("the X-rays are densest at their left and right sides, where air should be seen, as inverted "
                      "images are: turn them by a negative `scale` with an `offset`, or by the other "
                      "`bright_is_dense`, or cut off what a collimator covered", stacklevel=3)


def check_line_integrals(xrays: Tensor) -> None:
    """Warns of line integrals that no chest has."""
    largest = float(xrays.max())
    if not CHEST[0] < largest < CHEST[1]:
        warnings.warn(f"the largest line integral is {largest:.3g}, but those of a chest lie between {CHEST[0]:g} and "
                      f"{CHEST[1]:g}: check that the X-rays are line integrals of attenuation in 1/mm along mm, or "
                      "give display: true where they are display values", stacklevel=3)


def misfits(reprojection: Tensor, xrays: Tensor) -> dict:
    """Relative residual |P - y| / |y| of line integrals (K, V, U): over all views and per view."""
    residual, size = _norms(reprojection - xrays), _sizes(xrays)
    return {"misfit": float(residual.norm() / size.norm()), "misfit_per_view": (residual / size).tolist()}


def _norms(views: Tensor) -> Tensor:
    return views.flatten(-2).norm(dim=-1)


def _sizes(xrays: Tensor) -> Tensor:
    """Norms (..., K) of views (..., K, V, U), of which none counts as smaller than one of NOTHING in every pixel."""
    return _norms(xrays).clamp(min=NOTHING * math.sqrt(xrays.shape[-1] * xrays.shape[-2]))


class Operator(Protocol):
    """What a Guard asks of a case's operator.

    y: the X-rays (1, K, V, U); seen: the last projections (B, K, V, U) of volumes, not of directions, or None.
    """

    y: Tensor
    seen: Tensor | None


class Guard:
    """Watches a reconstruction step by step by what its method computes anyway: nothing is projected for its sake.

    To be called after each step, and calls on_step; `estimate` is to be set to what the denoiser last estimated.
    misfits: step -> misfit of what was last projected in it, the largest of a batch, where anything was.
    """

    def __init__(self, operator: Operator, on_step: Callable[[], None], steps: int):
        self.operator, self.on_step, self.steps = operator, on_step, steps
        self.estimate: Tensor | None = None
        self.diverged_at: int | None = None
        self.begin()

    def begin(self) -> None:
        """Steps are counted from 1 again: further samples are drawn."""
        self.step, self.misfits, self.operator.seen = 0, {}, None

    def __call__(self) -> None:
        """A step is done. Raises FloatingPointError where what was estimated or projected in it is not finite."""
        self.step += 1
        seen, self.operator.seen = self.operator.seen, None
        estimate, self.estimate = self.estimate, None
        if estimate is not None:
            self._check(estimate)
        if seen is not None:
            y = self.operator.y
            misfit = (_norms(seen - y).norm(dim=-1) / _sizes(y).norm(dim=-1)).max()
            self._check(misfit)
            self.misfits[self.step] = float(misfit)
        self.on_step()

    def end(self, volumes: Tensor, misfit: float | None = None) -> None:
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
            before = min([EMPTY, *(value for step, value in self.misfits.items() if step < risen)])
            now = list(self.misfits.values())[-1]
            warnings.warn(f"the misfit rose from {before:.3g} to {now:.3g}, from step {risen} of {self.steps} on: the "
                          "volume went away from the X-rays", stacklevel=3)

    def doubt(self, misfit: float, misfit_per_view: Sequence[float]) -> None:
        """Warns where a method that looked at the X-rays and did not diverge fits one view, or all, badly."""
        if not self.misfits or self.diverged_at is not None:
            return
        view, ratio = worst_view(misfit_per_view)
        if ratio > ALONE and misfit_per_view[view] > 0.01:
            warnings.warn(f"view {view} (counted from 0) fits {ratio:.1f} times worse than the median view: check "
                          "whether it is flipped, shifted or another's, and its geometry", stacklevel=3)
        elif misfit > LARGE:
            warnings.warn(f"no volume was found that explains the X-rays (misfit {misfit:.2g}): check their scale and "
                          "geometry, that they are not display values, and that the body fits into the volume",
                          stacklevel=3)

    def _check(self, values: Tensor) -> None:
        if not values.isfinite().all():
            raise FloatingPointError(f"the reconstruction is not finite from step {self.step} of {self.steps} on: use "
                                     "smaller steps, less guidance or another prior")


def worst_view(misfit_per_view: Sequence[float]) -> tuple[int, float]:
    """The view that fits worst, and how many times the median misfit of all views its own is."""
    view = max(range(len(misfit_per_view)), key=misfit_per_view.__getitem__)
    return view, misfit_per_view[view] / max(median(misfit_per_view), 1e-12)


def risen_from(misfits: dict[int, float]) -> int | None:
    """Of misfits by step, the first step of those at the end that had all risen above what was reached before."""
    smallest, first = EMPTY, None
    for step, misfit in misfits.items():
        risen = misfit > max(RISE * smallest, RISEN)
        first, smallest = (first or step) if risen else None, min(smallest, misfit)
    return first


def describe(settings) -> dict:
    """A method's settings as plain JSON values: class name and fields, nested."""
    return {"class": type(settings).__name__} | {
        f.name: describe(value) if is_dataclass(value := getattr(settings, f.name)) else value
        for f in fields(settings)}
