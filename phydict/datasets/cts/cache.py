"""Prepared cases as files, safe against kills, several processes and damage."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

import numpy as np

from phydict.runtime.files import atomic_write
from phydict.runtime.reading import not_written, reason
from phydict.runtime.warning import warn


def write_arrays(file: Path, arrays: dict[str, np.ndarray]) -> None:
    """Writes `arrays` as one file that appears only when complete, so that no process ever reads half a file.

    Raises OSError, in one sentence, where it cannot be written; nothing of it is left then.
    """
    with _cached(file) as stream:
        np.savez_compressed(stream, **arrays)  # type: ignore[arg-type]  # none is called allow_pickle


def write_array(file: Path, array: np.ndarray) -> None:
    """Writes one array as .npy, so that a part of it can be read without the rest; else as `write_arrays`."""
    array = np.ascontiguousarray(array)
    with _cached(file) as stream:
        header = np.lib.format.header_data_from_array_1_0(array)
        np.lib.format.write_array_header_1_0(stream, header)
        stream.write(array.data)  # np.save would not notice that a full disk takes no more of an array's end


@contextmanager
def _cached(file: Path) -> Iterator[BinaryIO]:
    try:
        with atomic_write(file) as part, part.open("wb") as stream:
            yield stream
    except OSError as error:
        raise not_written(f"the prepared case {file} of the cache", error, "give another data.cache") from error


def read_arrays(file: Path) -> dict[str, np.ndarray] | None:
    """What `write_arrays` wrote, or None where there is no such file or it is damaged (with a warning)."""
    if not file.is_file():
        return None
    try:
        with np.load(file) as stored:
            return {name: stored[name] for name in stored.files}
    except Exception as error:  # whatever a damaged archive leads NumPy to
        warn(f"the cached case {file} cannot be read ({reason(error)}); it is prepared again")
        return None
