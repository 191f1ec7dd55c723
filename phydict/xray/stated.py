"""Numbers, lengths, angles and mappings as a geometry states them, each checked by its name."""

from __future__ import annotations

import math
import reprlib

import numpy as np

from phydict.runtime.warning import warn

MOST_RADIANS = 4 * math.pi
"""An angle in radians beyond two turns was meant in degrees."""
LEAST_SPREAD = 0.1
"""Degrees up to which nobody takes the spread of an orbit's views for radians: they would be 6 degrees."""
LEAST_MM, MOST_MM = 1e-6, 1e9
"""No pixel's side is shorter, and no length as long: they would be those of a mistake, and underflow or overflow."""


def radians_of(name: str, radians: float | None, degrees: float | None, otherwise: float) -> float:
    """An angle of an orbit that was given in radians, in degrees or not at all."""
    if radians is not None and degrees is not None:
        raise ValueError(f"{name}={radians} (radians) and {name}_degrees={degrees} were both given; leave one out")
    for key, value in ((name, radians), (f"{name}_degrees", degrees)):
        if value is not None:
            number_of(key, value)
    if radians is not None and abs(radians) > MOST_RADIANS:
        raise ValueError(f"{name} is in radians, but {radians} was given, more than two turns; give {name}_degrees for "
                         "degrees")
    return math.radians(degrees) if degrees is not None else otherwise if radians is None else radians


def check_degrees(name: str, spread: float, views: int) -> None:
    """Warns where views stand within so few degrees of one another that the angles were likely given in radians."""
    if views > 1 and LEAST_SPREAD < abs(spread) <= math.tau:
        warn(f"{views} views stand within {abs(spread):.3g} degrees of one another by {name}, too near to tell depth: "
             f"where these angles are in radians, they are {math.degrees(abs(spread)):.0f} degrees, which is what to "
             "give")


def pixel_sizes(pixel) -> tuple[float, float]:
    """(row height, column width) in mm of one number or two. Raises ValueError where they are not positive and
    finite."""
    try:
        height, width = map(float, np.broadcast_to(numbers_of("pixel", pixel), 2))
    except ValueError:
        height = width = 0.0
    if not (0 < height < MOST_MM and 0 < width < MOST_MM):
        raise ValueError(f"pixel must be (row height, column width) > 0 in mm, but {reprlib.repr(pixel)} was given")
    return height, width


def check_isocentre(source_to_detector: float, source_to_isocentre: float) -> None:
    number_of("source_to_detector", source_to_detector)
    number_of("source_to_isocentre", source_to_isocentre)
    if not 0 < source_to_isocentre < source_to_detector < MOST_MM:
        raise ValueError(f"the isocentre must lie between source and detector, but source_to_isocentre="
                         f"{source_to_isocentre} mm and source_to_detector={source_to_detector} mm were given; "
                         "correct them, both from the source and in mm")


def numbers_of(key: str, value) -> float | np.ndarray:
    """A number, or a regular list of numbers as an array, all finite. Raises ValueError naming the key."""
    try:
        numbers = np.asarray(value)
    except ValueError:  # lists of different lengths
        numbers = np.asarray(None)
    if numbers.dtype.kind not in "iuf":
        raise ValueError(f"{key} is a number or a list of numbers without units and quotes, but {reprlib.repr(value)} "
                         "was given")
    if not np.isfinite(numbers).all():
        raise ValueError(f"{key} must be finite, but {reprlib.repr(value)} was given")
    return numbers if numbers.ndim else numbers.item()


def number_of(key: str, value) -> float:
    """One finite number. Raises ValueError naming the key."""
    number = numbers_of(key, value)
    if isinstance(number, np.ndarray):
        raise ValueError(f"{key} is one number, but {reprlib.repr(value)} was given")
    return number


def check_keys(content: object, required: tuple[str, ...], optional: tuple[str, ...], instead: str = "") -> dict:
    """The mapping with these keys that `content` is; instead: what else may be given, for the message. Raises
    ValueError, naming the key, where it is none."""
    if not isinstance(content, dict):
        raise ValueError(f"a mapping with the keys {', '.join(required)} was expected, but "
                         f"{reprlib.repr(content)} was found")
    allowed = ", ".join(required + optional) + instead
    for key in content:
        if key not in required + optional:
            raise ValueError(f"unknown key {reprlib.repr(key)}; the keys are {allowed}")
    for key in required:
        if key not in content:
            raise ValueError(f"missing key {key!r}; the keys are {allowed}")
    return content
