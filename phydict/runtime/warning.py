"""Warnings that point at the user's line, however deep inside the package they arise."""

from __future__ import annotations

import sys
import warnings
from pathlib import Path

import torch

INSIDE = str(Path(__file__).parents[1]), str(Path(torch.__file__).parent)
"""Where the user's line is not: in this package, and in torch, whose decorators stand between."""


class Remark(UserWarning):
    """What a user should know, though no result is doubtful for it."""


def warn(message: str, category: type[Warning] = UserWarning) -> None:
    """Warns at the innermost caller outside of this package and torch."""
    frame, level = sys._getframe(), 1
    while frame.f_back is not None and frame.f_code.co_filename.startswith((*INSIDE, "<")):
        frame, level = frame.f_back, level + 1
    warnings.warn(message, category, stacklevel=level)
