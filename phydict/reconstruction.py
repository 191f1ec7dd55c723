"""What every reconstruction method promises, and what it returns."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from contextlib import suppress
from copy import copy
from dataclasses import dataclass, field, fields, is_dataclass, replace
from numbers import Real
from pathlib import Path
from typing import Any, Self

import numpy as np
from torch import Tensor

from phydict.grid import Grid
from phydict.runtime.files import atomic_write
from phydict.runtime.memory import TooLittleMemory, check_memory
from phydict.runtime.own_code import check_dataclass, is_own, own_code
from phydict.units import MU_WATER
from phydict.xray import ConeBeam, Projector
from phydict.xray.carried import Carried


@dataclass(frozen=True)
class Reconstruction:
    """A reconstructed CT volume and the figures that say how well it fits.

    volume: HU (X, Y, Z) on `grid`; misfit: relative residual |A mu - y| / |y| over all views, and misfit_per_view;
    seconds: per stage;
    network_calls, projector_calls: denoiser evaluations, and applications of A or A.T to all views, without those on
    coarse voxels that find out where the patient ends;
    xrays, reprojection: line integrals (K, V, U), measured (calibrated where they were display values) and of the
    volume;
    masks: soft anatomy masks (M, X, Y, Z) in [0, 1] where the method gives them;
    deviation: HU (X, Y, Z), the standard deviation of the samples, where the volume is the mean of several;
    intervals: level -> HU (X, Y, Z), half the width of the interval around the volume that is to hold that share of
    voxels, where the method knows it; interval_widening: the factor by which they are wider than calibrated;
    diverged_at: the step, counted from 1, from which the misfit stayed risen to the end, None where it did not;
    precision: what the networks computed in, "own" where a prior of one's own does not say; without networks the
    X-rays' type;
    hardened: whether the line integrals bent as a tube's do, and are straightened in xrays;
    scatter: the mean share of the pixels' signal that was subtracted as scatter, and is no longer in xrays;
    model_variance: variance (K, 1, 1) of what counted as noise of each view because no volume explains it;
    beam, poses: where poses were searched, the beam found, and what was corrected in it (phydict.poses);
    coarse: the reconstruction on coarser voxels that was refined, or that says what lies outside a region of interest;
    carried: what of the volume is denser than the prior's window, such as metal, where it was found;
    extended_mm: how much more was reconstructed at both ends of each axis, where the patient continues, and cut off;
    warnings: what makes the result doubtful, in words, even where Python's filters hide warnings.
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
    intervals: dict[float, Tensor] = field(default_factory=dict)
    interval_widening: float = 1.0
    diverged_at: int | None = None
    hardened: bool = False
    scatter: float = 0.0
    precision: str = "float32"
    model_variance: Tensor | float = 0.0
    beam: ConeBeam | None = None
    poses: dict | None = None
    coarse: Reconstruction | None = None
    carried: Carried | None = None
    extended_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    warnings: list[str] = field(default_factory=list)

    @property
    def within(self) -> Tensor:
        """The volume without what is carried beside it."""
        return self.volume - self.carried.on(self.grid) if self.carried else self.volume

    def save_nifti(self, path: str | Path, values: Tensor | None = None) -> None:
        """Writes the volume, or other values (X, Y, Z) on its voxels such as the intervals' half-widths, as float32 HU
        with the grid's affine (RAS+ mm), replacing the file only when complete. Raises ValueError for another shape."""
        values = self.volume if values is None else values
        if values.shape != self.volume.shape:
            raise ValueError(f"values of shape {tuple(values.shape)} were given, but the volume's voxels are "
                             f"{tuple(self.volume.shape)}: give one value for each")
        save_nifti(path, values.numpy(), self.grid)


def save_nifti(path: str | Path, volume: np.ndarray, grid: Grid, dtype: type[np.number] = np.float32) -> None:
    """Writes `volume` (X, Y, Z) on `grid` as NIfTI (.nii or .nii.gz), replacing the file only when complete.

    dtype: of the file; of whole numbers, the nearest that it holds are written. Raises ValueError for another ending.
    """
    import nibabel

    if not str(path).lower().endswith((".nii", ".nii.gz")):
        raise ValueError(f"a volume is written as NIfTI, but '{path}' was given: end the name in .nii or .nii.gz")

    if issubclass(dtype, np.integer):
        volume = np.rint(volume).clip(np.iinfo(dtype).min, np.iinfo(dtype).max)
    image = nibabel.Nifti1Image(np.asarray(volume, dtype), grid.affine)
    image.header.set_xyzt_units("mm", "sec")
    image.set_sform(grid.affine, code="scanner")
    image.set_qform(grid.affine, code="scanner")
    with atomic_write(Path(path)) as part:
        nibabel.save(image, part)


PROCESS = 1250 * 2**20
"""Bytes that a process holds beside the volumes of a reconstruction (tests/benchmark/grid_cost.csv)."""


class Reconstructor(ABC):
    """Turns X-rays into a CT volume. Implementations are frozen dataclasses, @dataclass(frozen=True), of which records
    tell the fields as the settings; one object serves many cases.

    name: what its results call the method.
    full_detector: whether the method wants every pixel, instead of a detector binned to what the grid can hold.
    mu_water: attenuation in 1/mm that water has in the X-rays; between it and HU lies this factor.
    citation: authors, title, venue and DOI or arXiv number of the method's publication.
    precision: of its networks, where it has some; see phydict.runtime.precision.
    """

    settings_are_fields = True
    name: str = ""
    full_detector = False
    citation = ""
    precision: str = "auto"
    mu_water: float = MU_WATER

    def __post_init__(self):
        if not isinstance(self.mu_water, Real) or not 0 < self.mu_water < math.inf:
            raise ValueError(f"mu_water, the attenuation of water in 1/mm, is above 0 and about {MU_WATER}, but "
                             f"{self.mu_water!r} was given")

    def with_mu_water(self, mu_water: float) -> Reconstructor:
        """The same method for X-rays in which water attenuates `mu_water` in 1/mm."""
        return self._changed("mu_water", mu_water)

    def with_name(self, name: str) -> Reconstructor:
        """The same method by another name."""
        return self._changed("name", name)

    def with_precision(self, precision: str) -> Reconstructor:
        """The same method with its networks computed in a precision of phydict.runtime.precision.PRECISIONS."""
        return self._changed("precision", precision)

    def of_case(self, case: str) -> Reconstructor:
        """The method for the case of this id, of one that must know it."""
        return self

    def _changed(self, name: str, value: object) -> Reconstructor:
        if name in getattr(self, "__dataclass_fields__", {}):
            return replace(self, **{name: value})  # type: ignore[type-var]
        changed = copy(self)
        object.__setattr__(changed, name, value)  # of a frozen class that does not declare it
        return changed

    @property
    def volumes(self) -> int:
        """How many volumes of its grid a reconstruction holds at most, in float32."""
        return 20

    @property
    def grid(self) -> Grid | None:
        """The voxels that the method is bound to; None where any will do."""
        return None

    @property
    def survey(self) -> Grid | None:
        """The coarse voxels over all that the rays meet, of a method that looks at these first; None for others."""
        return None

    def detector_grid(self, grid: Grid) -> Grid:
        """The voxels to which the X-rays of a reconstruction on `grid` are binned: the finest that see them."""
        return grid

    def with_room(self, x: int, y: int, z: int) -> Reconstructor | None:
        """The method on so many voxels more at both ends of each axis, of its survey's or else of its own; None where
        it is bound to those it has."""
        return self if self.grid is None else None

    def bytes_on(self, grid: Grid) -> int:
        """Bytes that a process holds during a reconstruction on a grid's voxels, at most."""
        return PROCESS + 4 * self.volumes * math.prod(grid.shape)

    def check_voxels(self, grid: Grid, now: bool = False) -> None:
        """Raises TooLittleMemory where a reconstruction on a grid's voxels takes more memory than there is; now: than
        is free."""
        check_memory(self.bytes_on(grid), f"a reconstruction on {' x '.join(map(str, grid.shape))} voxels, "
                     f"{self.volumes} volumes of them at once,",
                     "give fewer voxels, or a smaller box of them", now)

    def has_memory_for(self, grid: Grid) -> bool:
        """Whether there is memory for a reconstruction on a grid's voxels."""
        with suppress(TooLittleMemory):
            self.check_voxels(grid)
            return True
        return False

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


def check_projected_from(grid: Grid, projector: Projector, whose: str, does: str) -> None:
    """Raises ValueError unless X-rays are projected from the voxels of `grid`, of which a sentence says `does`, such as
    "the target is", and which `whose`, such as "the target's", names."""
    if not grid.same_as(projector.grid):
        raise ValueError(f"{does} {grid.shape} voxels of {grid.spacing} mm, but the X-rays are projected from "
                         f"{projector.grid.shape} voxels of {projector.grid.spacing} mm: use {whose} grid")


class Delegating(Reconstructor):
    """A method that reconstructs on the voxels `target` by another one, its `base`, whose name, needs and citation are
    its own. Both are fields of a subclass, a frozen dataclass."""

    base: Any
    target: Grid

    @property
    def grid(self) -> Grid:
        return self.target

    @property
    def volumes(self) -> int:
        return max(super().volumes, self.base.volumes)

    @property
    def full_detector(self) -> bool:  # type: ignore[override]
        return self.base.full_detector

    def detector_grid(self, grid: Grid) -> Grid:
        return self.base.detector_grid(grid)

    @property
    def citation(self) -> str:  # type: ignore[override]
        return self.base.citation

    @property
    def mu_water(self) -> float:  # type: ignore[override]
        return self.base.mu_water

    @property
    def name(self) -> str:  # type: ignore[override]
        return self.base.name

    def with_mu_water(self, mu_water: float) -> Self:
        return replace(self, base=self.base.with_mu_water(mu_water))  # type: ignore[type-var]

    @property
    def precision(self) -> str:  # type: ignore[override]
        return self.base.precision

    def with_precision(self, precision: str) -> Self:
        return replace(self, base=self.base.with_precision(precision))  # type: ignore[type-var]

    def of_case(self, case: str) -> Self:
        return replace(self, base=self.base.of_case(case))  # type: ignore[type-var]

    def with_name(self, name: str) -> Self:
        return replace(self, base=self.base.with_name(name))  # type: ignore[type-var]


def describe(settings) -> dict:
    """A method's settings as plain JSON values: class name and fields, nested; of a class outside phydict its path and
    `own_code` as well, so that results of other code are not taken for its own. Raises ValueError for a class that is
    no dataclass."""
    kind: type = type(settings)
    check_dataclass(kind)
    name = f"{kind.__module__}.{kind.__qualname__}" if is_own(kind) else kind.__name__
    return {"class": name} | own_code(kind) | {f.name: _plain(getattr(settings, f.name)) for f in fields(settings)}


def _plain(value):
    if is_dataclass(value):
        return describe(value)
    if isinstance(value, Mapping):
        return {str(name): _plain(inner) for name, inner in value.items()}
    if isinstance(value, tuple | list):
        return [_plain(inner) for inner in value]
    if isinstance(value, float) and not math.isfinite(value):  # JSON has no such number
        return str(value)
    return str(value) if isinstance(value, Path) else value
