"""The files that a finished case leaves beside its record."""

from __future__ import annotations

from pathlib import Path

from torch import Tensor

from phydict.datasets.case import Case
from phydict.datasets.radiographs.xray_description import save_geometry
from phydict.evaluation import panel
from phydict.evaluation.fid import Features, save_features
from phydict.inference.results import FEATURES
from phydict.page import write_case_files
from phydict.reconstruction import Reconstruction

VOLUME = "volume.nii.gz"

SHOWN_LEVEL = 0.9
"""The level of the intervals that are written and shown."""

TISSUE = -500.0
"""HU above which a voxel is no air."""


def write_result(folder: Path, case: Case, result: Reconstruction, method: str, truth: Tensor | None,
                 keep_coarse: bool, features: Features | None = None) -> None:
    """Writes volumes, panel, what the page shows of a case and the features of its slices; truth: HU (X, Y, Z) on the
    result's voxels."""
    result.save_nifti(folder / VOLUME)
    if result.beam is not None:
        save_geometry(folder / "geometry_found.yaml", result.beam, case.get("description"))
    if result.deviation is not None:
        result.save_nifti(folder / "deviation.nii.gz", result.deviation)
    if keep_coarse and result.coarse is not None:
        result.coarse.save_nifti(folder / "coarse.nii.gz")
    if result.intervals:
        result.save_nifti(folder / f"interval_{SHOWN_LEVEL * 100:.0f}.nii.gz", result.intervals[SHOWN_LEVEL])
    label, uncertain = _uncertain(result)
    panel(folder / "panel.png", result.volume, result.grid, result.xrays, result.reprojection, truth,
          title=f"{case['id']}: {method}", deviation_hu=uncertain, deviation_label=label)
    write_page_files(folder, result, truth)
    if features:
        save_features(folder / FEATURES, features)


def write_page_files(folder: Path, result: Reconstruction, truth: Tensor | None) -> None:
    """Writes what the page shows of a result; truth: HU (X, Y, Z) on the result's voxels."""
    label, uncertain = _uncertain(result)
    volumes = {"reconstruction": result.volume, "truth": truth, label: uncertain}
    write_case_files(folder, result.grid, {k: v for k, v in volumes.items() if v is not None}, result.xrays,
                     result.reprojection)


def _uncertain(result: Reconstruction) -> tuple[str, Tensor | None]:
    """How uncertain each voxel is, HU (X, Y, Z), and what that is called; None where it is not known."""
    if result.intervals:
        return f"half of the {SHOWN_LEVEL:.0%} interval", result.intervals[SHOWN_LEVEL]
    return "standard deviation", result.deviation


def body_interval(result: Reconstruction) -> float | None:
    """Half the interval's width in HU, mean over tissue and lungs; None where the method knows none."""
    if not result.intervals:
        return None
    lung = result.masks[0] > 0.5 if result.masks is not None and len(result.masks) else False
    inside = (result.volume > TISSUE) | lung
    return float(result.intervals[SHOWN_LEVEL][inside].mean()) if inside.any() else None
