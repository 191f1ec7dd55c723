"""Numbers that must lie between bounds."""

from __future__ import annotations

import math


def check_between(name: str, value: float, least: float = 0, most: float = 1) -> None:
    """Raises ValueError, with the name of the setting, where a number is not finite or not in [least, most]."""
    if not least <= value <= most or math.isinf(value):
        wanted = f"lies between {least:,} and {most:,}" if most < math.inf else f"is a finite number, {least:,} or more"
        raise ValueError(f"{name} {wanted}, but {value:,} was given")


def check_fields(settings: object, path: str, **ranges: tuple[float, float]) -> None:
    """`check_between` of fields of a group of settings, by name, whose names for a user begin with `path`."""
    for name, (least, most) in ranges.items():
        check_between(f"{path}.{name}", getattr(settings, name), least, most)
