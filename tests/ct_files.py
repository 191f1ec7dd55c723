"""CTs of a thorax for the tests of what reads CTs."""

from __future__ import annotations

import csv
from pathlib import Path

import nibabel
import numpy as np

from phydict.datasets.cts.preparation import SUMMARY, prepare_folder
from phydict.datasets.cts.spaces import Settings

AFFINE = np.array([[6.0, 0, 0, 40], [0, 6, 0, -300], [0, 0, 6, 900], [0, 0, 0, 1]])
LIVER = np.array([250.0, -150.0, 980.0])
"""World position in mm of a bright ball at the patient's right, in `large_thorax_hu`."""


def thorax_hu() -> np.ndarray:
    """HU (44, 36, 34) of 6 mm RAS+ voxels: a body with two unequal lungs, and a bright ball at the patient's right."""
    x, y, z = np.meshgrid(*[np.arange(n) - (n - 1) / 2 for n in (44, 36, 34)], indexing="ij")
    hu = np.where((x / 20) ** 2 + (y / 15) ** 2 < 1, 40, -1000)
    hu[((x - 9) / 7) ** 2 + ((y - 1) / 9) ** 2 + ((z - 2) / 12) ** 2 < 1] = -850
    hu[((x + 9) / 6) ** 2 + ((y - 1) / 9) ** 2 + ((z - 2) / 11) ** 2 < 1] = -840
    hu[(x - 14) ** 2 + (y + 8) ** 2 + (z + 9) ** 2 < 6] = 900
    return hu.astype(np.int16)


def large_thorax_hu() -> np.ndarray:
    """HU (54, 46, 50) of 6 mm RAS+ voxels: a body with two lungs, and a ball at LIVER below the right lung."""
    x, y, z = np.meshgrid(*[np.arange(n) - (n - 1) / 2 for n in (54, 46, 50)], indexing="ij")
    hu = np.where((x / 25) ** 2 + (y / 18) ** 2 < 1, 40.0, -1000.0)
    hu[((abs(x) - 11) / 8) ** 2 + ((y - 2) / 11) ** 2 + ((z - 6) / 14) ** 2 < 1] = -850
    world = np.stack([x + 26.5, y + 22.5, z + 24.5], -1) * 6 + AFFINE[:3, 3]
    hu[((world - LIVER) ** 2).sum(-1) < 20**2] = 900
    return hu.astype(np.int16)


def save_ct(path: Path, data: np.ndarray, affine: np.ndarray = AFFINE) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    nibabel.save(nibabel.Nifti1Image(data, affine), path)
    return path


def rejected(folder: Path, out: Path, **settings) -> list[str]:
    """The reasons of all CTs of a folder, which must all be rejected, leaving nothing but the summary."""
    rows = prepare_folder(folder, out, Settings(voxels=32, **settings))
    assert {row["status"] for row in rows} == {"rejected"} and [p.name for p in out.iterdir()] == [SUMMARY]
    assert [row["reason"] for row in csv.DictReader((out / SUMMARY).open())] == [row["reason"] for row in rows]
    return [row["reason"] for row in rows]
