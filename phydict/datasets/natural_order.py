"""File names in the order a person counts: view_2 before view_10."""

from __future__ import annotations

import re


def natural_order(text: str) -> list:
    """Sort key of a name whose runs of digits compare as numbers."""
    return [(1, int(part), "") if part.isdecimal() else (0, 0, part) for part in re.split(r"(\d+)", text)]
