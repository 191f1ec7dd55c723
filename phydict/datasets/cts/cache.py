"""Prepared cases as files, safe against kills, several processes and damage."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO, cast

import numpy as np
import torch

from phydict.datasets.case import Case
from phydict.runtime.files import atomic_write
from phydict.runtime.reading import not_written, reason
from phydict.runtime.warning import warn

TRAINING_PARTS = ("volume", "masks", "has_masks", "report")
"""The parts of a Case that training needs."""


def key_of(parts: object) -> str:
    """A name for plain JSON values: other values have another."""
    return hashlib.sha256(json.dumps(parts).encode()).hexdigest()[:16]


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


def pack_case(case: Mapping, names: Iterable[str]) -> dict[str, np.ndarray]:
    """Those parts of a Case as small arrays: the volume in half precision, masks in steps of 1 / 255, texts and other
    parts as they are."""
    arrays = {name: np.array(part) if isinstance(part := case[name], str) else part.numpy() for name in names}
    return arrays | {"volume": arrays["volume"].astype(np.float16),
                     "masks": (255 * arrays["masks"]).round().astype(np.uint8)}


def unpack_case(packed: Mapping[str, np.ndarray]) -> Case:
    """The parts of a Case that `pack_case` made small."""
    parts: dict[str, Any] = {name: str(array) if array.dtype.kind == "U" else torch.from_numpy(array)
                             for name, array in packed.items()}
    return cast(Case, parts | {"volume": parts["volume"].float(), "masks": parts["masks"].float() / 255})


def kept_case(file: Path | None, make: Callable[[], Mapping], names: Iterable[str]) -> Case:
    """The parts `names` of a Case that a file of the cache holds, made and written to it where it does not; as they are
    after writing also where there is no such file to be."""
    packed = read_arrays(file) if file else None
    if packed is None:
        packed = pack_case(make(), names)
        if file:
            write_arrays(file, packed)
    return unpack_case(packed)


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
