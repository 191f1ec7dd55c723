"""A small CT of a thorax for the tests of what reads CTs."""

from __future__ import annotations

from pathlib import Path

import nibabel
import numpy as np

AFFINE = np.array([[6.0, 0, 0, 40], [0, 6, 0, -300], [0, 0, 6, 900], [0, 0, 0, 1]])


def thorax_hu() -> np.ndarray:
    """HU (44, 36, 34) of 6 mm RAS+ voxels: a body with two unequal lungs, and a bright ball at the patient's right."""
    x, y, z = np.meshgrid(*[np.arange(n) - (n - 1) / 2 for n in (44, 36, 34)], indexing="ij")
    hu = np.where((x / 20) ** 2 + (y / 15) ** 2 < 1, 40, -1000)
    hu[((x - 9) / 7) ** 2 + ((y - 1) / 9) ** 2 + ((z - 2) / 12) ** 2 < 1] = -850
    hu[((x + 9) / 6) ** 2 + ((y - 1) / 9) ** 2 + ((z - 2) / 11) ** 2 < 1] = -840
    hu[(x - 14) ** 2 + (y + 8) ** 2 + (z + 9) ** 2 < 6] = 900
    return hu.astype(np.int16)


def save_ct(path: Path, data: np.ndarray, affine: np.ndarray = AFFINE) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    nibabel.save(nibabel.Nifti1Image(data, affine), path)
    return path
