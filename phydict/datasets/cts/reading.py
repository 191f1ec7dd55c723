"""A CT of a file or of arrays as HU and an affine, and what is refused or doubtful of it."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from phydict.datasets.itk_file import ENDINGS, open_itk, read_itk
from phydict.datasets.nifti_file import NIFTI, open_nifti
from phydict.grid import index_to_mm
from phydict.runtime.reading import name_of, reading
from phydict.runtime.warning import warn
from phydict.units import AIR

PADDING = AIR - 100
"""HU from which downwards voxels are no noisy air, but padding outside the scanner's circular field."""
SMALLEST_VOXEL, LARGEST_VOXEL, FURTHEST = 0.02, 100.0, 1e6
"""mm between which every voxel's side lies, and that no CT's distance from its origin reaches."""
LEAST_SLICES = 8
"""Fewer are a scout or a test image, from which no lungs can be found."""


@dataclass(frozen=True)
class Calibration:
    """What the blank header of a CT-RATE v1 volume lacks, from its metadata table.

    slope, intercept: HU = slope * stored + intercept. spacing: (columns, rows, slices) mm.
    orientation: DICOM's row and column direction cosines; the stored axes are columns, rows, slices.
    """

    slope: float
    intercept: float
    spacing: tuple[float, float, float]
    orientation: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0)

    def affine(self) -> np.ndarray:
        """4x4 index -> RAS+ mm, origin at voxel (0, 0, 0)."""
        columns, rows = np.asarray(self.orientation[:3], float), np.asarray(self.orientation[3:], float)
        affine = np.eye(4)
        affine[:3, :3] = np.diag([-1.0, -1.0, 1.0]) @ np.stack([columns, rows, np.cross(columns, rows)], 1)
        affine[:3, :3] *= self.spacing
        return affine


def load_ct(path: str | Path, calibration: Calibration | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Read a CT, NIfTI or a MetaImage or NRRD file (phydict.datasets.itk_file), and turn its axes to RAS+.

    calibration: for files without a usable header (CT-RATE v1) HU scale and spacing come from it instead.
    Returns HU (X, Y, Z) float32 and the 4x4 index -> world mm affine.
    Raises FileNotFoundError, and ValueError naming the file where it cannot be read, is not one 3D volume, has
    fewer than LEAST_SLICES slices, no orientation, or holds NaN or infinite values.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"there is no CT file {path}; give a .nii or .nii.gz file that exists")
    hu, affine = _load_itk(path) if path.suffix.lower() in ENDINGS else _load_nifti(path, calibration)
    if calibration is not None:
        hu, affine = hu * np.float32(calibration.slope) + np.float32(calibration.intercept), calibration.affine()
    hu, affine = to_ras(hu, affine)
    _check_finite(path, hu)
    return hu, affine


def _load_nifti(path: Path, calibration: Calibration | None) -> tuple[np.ndarray, np.ndarray]:
    with reading(path, "convert it to NIfTI, or download it, again"):
        image = open_nifti(path)
    _check_header(path, image.header, calibration)
    with reading(f"the voxels of {path}", "the file seems truncated or damaged: download or convert it again"):
        stored = np.asanyarray(image.dataobj)
        return np.array(stored, np.float32).reshape(stored.shape[:3]), np.array(image.affine)


def _load_itk(path: Path) -> tuple[np.ndarray, np.ndarray]:
    with reading(path, "convert it to NIfTI, or download it, again"):
        stored, affine = read_itk(path)
    _check_shape(path, stored.shape)
    check_affine(path, affine, "convert it from DICOM again")
    return np.array(stored, np.float32), affine


def to_ras(volume: np.ndarray, affine: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A volume (X, Y, Z) with its axes permuted and flipped to RAS+, without interpolation; and its new affine."""
    from monai.data import MetaTensor
    from monai.transforms import Orientationd

    image = MetaTensor(torch.from_numpy(np.ascontiguousarray(volume, np.float32))[None], affine=torch.as_tensor(affine))
    turned: dict = Orientationd("ct", axcodes="RAS", labels=None)({"ct": image})
    return turned["ct"].as_tensor()[0].numpy(), turned["ct"].affine.numpy().astype(float)


def check_header(path: Path) -> None:
    """Raises ValueError where the header of a file, which alone is read, is not that of a CT: of one 3D volume with
    LEAST_SLICES or more."""
    with reading(path, "convert it again, or list it in data.source.exclude"):
        itk = path.suffix.lower() in ENDINGS
        shape = open_itk(path).GetSize() if itk else _volume_shape(open_nifti(path).header)
    try:
        _check_shape(path, shape)
    except ValueError as error:
        raise ValueError(f"{error}, or list it in data.source.exclude") from None


def _volume_shape(header) -> tuple[int, ...]:
    """The shape in a header, less further axes of one volume."""
    shape = header.get_data_shape()
    while len(shape) > 3 and shape[-1] == 1:
        shape = shape[:-1]
    return shape


def _check_header(path: Path, header, calibration: Calibration | None) -> None:
    shape = _volume_shape(header)
    _check_shape(path, shape)
    if calibration is not None:
        return check_affine(path, calibration.affine(), "correct it in the metadata table")
    codes = [int(header[name]) for name in ("sform_code", "qform_code") if name in header]
    if not any(codes):
        raise ValueError(f"{path} does not say how the patient lies (neither sform nor qform is set); convert it from "
                         "DICOM again, or read CT-RATE v1 files with data.source.fixed false and their metadata table")
    affine = header.get_best_affine()
    axes = affine[:3, :3]
    check_affine(path, affine, "convert it from DICOM again")
    if len(codes) == 2 and all(codes):
        _warn_of_other_axes(path, header)
    sides, said = np.linalg.norm(axes, axis=0), np.asarray(header.get_zooms()[:3], float)
    if codes[0] and not np.allclose(sides, said, rtol=0.01):
        warn(f"{path} has voxels of {_lengths(sides)} mm by its sform, and of {_lengths(said)} mm by its pixdim: the "
             "sform is used, and scales the patient if the pixdim is right; convert it from DICOM again, or correct "
             "the wrong one")
    if np.allclose(axes, np.eye(3)) and shape[0] >= 512:
        warn(f"{path} has the blank header of CT-RATE v1 (1 mm voxels, identity axes); "
             "read such files with data.source.fixed false and their metadata table")


def _lengths(sides) -> str:
    return " x ".join(f"{side:g}" for side in sides)


def _warn_of_other_axes(path: Path, header) -> None:
    """Warns where a header places the voxels twice, and by other axes; a qform that cannot be read is passed over."""
    from nibabel.orientations import aff2axcodes

    with suppress(ValueError):
        sform, qform = ("".join(map(str, aff2axcodes(place))) for place in (header.get_sform(), header.get_qform()))
        if sform == qform:
            return
        warn(f"{path} says by its sform that its axes are {sform}, and by its qform {qform}: the sform is used, and "
             "mirrors or turns the patient if the qform is right; convert it from DICOM again, or remove the wrong one")


def _check_shape(name: str | Path, shape: tuple[int, ...]) -> None:
    if len(shape) != 3:
        raise ValueError(f"{name} is {len(shape)}D with shape {tuple(shape)}; give one 3D volume per file")
    if min(shape) < 2:
        raise ValueError(f"{name} is a single 2D slice with shape {tuple(shape)}; give a 3D volume")
    if min(shape) < LEAST_SLICES:
        raise ValueError(f"{name} has {min(shape)} slices (its shape is {tuple(shape)}), but a chest CT has at least "
                         f"{LEAST_SLICES}; give the whole series")


def check_affine(name: str | Path, affine: np.ndarray, advice: str) -> None:
    """Raises ValueError unless a 4x4 affine gives voxels a volume, and sides and a place as a CT's."""
    axes = affine[:3, :3]
    longest = np.abs(axes).max(axis=0)
    if not (np.isfinite(axes).all() and longest.all() and abs(np.linalg.det(axes / longest)) > 1e-6):
        raise ValueError(f"{name} has voxels without volume (affine {axes.tolist()}); {advice}")
    sides = np.linalg.norm(axes, axis=0)
    if not ((np.abs(affine[:3]) < FURTHEST).all() and SMALLEST_VOXEL <= sides.min() <= sides.max() <= LARGEST_VOXEL):
        raise ValueError(f"{name} has voxels of {_lengths(sides)} mm, or lies at "
                         f"{affine[:3, 3].tolist()} mm, which no CT does; {advice}")


def _check_finite(name: str | Path, hu: np.ndarray) -> None:
    bad = hu.size - int(np.isfinite(hu).sum())
    if bad:
        raise ValueError(f"{name} holds {bad} NaN or infinite voxels; replace them, by -1000 HU where there is no data")


def given_ct(ct: tuple, name: str) -> tuple[np.ndarray, np.ndarray]:
    """HU (X, Y, Z) float32 and the 4x4 affine of arrays or tensors. Raises ValueError as `load_ct` does of a file."""
    if [np.ndim(part) for part in ct] != [3, 2]:
        raise ValueError("a CT is a file, or HU (X, Y, Z) and the 4x4 affine that says where they are")
    hu, affine = (np.asarray(part.detach().cpu().double() if isinstance(part, torch.Tensor) else part) for part in ct)
    if hu.dtype.kind not in "iuf":
        raise ValueError(f"{name} holds voxels of type {hu.dtype}; give integers or floating-point numbers")
    _check_shape(name, hu.shape)
    affine = index_to_mm(f"the affine of {name}", affine)
    check_affine(name, affine, "give an affine that leads from voxel indices to mm")
    _check_finite(name, hu)
    return hu.astype(np.float32, copy=False), affine


def check_hu(hu: np.ndarray, name: str) -> None:
    """Warn where air is not near -1000 or hardly any tissue is left: the numbers are then hardly HU.

    Padding is one number: where most of what lies below PADDING has others, and is more than what lies above it, air's
    noise included, it is neither padding nor noise.
    """
    sample = hu[::3, ::3, ::3]
    low = sample[sample < -300]
    tissue, gas = float((sample > -200).mean()), float((low > PADDING).sum() / sample.size)
    below = low[low <= PADDING]
    varied = below.size - int(np.unique(np.rint(below), return_counts=True)[1].max(initial=0))
    counts, edges = np.histogram(low.clip(AIR), bins=35, range=(AIR, -300))
    mode = edges[counts.argmax()] + 10
    if gas < 0.01 or mode > -900:
        air = f"only {100 * gas:.1f} % of it lies between {PADDING:g} and -300" if gas < 0.01 else \
            f"the most frequent value below -300 is {mode:.0f}"
        warn(f"{name} does not look like HU: {air}, but air should lie near -1000; check slope, intercept "
             "and whether `fixed` (data.source.fixed) is right")
    elif varied > max(below.size / 2, gas * sample.size):
        warn(f"{name} does not look like HU: {100 * below.size / sample.size:.1f} % of it lies below {PADDING:g}, and "
             "not at one number, as padding does; check slope and intercept, HU may have been scaled twice")
    elif tissue < 0.01:
        warn(f"{name} does not look like HU: only {100 * tissue:.1f} % of it lies above -200; it may have "
             "been rescaled twice, check whether `fixed` (data.source.fixed) is right")


def case_id(path: str | Path) -> str:
    """A file's name without .nii, .nii.gz or one of the ENDINGS of MetaImage and NRRD."""
    name = name_of(path)
    for ending in (*NIFTI, *ENDINGS):
        if name.lower().endswith(ending):
            return name[: -len(ending)]
    return name
