"""The words that reports are written in."""

from __future__ import annotations

import re
from collections.abc import Iterable
from types import ModuleType

from phydict.datasets.prose import elsewhere, phrases, sentences


def written_words() -> list[str]:
    """Every word that a written report may hold, in lower case and in order."""
    return sorted(_words(_lists(elsewhere)) | set(telling_words()) | {"an"})


def telling_words() -> list[str]:
    """The words by which findings are stated, placed or denied, in lower case and in order."""
    filled_in = {"right", "left", "upper", "middle", "lower", "bilateral", "nor"}
    return sorted(_words([*_lists(phrases), sentences.COMBINED, list(sentences.ABBREVIATIONS.values())]) | filled_in)


def naming_words() -> list[str]:
    """The words that name findings, in lower case and in order: a sentence without them states none."""
    return sorted(_words([phrases.SINGLE, phrases.SEVERAL, phrases.DENIED_NAMES, phrases.HEART_STATEMENTS]))


def _lists(module: ModuleType) -> list:
    return [value for name, value in vars(module).items() if name.isupper()]


def _words(values: Iterable) -> set[str]:
    words: set[str] = set()
    for value in values:
        if isinstance(value, str):
            words |= set(re.findall(r"[a-z]{2,}", re.sub(r"\{[^}]*\}", " ", value).lower()))
        elif isinstance(value, dict):
            words |= _words(value.values())
        elif isinstance(value, list | tuple):
            words |= _words(value)
    return words
