"""Masks by other segmenters: their files beside a CT, and lungmask where it is installed.

Beside a CT `name.nii.gz`, or beside a DICOM series' folder `name`, these are read (where the folder holds several
series, `name__<SeriesNumber>`); they must lie on the CT's own voxels:

    name_lungmask.nii.gz       lungmask's labels (doi:10.1186/s41747-020-00173-2): every label above 0 is lung
    name_totalsegmentator/     TotalSegmentator's folder (doi:10.1148/ryai.230024), one file per structure:
        lung_{upper,lower}_lobe_{left,right}.nii.gz, lung_middle_lobe_right.nii.gz      lungs
        lung_trachea_bronchia.nii.gz, else trachea.nii.gz                               airway
        lung_vessels.nii.gz                                                             vessels
        body.nii.gz                                                                     body
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np

from phydict.datasets.cts.anatomy import MASKS
from phydict.datasets.cts.prepared import is_prepared
from phydict.datasets.cts.reading import Calibration, case_id, load_ct
from phydict.datasets.cts.resampling import to_grid
from phydict.grid import Grid

LUNGMASK, TOTALSEGMENTATOR = "_lungmask", "_totalsegmentator"
LOBES = ("lung_upper_lobe_left", "lung_lower_lobe_left", "lung_upper_lobe_right", "lung_middle_lobe_right",
         "lung_lower_lobe_right")


def is_segmentation(path: Path) -> bool:
    """Whether a NIfTI file is, by its name or folder, one of those that lie beside a CT."""
    return path.name.lower().endswith((f"{LUNGMASK}.nii.gz", f"{LUNGMASK}.nii")) \
        or path.parent.name.endswith(TOTALSEGMENTATOR)


def segmentations_beside(ct: Path) -> dict[str, tuple[Path, ...]]:
    """The files beside `ct` (its path without ending) by what they show: lung, airway, vessel, body; often none.

    Raises ValueError where some of the lungs' lobes are missing.
    """
    folder = ct.with_name(ct.name + TOTALSEGMENTATOR)
    named = [ct.with_name(f"{ct.name}{LUNGMASK}{ending}") for ending in (".nii.gz", ".nii")]
    lungmask = tuple(path for path in named if path.is_file())[:1]
    lobes = tuple(path for path in (folder / f"{lobe}.nii.gz" for lobe in LOBES) if path.is_file())
    if not lungmask and 0 < len(lobes) < len(LOBES):
        raise ValueError(f"{folder} holds {len(lobes)} of the {len(LOBES)} lobes of the lungs; segment all of them "
                         "(roi_subset), or remove these")
    beside = {"lung": lungmask or lobes}
    for name, files in (("airway", ("lung_trachea_bronchia", "trachea")), ("vessel", ("lung_vessels",)),
                        ("body", ("body",))):
        beside[name] = tuple(path for path in (folder / f"{file}.nii.gz" for file in files) if path.is_file())[:1]
    return {name: files for name, files in beside.items() if files}


def mask_files(ct: Path) -> list[Path]:
    """The files that masks of a NIfTI CT are read from, those beside it or a prepared one's own; often none, and none
    where some of the lungs' lobes are missing."""
    if is_prepared(ct):
        return [file for name in MASKS if (file := ct.with_name(f"{name}.nii.gz")).is_file()]
    with suppress(ValueError):
        return [file for files in segmentations_beside(ct.with_name(case_id(ct))).values() for file in files]
    return []


def read_segmentation(files: tuple[Path, ...], shape, affine: np.ndarray, calibration: Calibration | None = None
                      ) -> np.ndarray:
    """The union of label files as a mask (X, Y, Z) bool on the voxels of a CT of `shape` with its 4x4 affine.

    calibration: of a CT without a usable header; it places the files' voxels, which are the CT's, as well.
    Raises ValueError where a file cannot be read or does not lie on these voxels.
    """
    union, placed = np.zeros(shape, bool), calibration and replace(calibration, slope=1.0, intercept=0.0)
    for file in files:
        labels, place = load_ct(file, placed)
        if labels.shape != tuple(shape) or not np.allclose(place, affine, atol=0.01):
            raise ValueError(f"{file} does not lie on its CT's voxels ({labels.shape} instead of {tuple(shape)}, or "
                             "another place); segment this CT again, or remove that file")
        union |= labels > 0.5
    return union


def organs_beside(ct: Path, grid: Grid, calibration: Calibration | None = None) -> dict[str, np.ndarray]:
    """Masks (X, Y, Z) bool of what is segmented beside a NIfTI CT, lung and vessel, on `grid` in the CT's own world.

    calibration: as `read_segmentation` takes it. Of a prepared CT the lung alone, since its voxels' shares of vessels
    lose the thin ones. Raises ValueError as `read_segmentation` and where some of the lungs' lobes are missing.
    """
    if is_prepared(ct):
        file = ct.with_name("lung.nii.gz")
        return {"lung": to_grid(*load_ct(file), grid, 0.0) > 0.5} if file.is_file() else {}
    beside = segmentations_beside(ct.with_name(case_id(ct)))
    organs = {name: beside[name] for name in ("lung", "vessel") if name in beside}
    if not organs:
        return {}
    hu, affine = load_ct(ct, calibration)
    return {name: to_grid(read_segmentation(files, hu.shape, affine, calibration).astype(np.float32), affine, grid, 0.0)
            > 0.5 for name, files in organs.items()}


def lungs_by_lungmask(hu: np.ndarray) -> np.ndarray:
    """The lungs (X, Y, Z) bool of HU (X, Y, Z) in RAS+ by lungmask's R231, which fetches its weights at first use.

    Raises ValueError where lungmask is not installed.
    """
    try:
        from lungmask import LMInferer
    except ImportError as error:
        raise ValueError("the segmenter lungmask is not installed; pip install 'phydict[lungmask]', or use the "
                         "threshold segmenter") from error
    labels = LMInferer(tqdm_disable=True).apply(np.ascontiguousarray(hu[::-1, ::-1].transpose(2, 1, 0)))  # as S, P, L
    return np.asarray(labels).transpose(2, 1, 0)[::-1, ::-1] > 0
