"""What the pixel values of X-ray images mean, and the line integrals they become.

    {kind: line_integrals, scale: 1.0, offset: 0.0}     y = scale * pixel + offset
    {kind: counts, air: 50000, dark: 100}               y = log((air - dark) / max(pixel - dark, floor))
    {kind: counts, flat: flat.png, dark: dark.png}      the same with images; of a list of files the mean is taken
    {kind: display, bright_is_dense: true}              y = gain * display + offset, both unknown per view
"""

from __future__ import annotations

import reprlib
from dataclasses import dataclass
from numbers import Real

import numpy as np

KINDS = {"line_integrals": ("scale", "offset"), "counts": ("air", "flat", "dark", "floor"),
         "display": ("bright_is_dense",)}
"""What pixel values may be -> the settings that belong to it."""

LARGEST_LINE_INTEGRAL = 100.0
"""No line integral of a patient is larger: it is 2 m of bone."""

LARGEST_PIXEL = 1e30
"""No pixel value, scale or offset is as large: it would overflow."""

ABOVE_AIR = 1.5
"""Counts above so many times the air value are no noise."""


@dataclass(frozen=True)
class Intensity:
    """How pixel values become line integrals y; see the module's table. Raises ValueError for impossible values.

    kind: "line_integrals", "counts" or "display". scale, offset: of line_integrals. Of counts: air, the value without a
    patient, or flat, the name(s) of images without one; dark, the value without X-rays, or the name(s) of such images
    (0 when left out); floor, the smallest count above dark that is believed, 1e-5 of air when left out.
    bright_is_dense: display only, must be given.
    """

    kind: str
    scale: float = 1.0
    offset: float = 0.0
    air: float | None = None
    flat: str | list[str] | None = None
    dark: float | str | list[str] | None = None
    floor: float | None = None
    bright_is_dense: bool | None = None

    def __post_init__(self):
        if self.kind not in tuple(KINDS):
            raise ValueError(f"intensity kind {reprlib.repr(self.kind)} is unknown; give one of {', '.join(KINDS)}")
        for name in ("scale", "offset", "air", "floor"):
            self._make_number(name)
        if not _names(self.dark):
            self._make_number("dark")
        if self.flat is not None and not _names(self.flat):
            raise ValueError("`flat` is the name of an image, or a list of names, but "
                             f"{reprlib.repr(self.flat)} was given")
        if self.scale == 0:
            raise ValueError("the scale of line integrals must not be 0; give what one pixel value stands for")
        for kind, names in KINDS.items():
            foreign = [name for name in names if getattr(self, name) != getattr(Intensity, name)]
            if kind != self.kind and foreign:
                raise ValueError(f"`{foreign[0]}` belongs to the intensity kind {kind}, but the kind is {self.kind}; "
                                 "leave it out")
        if self.kind == "counts" and self.flat is None and not (self.air and self.air > 0):
            raise ValueError(f"counts need `air`, the positive count without a patient, but air={self.air} was given; "
                             "or give `flat`, an image without one")
        if self.air is not None and self.flat is not None:
            raise ValueError("counts are compared with `air` or with `flat`, but both were given; leave one out")
        if self.floor is not None and not self.floor > 0:
            raise ValueError(f"the floor of counts must be positive, but floor={self.floor} was given")
        if self.kind == "display" and not isinstance(self.bright_is_dense, bool):
            raise ValueError("display images need `bright_is_dense`: true where bone is bright, false where it is dark")

    def _make_number(self, name: str) -> None:
        value = getattr(self, name)
        if value is None:
            return
        real = isinstance(value, Real) and not isinstance(value, bool)
        if not real or not abs(value) < LARGEST_PIXEL:
            raise ValueError(f"intensity needs a number for {name}, but {reprlib.repr(value)} was given; give a "
                             "finite one without quotes")
        object.__setattr__(self, name, float(value))

    @property
    def references(self) -> dict[str, list[str]]:
        """The names of the images that `flat` and `dark` call for."""
        return {name: _names(getattr(self, name)) for name in ("flat", "dark") if _names(getattr(self, name))}

    def line_integrals(self, pixels: np.ndarray, full_scale: float, references: dict[str, np.ndarray]) -> np.ndarray:
        """Line integrals of pixels (K, V, U); for display images values in [0, 1] that grow with density.

        full_scale: the largest value the image format can hold. references: the images (V, U) of `references`.
        Pixels that no X-ray reached take the floor, so that y is finite everywhere.
        Raises ValueError for negative counts, counts far above air, and air that is not above dark.
        """
        if self.kind == "line_integrals":
            y = self.scale * pixels + self.offset
            check_of_patient(y, "correct `scale` and `offset`, or state another intensity kind")
            return y
        if self.kind == "display":
            return pixels / full_scale if self.bright_is_dense else 1 - pixels / full_scale
        stated: dict = {"dark": self.dark or 0.0, "flat": self.air, **references}
        dark = stated["dark"]
        air = np.asarray(stated["flat"] - dark)
        if not (air > 0).all():
            raise ValueError(f"air is not above dark in {int((~(air > 0)).sum())} of {air.size} pixels; check which "
                             "image is which, and repair dead pixels")
        negative = int((pixels < 0).sum())
        if negative:
            raise ValueError(f"{negative} pixels hold negative counts, down to {pixels.min():g}; give counts >= 0, or "
                             "another intensity kind")
        signal = pixels - dark
        above = signal / air
        if (above > ABOVE_AIR).any():
            raise ValueError(f"{int((above > ABOVE_AIR).sum())} pixels hold counts above air, up to {above.max():.3g} "
                             "times; correct `air` or `flat`, or repair hot pixels")
        return np.log(air / np.maximum(signal, self.floor or 1e-5 * air))


def check_of_patient(y: np.ndarray, advice: str) -> None:
    """Raises ValueError, with what to do, where line integrals are those of no patient."""
    if np.nanmax(y) > LARGEST_LINE_INTEGRAL or np.nanmedian(y) < 0:
        raise ValueError(f"the X-rays have a median of {np.nanmedian(y):.3g} and reach {np.nanmax(y):.3g}, but line "
                         f"integrals behind a patient lie between 0 and about 10; {advice}")


def _names(value) -> list[str]:
    """File names: of one name or a list of them; none of anything else."""
    if isinstance(value, str):
        value = [value]
    return list(value) if isinstance(value, list | tuple) and all(map(is_file_name, value)) else []


def is_file_name(value) -> bool:
    """Whether a value can be the name of a file, at most 255 characters without a null."""
    return isinstance(value, str) and len(value) < 256 and "\0" not in value
