"""CT series as DICOM files, one slice each: found in folders of any depth, checked, and stacked to a volume.

The slices are sorted by their position along the normal of the image plane (DICOM PS3.3 C.7.6.2). What would not make
an honest volume is refused with its reason: another modality, slices missing, twice or of mixed spacing, a tilted
gantry, values without a rescale to HU.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pydicom
from pydicom.errors import InvalidDicomError

from phydict.datasets.cts.reading import LEAST_SLICES, check_affine, to_ras
from phydict.datasets.dicom import Frame, open_dicom, read_dicom
from phydict.datasets.natural_order import natural_order
from phydict.datasets.nifti_file import NIFTI
from phydict.runtime.files import files_below
from phydict.runtime.reading import reading
from phydict.units import AIR

NEEDED = {"Rows": 1, "Columns": 1, "ImagePositionPatient": 3, "ImageOrientationPatient": 6, "PixelSpacing": 2,
          "RescaleSlope": 1, "RescaleIntercept": 1}
"""Tags of every slice, and how many numbers each holds."""
SAME = ("Rows", "Columns", "PixelSpacing", "ImageOrientationPatient")
SAME_PLACE_MM, SPACING_TOLERANCE, TILT_DEGREES = 0.01, 0.05, 0.5


@dataclass(frozen=True)
class Series:
    """The files of one DICOM series. folder: that of the first file; number: SeriesNumber, "" where it has none."""

    folder: Path
    number: str
    files: tuple[Path, ...]


def find_series(root: Path) -> list[Series]:
    """Every DICOM series below the folder `root`, of any modality, in natural order; other files are passed over."""
    groups = defaultdict(list)
    for path in files_below(root):
        if path.name.lower().endswith(NIFTI) or path.name.upper() == "DICOMDIR":
            continue
        try:
            header = open_dicom(path, stop_before_pixels=True, specific_tags=["SeriesInstanceUID", "SeriesNumber"])
            number = header.get("SeriesNumber")
            uid = str(header.get("SeriesInstanceUID") or path.parent)
        except InvalidDicomError:
            continue
        except Exception:  # whatever a damaged file leads pydicom to: load_series says what
            groups[str(path)].append((path, ""))
            continue
        groups[uid].append((path, "" if number is None else str(number)))
    every = [Series(group[0][0].parent, group[0][1], tuple(path for path, _ in group)) for group in groups.values()]
    return sorted(every, key=lambda series: natural_order(f"{series.folder}/{series.number}"))


def load_series(series: Series) -> tuple[np.ndarray, np.ndarray]:
    """HU (X, Y, Z) float32 in RAS+ and the 4x4 index -> world mm affine of a CT series.

    Raises ValueError with the reason where the series is no CT, cannot be read, or is not a stack of evenly spaced
    slices at right angles to their plane.
    """
    headers = {path: _header(path) for path in series.files}
    modalities = sorted({str(header.get("Modality", "unknown")) for header in headers.values()})
    if modalities != ["CT"]:
        raise ValueError(f"its modality is {', '.join(modalities)}, not CT; only CT series can be prepared")
    headers = {path: header for path, header in headers.items() if "LOCALIZER" not in str(header.get("ImageType"))}
    if not headers:
        raise ValueError("it holds only localizer (scout) images; give the series of slices")
    if any((Frame(header, path.name).number("NumberOfFrames") or 1) > 1 for path, header in headers.items()):
        raise ValueError("it is stored as multi-frame (enhanced) CT; convert it to NIfTI and prepare that")
    if len(headers) < LEAST_SLICES:
        raise ValueError(f"it has {len(headers)} slices, but a chest CT has at least {LEAST_SLICES}; "
                         "give the whole series")
    paths, affine = _stack({path: _geometry(path, header) for path, header in headers.items()})
    volume = np.stack([read_dicom(path, AIR)[0][0].T.astype(np.float32) for path in paths], axis=2)
    return to_ras(volume, affine)


def _header(path: Path) -> pydicom.Dataset:
    with reading(f"the DICOM file {path}", "export it again"):
        header = open_dicom(path, stop_before_pixels=True)
        for keyword in ("Modality", "ImageType"):
            header.get(keyword)  # which is decoded only now
        return header


def _geometry(path: Path, header: pydicom.Dataset) -> dict[str, np.ndarray]:
    """The numbers of the tags NEEDED of one slice. Raises ValueError."""
    frame = Frame(header, path.name)
    tags = {keyword: frame.numbers(keyword, count) or () for keyword, count in NEEDED.items()}
    if missing := [keyword for keyword, numbers in tags.items() if not numbers]:
        raise ValueError(f"{path.name} lacks {', '.join(missing)}; export the series again")
    if min(tags["PixelSpacing"]) <= 0:
        raise ValueError(f"PixelSpacing of {path.name} must be positive, but {list(tags['PixelSpacing'])} mm was "
                         "found; export the series again")
    return {keyword: np.array(numbers) for keyword, numbers in tags.items()}


def _stack(slices: dict[Path, dict[str, np.ndarray]]) -> tuple[list[Path], np.ndarray]:
    """The paths from slice to slice, and the affine (columns, rows, slices) -> RAS+ mm."""
    first_path, first = next(iter(slices.items()))
    for path, tags in slices.items():
        for keyword in SAME:
            if not np.allclose(tags[keyword], first[keyword], atol=1e-3):
                raise ValueError(f"{keyword} changes within the series, from {first[keyword].tolist()} in "
                                 f"{first_path.name} to {tags[keyword].tolist()} in {path.name}; separate these slices")
    across, down = first["ImageOrientationPatient"].reshape(2, 3)
    if abs(across @ down) > 1e-3 or not np.allclose([across @ across, down @ down], 1, atol=1e-2):
        raise ValueError(f"ImageOrientationPatient {first['ImageOrientationPatient'].tolist()} is not two directions "
                         "at right angles; export the series again")
    normal = np.cross(across, down)
    positions = np.array([tags["ImagePositionPatient"] for tags in slices.values()])
    order = np.argsort(positions @ normal, kind="stable")
    paths, positions = [list(slices)[k] for k in order], positions[order]
    _check_spacing(paths, positions, normal)
    step = (positions[-1] - positions[0]) / (len(positions) - 1)
    row_mm, column_mm = first["PixelSpacing"]
    affine = np.eye(4)
    affine[:3] = np.diag([-1.0, -1.0, 1.0]) @ np.stack([across * column_mm, down * row_mm, step, positions[0]], axis=1)
    check_affine("it", affine, "correct PixelSpacing and ImagePositionPatient, or export the series again")
    return paths, affine


def _check_spacing(paths: list[Path], positions: np.ndarray, normal: np.ndarray) -> None:
    along = positions @ normal
    steps = np.diff(along)
    usual = float(np.median(steps))
    twice = np.flatnonzero(steps < SAME_PLACE_MM)
    if len(twice):
        k = int(twice[0])
        raise ValueError(f"{len(twice)} slices lie where another one does, the first two are {paths[k].name} and "
                         f"{paths[k + 1].name} at {along[k]:g} mm; keep one of each")
    gaps = np.flatnonzero(steps > (2 - 2 * SPACING_TOLERANCE) * usual)
    uneven = np.abs(steps - usual) > SPACING_TOLERANCE * usual
    if len(gaps) and np.allclose(steps[uneven] / usual, np.rint(steps[uneven] / usual), atol=2 * SPACING_TOLERANCE):
        k = int(gaps[0])
        missing = int(np.rint(steps[uneven] / usual - 1).sum())
        raise ValueError(f"{missing} of its slices {'is' if missing == 1 else 'are'} missing, the first between "
                         f"{paths[k].name} and {paths[k + 1].name} ({along[k]:g} and {along[k + 1]:g} mm, "
                         f"but the usual step is {usual:g} mm); export the whole series")
    if uneven.any():
        raise ValueError(f"its slices are unevenly spaced, from {steps.min():g} to {steps.max():g} mm; "
                         "prepare a reconstruction with one spacing")
    shift = positions - positions[0] - np.outer(along - along[0], normal)
    tilt = np.degrees(np.arctan2(np.linalg.norm(shift, axis=1).max(), along[-1] - along[0]))
    if tilt > TILT_DEGREES:
        raise ValueError(f"its gantry was tilted by {tilt:.1f} degrees, so its slices are shifted against each "
                         "other; correct the tilt when converting it to NIfTI, and prepare that")
