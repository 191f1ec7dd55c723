"""CTs in MetaImage and NRRD files, as LUNA16's and 3D Slicer's are, read by SimpleITK."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from phydict.runtime.memory import check_memory

ENDINGS = (".mhd", ".mha", ".nrrd")

MOST_HEADER = 2**20
"""Bytes of a MetaImage header that are looked at."""


def voxel_files(path: Path) -> list[Path]:
    """The files that hold the voxels of a MetaImage header (.mhd), as far as they are there; none of other files."""
    if path.suffix.lower() != ".mhd":
        return []
    with path.open("rb") as file:
        lines = file.read(MOST_HEADER).decode("latin-1").splitlines()
    values = [line.partition("=")[2].strip() for line in lines]
    first = next((n for n, line in enumerate(lines) if line.partition("=")[0].strip() == "ElementDataFile"), len(lines))
    names = [*values[first:first + 1], *(line.strip() for line in lines[first + 1:])]
    return [path.parent / name for name in names if name and (path.parent / name).is_file()]


def open_itk(path: Path):
    """SimpleITK's reader of a file with one of ENDINGS, which has read the header. For use inside `reading`.

    Raises ValueError where SimpleITK is not installed, for voxels that are not one number each, and for another number
    of dimensions than three.
    """
    try:
        import SimpleITK
    except ImportError:
        raise ValueError("SimpleITK, which reads it, is not installed: pip install 'phydict[itk]'") from None
    reader = SimpleITK.ImageFileReader()
    reader.SetFileName(str(path))
    with _in_a_line():
        reader.ReadImageInformation()
    shape, numbers = reader.GetSize(), reader.GetNumberOfComponents()
    if len(shape) != 3 or numbers != 1:
        raise ValueError(f"it is {len(shape)}D with shape {shape} and {numbers} numbers per voxel; one 3D volume of "
                         "one number each is needed")
    return reader


@contextmanager
def _in_a_line() -> Iterator[None]:
    """A ValueError with the last line of what SimpleITK raises, which says what is wrong."""
    try:
        yield
    except RuntimeError as error:
        raise ValueError(str(error).strip().splitlines()[-1].strip()) from error


def read_itk(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """The numbers (X, Y, Z) of a file with one of ENDINGS, and its 4x4 index -> RAS+ world mm affine. For use inside
    `reading`.

    Raises ValueError as `open_itk`, and for more voxels than this machine can hold.
    """
    reader = open_itk(path)
    import SimpleITK

    check_memory(16 * math.prod(reader.GetSize()), f"its shape {reader.GetSize()}", "give a smaller one")
    with _in_a_line():
        volume = SimpleITK.GetArrayFromImage(reader.Execute()).T
    affine = np.eye(4)
    affine[:3, :3] = np.reshape(reader.GetDirection(), (3, 3)) * reader.GetSpacing()
    affine[:3, 3] = reader.GetOrigin()
    return volume, np.diag([-1.0, -1.0, 1.0, 1.0]) @ affine  # ITK's world is LPS
