"""Numbers that must lie between bounds."""

from __future__ import annotations

import math
from dataclasses import fields
from numbers import Integral, Real
from typing import Any

LEAST, MOST = 1e-9, 1_000_000
"""Of settings that are divided by or squared, so that neither overflows."""


def check_between(name: str, value: float, least: float = 0, most: float = 1) -> None:
    """Raises ValueError, with the name of the setting, where a value is no number, not finite or not in
    [least, most]."""
    if not isinstance(value, Real):
        raise ValueError(f"{name} is a number, but {value!r} was given")
    if not least <= value <= most or math.isinf(value):
        wanted = f"lies between {least:,} and {most:,}" if most < math.inf else f"is a finite number, {least:,} or more"
        raise ValueError(f"{name} {wanted}, but {value:,} was given")


def check_fields(settings: Any, path: str, **ranges: tuple[float, float]) -> None:
    """`check_between` of fields of a dataclass of settings, by name, whose names for a user begin with `path`; those
    that are declared as int must be whole numbers, those that are None are left out."""
    counts = {field.name for field in fields(settings) if field.type in (int, "int")}
    for name, (least, most) in ranges.items():
        value = getattr(settings, name)
        if value is None:
            continue
        check_between(f"{path}.{name}", value, least, most)
        if name in counts and not isinstance(value, Integral):
            raise ValueError(f"{path}.{name} is a whole number, but {value} was given")
