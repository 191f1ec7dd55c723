"""Warnings that point at the user's line, however deep inside the package they arise."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path

import torch

INSIDE = str(Path(__file__).parents[1]), str(Path(torch.__file__).parent)
"""Where the user's line is not: in this package, and in torch, whose decorators stand between."""


class Remark(UserWarning):
    """What a user should know, though no result is doubtful for it."""


_heard: ContextVar[list[str] | None] = ContextVar("heard", default=None)


@contextmanager
def heard() -> Iterator[list[str]]:
    """The UserWarnings of `warn` inside, remarks aside, each once, whether or not Python's filters show them."""
    texts: list[str] = []
    before = _heard.set(texts)
    try:
        yield texts
    finally:
        _heard.reset(before)


def warn(message: str, category: type[Warning] = UserWarning) -> None:
    """Warns at the innermost caller outside of this package and torch."""
    texts = _heard.get()
    if texts is not None and category is UserWarning and message not in texts:
        texts.append(message)
    frame, level = sys._getframe(), 1
    while frame.f_back is not None and frame.f_code.co_filename.startswith((*INSIDE, "<")):
        frame, level = frame.f_back, level + 1
    warnings.warn(message, category, stacklevel=level)
