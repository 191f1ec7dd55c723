"""A user's own class: by its path, and what tells it from another of the same name or from itself before an edit."""

from __future__ import annotations

import inspect
import sys
import zlib
from collections.abc import Callable
from contextlib import suppress
from dataclasses import is_dataclass
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any


def imported(path: str) -> Any:
    """What a path such as my_module.MyClass names. Raises ValueError, in words, where it cannot be imported, and where
    it is a method (`settings_are_fields`) whose settings could not be told, since it is no dataclass."""
    module, _, name = path.rpartition(".")
    try:
        found = import_module(module)
    except ModuleNotFoundError as error:
        raise ValueError(_missing(module, error)) from error
    except (Exception, SystemExit) as error:  # of whatever kind: another's code runs
        raise ValueError(f"module {module} ends in {words(error)}") from error
    if not hasattr(found, name):
        raise ValueError(f"module {module} has no {name}")
    kind = getattr(found, name)
    if isinstance(kind, type) and getattr(kind, "settings_are_fields", False):
        check_dataclass(kind)
    return kind


def check_dataclass(kind: type) -> None:
    """Raises ValueError unless a class of settings is a dataclass."""
    if not is_dataclass(kind):
        raise ValueError(f"{kind.__name__} is no dataclass, so that its settings cannot be told: put "
                         "@dataclass(frozen=True) above the class")


def check_takes(method: Callable, what: str, *arguments: str) -> None:
    """Raises ValueError, which calls the method `what`, unless it can be called with these positional arguments."""
    try:
        signature = inspect.signature(method)
    except (TypeError, ValueError):  # what is not written in Python tells of none
        return
    try:
        signature.bind(*arguments)
    except TypeError as error:
        raise ValueError(f"{what} is called as ({', '.join(arguments)}), but is written as {signature}: give it these "
                         "parameters") from error


def words(error: BaseException) -> str:
    """An error of a user's code on one line, its kind before it."""
    return " ".join(f"{type(error).__name__}: {error}".split())


def _missing(module: str, error: ModuleNotFoundError) -> str:
    first, missing = module.partition(".")[0], error.name or ""
    if missing == first:
        return f"there is no module {first}: put its folder on PYTHONPATH"
    if f"{module}.".startswith(f"{missing}."):
        return f"there is no module {missing}"
    return f"module {module} needs {missing}, which is not installed" if missing else words(error)


@cache
def own_code(kind: type) -> dict[str, int]:
    """code_crc32: of the source files of a class and of its bases outside phydict, torch, lightning and the standard
    library, as they are when it is first asked for; empty where there is none."""
    code = b"".join(dict.fromkeys(_source(base) for base in kind.__mro__ if is_own(base)))
    return {"code_crc32": zlib.crc32(code)} if code else {}


def is_own(kind: type) -> bool:
    """Whether a class is a user's."""
    return kind.__module__.partition(".")[0] not in {"phydict", "torch", "lightning", *sys.stdlib_module_names}


def _source(kind: type) -> bytes:
    """What the file of a class's module holds; the class's own lines in a script, whose others may change; empty where
    neither can be read."""
    file = getattr(sys.modules.get(kind.__module__), "__file__", None)
    with suppress(OSError, TypeError):
        return Path(file).read_bytes() if file and kind.__module__ != "__main__" else inspect.getsource(kind).encode()
    return b""
