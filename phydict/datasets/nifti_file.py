"""NIfTI files as they are opened: one number per voxel, and no more voxels than the file can hold."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

from phydict.runtime.memory import check_memory
from phydict.runtime.reading import MOST_SQUEEZED, check_held

if TYPE_CHECKING:
    from nibabel.spatialimages import SpatialImage

NIFTI = (".nii", ".nii.gz")


def open_nifti(path: Path) -> SpatialImage:
    """A NIfTI image whose voxels are not read yet. For use inside `reading`.

    Raises ValueError for voxels that are not one real number each, and for more of them than the file or this machine
    can hold.
    """
    import nibabel

    image: SpatialImage = nibabel.load(path)  # type: ignore[assignment]  # its stub knows no formats
    shape, kind = image.header.get_data_shape(), image.get_data_dtype()
    if kind.kind not in "iuf":
        raise ValueError(f"its voxels are of type {kind}, such as colours or complex numbers; one real number each is "
                         "needed")
    if min(shape, default=0) < 1:
        raise ValueError(f"its header gives it the shape {tuple(shape)}")
    check_held(math.prod(map(int, shape)) * kind.itemsize, path, f"bytes of voxels, shape {tuple(shape)},",
               MOST_SQUEEZED if path.name.lower().endswith(".gz") else 1)
    check_memory(math.prod(map(int, shape)) * (kind.itemsize + 8), f"its shape {tuple(shape)}", "give a smaller one")
    return image
