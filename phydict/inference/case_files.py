"""The files that a finished case leaves beside its record."""

from __future__ import annotations

from pathlib import Path

import nibabel
import numpy as np
from torch import Tensor

from phydict.datasets.case import Case
from phydict.datasets.radiographs.xray_description import save_geometry
from phydict.evaluation import panel
from phydict.evaluation.fid import Features, save_features
from phydict.grid import Grid
from phydict.inference.results import COARSE, FEATURES
from phydict.page import CASE_FILES, write_case_files
from phydict.reconstruction import Reconstruction
from phydict.xray import ConeBeam

VOLUME = "volume.nii.gz"

SHOWN_LEVEL = 0.9
"""The level of the intervals that are written and shown."""

INTERVAL, DEVIATION = f"interval_{SHOWN_LEVEL * 100:.0f}.nii.gz", "deviation.nii.gz"

UNCERTAIN = {INTERVAL: f"half of the {SHOWN_LEVEL:.0%} interval", DEVIATION: "standard deviation"}
"""What says how uncertain each voxel is, the first that is there: its file, and what it is called."""

TISSUE = -500.0
"""HU above which a voxel is no air."""


def write_result(folder: Path, case: Case, result: Reconstruction, method: str, truth: Tensor | None,
                 keep_coarse: bool, features: Features | None) -> None:
    """Writes volumes, panel, what the page shows of a case and the features of its slices; truth: HU (X, Y, Z) on the
    result's voxels."""
    result.save_nifti(folder / VOLUME)
    if result.beam is not None:
        save_geometry(folder / "geometry_found.yaml", result.beam, case.get("description"))
    if result.deviation is not None:
        result.save_nifti(folder / DEVIATION, result.deviation)
    if keep_coarse and result.coarse is not None:
        result.coarse.save_nifti(folder / COARSE)
    if SHOWN_LEVEL in result.intervals:
        result.save_nifti(folder / INTERVAL, result.intervals[SHOWN_LEVEL])
    label, uncertain = _uncertain(result)
    beam = result.beam or case.get("beam")
    panel(folder / "panel.png", result.volume, result.grid, result.xrays, result.reprojection, truth,
          title=f"{case['id']}: {method}", deviation_hu=uncertain, deviation_label=label, pixel=_pixel(beam))
    write_page_files(folder, result, truth, beam)
    if features:
        save_features(folder / FEATURES, features)


def write_page_files(folder: Path, result: Reconstruction, truth: Tensor | None, beam: ConeBeam | None = None) -> None:
    """Writes what the page shows of a result; truth: HU (X, Y, Z) on the result's voxels; beam: that of its X-rays,
    whose pixels are square without it."""
    label, uncertain = _uncertain(result)
    volumes = {"reconstruction": result.volume, "truth": truth, label: uncertain}
    write_case_files(folder, result.grid, {k: v for k, v in volumes.items() if v is not None}, result.xrays,
                     result.reprojection, pixel=_pixel(beam))


def _pixel(beam: ConeBeam | None) -> float:
    """The height of a beam's pixels over their width, the mean of its views; 1 without a beam."""
    return 1.0 if beam is None else float((beam.pixel[:, 0] / beam.pixel[:, 1]).mean())


def missing_page_files(folder: Path) -> list[str]:
    """What the page shows of a case and is not in its folder."""
    return [name for name in CASE_FILES if not (folder / name).is_file()]


def remake_page_files(folder: Path) -> None:
    """Writes what the page shows of a case and its folder lacks, of the NIfTI files there: without truth and X-rays."""
    if not (missing := missing_page_files(folder)):
        return
    image: nibabel.Nifti1Image = nibabel.load(folder / VOLUME)  # type: ignore[assignment]
    volumes = {"reconstruction": np.asarray(image.dataobj)}
    if uncertain := next((name for name in UNCERTAIN if (folder / name).is_file()), None):
        shown: nibabel.Nifti1Image = nibabel.load(folder / uncertain)  # type: ignore[assignment]
        volumes[UNCERTAIN[uncertain]] = np.asarray(shown.dataobj)
    write_case_files(folder, Grid(volumes["reconstruction"].shape, affine=image.affine), volumes, names=missing)


def _uncertain(result: Reconstruction) -> tuple[str, Tensor | None]:
    """How uncertain each voxel is, HU (X, Y, Z), and what that is called; None where it is not known."""
    if SHOWN_LEVEL in result.intervals:
        return UNCERTAIN[INTERVAL], result.intervals[SHOWN_LEVEL]
    return UNCERTAIN[DEVIATION], result.deviation


def body_interval(result: Reconstruction) -> float | None:
    """Half the interval's width in HU, mean over tissue and lungs; None where the method knows none of that level."""
    if SHOWN_LEVEL not in result.intervals:
        return None
    lung = result.masks[0] > 0.5 if result.masks is not None and len(result.masks) else False
    inside = (result.volume > TISSUE) | lung
    return float(result.intervals[SHOWN_LEVEL][inside].mean()) if inside.any() else None
