"""A user's own class: by its path, and what tells it from another of the same name or from itself before an edit."""

from __future__ import annotations

import inspect
import sys
import zlib
from contextlib import suppress
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any


def imported(path: str) -> Any:
    """What a path such as my_module.MyClass names; of whatever kind the error where it cannot be imported."""
    module, _, name = path.rpartition(".")
    return getattr(import_module(module), name)


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
