"""Nested settings, frozen dataclasses, by dotted paths: which fields there are, their values, and changed copies."""

from __future__ import annotations

import json
import reprlib
from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass, replace
from functools import lru_cache
from types import NoneType
from typing import get_args, get_type_hints

from jsonargparse import ArgumentError, ArgumentParser

from phydict.reconstruction import describe


def has_field(settings, path: Sequence[str]) -> bool:
    """Whether `path` leads to a field of nested settings."""
    if not is_dataclass(settings) or path[0] not in {f.name for f in fields(settings)}:
        return False
    return len(path) == 1 or has_field(getattr(settings, path[0]), path[1:])


def field_of(settings, path: Sequence[str]):
    """The field of nested settings that `path` leads to."""
    return settings if not path else field_of(getattr(settings, path[0]), path[1:])


def changed(settings, changes: Mapping[str, object], name: str):
    """Nested settings with the values of `changes`, dotted path -> value, in place of their own, all at once.

    Raises ValueError naming the setting where a value is none that its field can have.
    """
    new_values = {}
    for first in dict.fromkeys(path.partition(".")[0] for path in changes):
        value, hint = getattr(settings, first), get_type_hints(type(settings))[first]
        if first in changes:
            value = parsed(hint, changes[first], f"{name}.{first}")
        deeper = {path.partition(".")[2]: v for path, v in changes.items() if path.startswith(first + ".")}
        new_values[first] = changed(value, deeper, f"{name}.{first}") if deeper else value
    return replace(settings, **new_values) if new_values else settings


def parsed(hint, value, name: str):
    """`value`, as YAML gives it, as the type `hint`. Raises ValueError naming the setting where it is none."""
    return (_parsed_once if isinstance(value, str | int | float) else _parsed)(hint, value, name)


def _parsed(hint, value, name: str):
    parser = ArgumentParser(exit_on_error=False)
    parser.add_argument("--value", type=hint)
    try:
        if value is None and NoneType not in get_args(hint):
            raise TypeError
        return parser.instantiate(parser.parse_object({"value": value})).value
    except (ArgumentError, TypeError, ValueError) as error:
        wanted = getattr(hint, "__name__", str(hint))
        raise ValueError(f"{name} takes a value of type {wanted}, but {reprlib.repr(value)} was given") from error


def plain(value):
    """A setting as one field of a table, where an empty field means that it is the method's own."""
    if is_dataclass(value) or isinstance(value, list | tuple | Mapping):
        return json.dumps(value, default=lambda inner: describe(inner) if is_dataclass(inner) else str(inner))
    return "none" if value is None else value


_parsed_once = lru_cache(10_000, typed=True)(_parsed)
"""A product has each of its values in many trials."""
