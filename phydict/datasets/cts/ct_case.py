"""From a CT to a Case: the box around the lungs, resampled, in the HU window."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from phydict.datasets.case import Case
from phydict.datasets.cts.anatomy import lung_box_centre, segment
from phydict.datasets.cts.reading import Calibration, case_id, check_hu, given_ct, load_ct
from phydict.datasets.cts.resampling import covering_grid, moved_to, to_grid
from phydict.grid import Grid
from phydict.runtime.warning import warn
from phydict.units import AIR, HUWindow

SEGMENTATION_MM = 2.0


def prepare_ct(ct: str | Path | tuple[np.ndarray, np.ndarray], grid: Grid = Grid.cube(64),
               window: HUWindow = HUWindow(), id: str | None = None,
               calibration: Calibration | None = None) -> Case:
    """A Case from a CT file, or from (hu, affine): the grid's box centred on the lungs, -1000 HU outside the scan.

    Returns {"id", "volume" (1,X,Y,Z) in [-1,1], "masks" (3,X,Y,Z) in [0,1] for lung, airway, vessel, "has_masks" (3,),
    "report", which is empty, "affine" (4,4) float64: the voxels' place in the CT's own world, "centred_on": "lungs" or
    "volume"}.
    Without lungs the box is centred on the scan, with a warning. Raises what `load_ct` raises.
    """
    name = id or ("the CT" if isinstance(ct, tuple) else case_id(ct))
    hu, affine = given_ct(ct, name) if isinstance(ct, tuple) else load_ct(ct, calibration)
    check_hu(hu, name)
    hu = hu.clip(AIR)
    work = covering_grid(hu.shape, affine, SEGMENTATION_MM)
    masks, known = segment(to_grid(hu, affine, work, AIR), work.spacing)
    if known[0]:
        centre = lung_box_centre(masks[0], work.affine)
    else:
        centre = affine[:3, :3] @ ((np.asarray(hu.shape) - 1) / 2) + affine[:3, 3]
        size = " x ".join(f"{length:.0f}" for length in np.linalg.norm(affine[:3, :3], axis=0) * hu.shape)
        warn(f"no lungs were found in {name}, a scan of {size} mm; its volume is centred on the scan and its masks are "
             "unknown; it may be no chest, or its numbers no HU")
    target = moved_to(grid, centre)
    volume = window.to_range(to_grid(hu, affine, target, AIR))
    masks = np.stack([to_grid(m, work.affine, target, 0.0) for m in masks]).clip(0, 1)
    return {"id": name, "volume": torch.from_numpy(volume.astype(np.float32))[None],
            "masks": torch.from_numpy(masks.astype(np.float32)), "has_masks": torch.from_numpy(known),
            "report": "", "affine": torch.from_numpy(target.affine.copy()),
            "centred_on": "lungs" if known[0] else "volume"}
