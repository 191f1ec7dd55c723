"""Numbers that must lie between bounds."""

from __future__ import annotations


def check_between(name: str, value: float, least: float = 0, most: float = 1) -> None:
    """Raises ValueError, with the name of the setting, where a number does not lie in [least, most]."""
    if not least <= value <= most:
        raise ValueError(f"{name} lies between {least:,} and {most:,}, but {value:,} was given")
