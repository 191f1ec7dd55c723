"""What is known of one patient."""

from __future__ import annotations

from pathlib import Path
from typing import TypedDict, cast

import numpy as np
from torch import Tensor

from phydict.datasets.cts.reading import Calibration
from phydict.datasets.radiographs.xray_description import Description
from phydict.xray.geometry import ConeBeam
from phydict.xray.poses.uncertain import Uncertain


class Case(TypedDict, total=False):
    """A CT, X-rays or both. Nobody fills all of it: `prepare_ct`, `phantom_case` and `load_xrays` say what they do."""

    id: str
    report: str
    # of a CT
    volume: Tensor  # (1, X, Y, Z) in [-1, 1] of an HU window
    masks: Tensor  # (3, X, Y, Z) in [0, 1]: lung, airway, vessel
    has_masks: Tensor  # (3,) bool: which of them are known
    affine: Tensor  # (4, 4) float64: the voxels' place in the CT's own world
    centred_on: str  # "lungs" or "volume"
    # of X-rays
    xrays: Tensor  # (K, V, U)
    beam: ConeBeam
    display: bool  # whether their gains and offsets are unknown
    uncertain: Uncertain | None
    description: Description
    # of inference
    index: int
    source: str  # what identifies its data
    warnings: list[str]
    error: ValueError | OSError  # why there is nothing else
    file: Path  # of the CT
    calibration: Calibration | None  # of its header, where that is not trusted
    fine: Tensor  # the volume that X-rays are made of, where that is finer
    mu_water: float  # 1/mm, in the X-rays
    ct_report: str  # the report, where `report` is what is used of it
    features: dict[str, Tensor]  # of the volume's slices
    clip_latent: Tensor  # of the volume
    segmented: dict[str, np.ndarray]  # organs beside the CT, (X, Y, Z) bool on `fine_grid`


def lacking(case: Case, *keys: str) -> Case:
    """A Case without these parts."""
    return cast(Case, {key: value for key, value in case.items() if key not in keys})
