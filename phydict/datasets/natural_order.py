"""File names in the order a person counts: view_2 before view_10."""

from __future__ import annotations

import re

SIGN = re.compile(r"(?<![^\W_])-(?=\d)")
"""What may be the sign of a number: a hyphen before it, at the beginning or behind neither letter nor digit."""


def natural_order(text: str, signed: bool = False) -> list:
    """Sort key of a name whose runs of digits compare as numbers; signed: with what may be their signs."""
    parts = re.split(rf"((?:{SIGN.pattern})?\d+)" if signed else r"(\d+)", text)
    return [(1, int(part), "") if part.lstrip("-").isdecimal() else (0, 0, part) for part in parts]


def has_signs(names: list[str]) -> bool:
    """Whether hyphens before numbers are signs, as in angle_-30 beside angle_30: where some names have one and others
    none."""
    return 0 < sum(SIGN.search(name) is not None for name in names) < len(names)
