"""A prepared CT on disk: a folder `<id>` of NIfTI files that hold the same voxels, and what is known of them.

    ct.nii.gz                                    HU, int16, not windowed; cal_min and cal_max hold the HU window
    lung, airway, vessel, body .nii.gz           share of each voxel, in [0, 1]; where they are known
    case.json                                    space, box, window, report, source and the row of the summary

In the space `patient` the voxels form a cube along the patient's RAS+ axes. In the space `medsyn` the arrays have
MedSyn's axes (inferior to superior, posterior to anterior, right to left) and cover its atlas box; the headers lead
back to the patient's world, case.json's atlas_affine to atlas millimetres, centred on 0.
"""

from __future__ import annotations

import json
import reprlib
from pathlib import Path

import numpy as np
import torch

from phydict.datasets.case import Case
from phydict.datasets.cts.anatomy import MASKS
from phydict.datasets.cts.reading import load_ct
from phydict.datasets.cts.resampling import moved_to, to_grid
from phydict.grid import Grid
from phydict.runtime.reading import read_text, reading
from phydict.runtime.warning import warn
from phydict.units import AIR, HUWindow

RECORD, VOLUME = "case.json", "ct.nii.gz"
MEDSYN_AXES = np.array([[0, 0, -1, 0], [0, 1, 0, 0], [1, 0, 0, 0], [0, 0, 0, 1.0]])
"""RAS+ steps of MedSyn's array axes (S, A, L)."""


def write_prepared(folder: Path, grid: Grid, images: dict[str, np.ndarray], record: dict) -> None:
    """Writes the files of one case into `folder`: "ct" in HU and masks in [0, 1], each (X, Y, Z) on `grid`.

    record: holds at least "id", "space", "extent" (3,) mm of the box in the space, "window" (low, high), "report" and
    "row", of the summary, whose "masks" names those of the images.
    """
    import nibabel

    affine, medsyn = grid.affine, record["space"] == "medsyn"
    if medsyn:
        affine = affine @ _medsyn_index(grid.shape)
        atlas = Grid(grid.shape, tuple(np.asarray(record["extent"]) / grid.shape)).affine @ _medsyn_index(grid.shape)
        record = record | {"atlas_affine": atlas.tolist()}
    for name, image in images.items():
        image = np.ascontiguousarray(image[::-1].transpose(2, 1, 0)) if medsyn else image
        if name == "ct":
            nifti = nibabel.Nifti1Image(_integers(image).clip(-32768, 32767).astype(np.int16), affine)
            nifti.header["cal_min"], nifti.header["cal_max"] = record["window"]
        else:
            nifti = nibabel.Nifti1Image(_integers(255 * image.clip(0, 1)).astype(np.float32) / 255, affine)
            nifti.set_data_dtype(np.uint8)
        nifti.header.set_xyzt_units("mm", "sec")
        nifti.set_sform(affine, code="scanner")
        nifti.set_qform(affine, code="scanner")
        nibabel.save(nifti, folder / (VOLUME if name == "ct" else f"{name}.nii.gz"))
    (folder / RECORD).write_text(json.dumps(record, indent=1))


def _integers(image: np.ndarray) -> np.ndarray:
    """The nearest integers; a half that averaging left a rounding error beside is a half."""
    return np.rint(image.round(2))


def _medsyn_index(shape) -> np.ndarray:
    """4x4, from an index of MedSyn's array to the index (X, Y, Z) of the same voxel in RAS+ order."""
    affine = MEDSYN_AXES.copy()
    affine[0, 3] = shape[0] - 1
    return affine


def is_prepared(path: Path) -> bool:
    """Whether a NIfTI file belongs to a prepared case."""
    return (path.parent / RECORD).is_file()


def read_record(path: Path) -> dict:
    """What case.json says of the prepared case whose folder holds `path`. Raises ValueError where it is damaged."""
    file = path.parent / RECORD
    with reading(file, "remove its folder and prepare that CT again"):
        record = json.loads(read_text(file))
        if not isinstance(record, dict):
            raise ValueError(f"it is damaged: it holds {reprlib.repr(record)}")
        for name, kind in (("id", str), ("space", str), ("extent", list), ("window", list), ("report", str),
                           ("row", dict)):
            if not isinstance(record[name], kind):
                raise ValueError(f"it is damaged: {name} is {reprlib.repr(record[name])}")
        if np.asarray(record["extent"], float).shape != (3,) or np.asarray(record["window"], float).shape != (2,):
            raise ValueError("it is damaged: extent and window are three and two numbers")
        return record


def read_prepared(path: Path, grid: Grid, window: HUWindow) -> Case:
    """The Case of the prepared volume `path` on `grid`, as `prepare_ct` would give it.

    Where the grid's box is the case's own and divides its voxels, nothing is resampled: the voxels are taken as they
    are, or averaged in blocks. A smaller box or another coarser spacing is cut from a cube in the patient's space.
    Warns of what was remarkable when it was prepared.
    Raises ValueError for a grid that is larger or finer than the prepared case, or of another space.
    """
    record = read_record(path)
    if remark := record["row"].get("remark"):
        warn(f"{record['id']} was prepared with the remark: {remark}")
    hu, affine = load_ct(path)
    files = [path.parent / f"{name}.nii.gz" for name in MASKS]
    known = np.array([file.is_file() for file in files])
    masks = [load_ct(file)[0] if here else None for file, here in zip(files, known)]
    factors = np.array(hu.shape) // grid.shape
    if np.allclose(record["extent"], grid.extent, atol=1e-3) and (factors * grid.shape == hu.shape).all():
        placed = affine @ np.diag([*factors, 1.0])
        placed[:3, 3] = affine[:3, :3] @ ((factors - 1) / 2) + affine[:3, 3]

        def sampled(image, pad):
            return _block_means(image, factors)
    else:
        stored = Grid(hu.shape, affine=affine)
        _check_room(record, stored, grid)
        target = moved_to(grid, stored.centre)
        placed = target.affine.copy()

        def sampled(image, pad):
            return to_grid(image, affine, target, pad)

    stacked = np.stack([np.zeros(grid.shape) if mask is None else sampled(mask, 0.0).clip(0, 1) for mask in masks])
    volume = window.to_range(sampled(hu, AIR))
    return {"id": record["id"], "volume": torch.from_numpy(volume.astype(np.float32))[None],
            "masks": torch.from_numpy(stacked.astype(np.float32)), "has_masks": torch.from_numpy(known),
            "report": record["report"], "affine": torch.from_numpy(placed), "centred_on": "lungs"}


def _check_room(record: dict, stored: Grid, grid: Grid) -> None:
    name, box = record["id"], " x ".join(f"{n:g}" for n in record["extent"])
    wanted = " x ".join(f"{n:g}" for n in grid.extent)
    if record["space"] != "patient":
        raise ValueError(f"{name} was prepared in MedSyn's space, a box of {box} mm, but the prior's box is {wanted} "
                         f"mm with {grid.shape[0]} voxels; prepare that CT again with --space patient")
    if (grid.extent > stored.extent + 1e-3).any():
        raise ValueError(f"{name} was prepared as a box of {box} mm, but {wanted} mm are needed; "
                         f"prepare that CT again with --side {grid.extent.max():g}")
    if (np.asarray(grid.spacing) < np.asarray(stored.spacing) * (1 - 1e-6)).any():
        raise ValueError(f"{name} was prepared with voxels of {stored.spacing[0]:g} mm, but {grid.spacing[0]:g} mm are "
                         f"needed; prepare that CT again with --voxels {round(stored.extent[0] / grid.spacing[0])}")


def _block_means(image: np.ndarray, factors: np.ndarray) -> np.ndarray:
    a, b, c = factors
    x, y, z = np.array(image.shape) // factors
    return image.reshape(x, a, y, b, z, c).mean((1, 3, 5))
