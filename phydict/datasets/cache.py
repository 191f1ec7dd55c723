"""Prepared cases as files, safe against kills, several processes and damage."""

from __future__ import annotations

import os
import warnings
import zipfile
import zlib
from pathlib import Path

import numpy as np


def write_arrays(file: Path, arrays: dict[str, np.ndarray]) -> None:
    """Writes under a name of its own first, so that no process ever reads half a file."""
    file.parent.mkdir(parents=True, exist_ok=True)
    part = file.with_name(f"{file.stem}.{os.getpid()}.part")
    with part.open("wb") as stream:
        np.savez_compressed(stream, **arrays)
    part.replace(file)


def read_arrays(file: Path) -> dict[str, np.ndarray] | None:
    """What `write_arrays` wrote, or None where there is no such file or it is damaged (with a warning)."""
    if not file.is_file():
        return None
    try:
        with np.load(file) as stored:
            return {name: stored[name] for name in stored.files}
    except (OSError, ValueError, EOFError, KeyError, zipfile.BadZipFile, zlib.error) as error:
        warnings.warn(f"the cached case {file} cannot be read ({error}); it is prepared again", stacklevel=3)
        return None
