"""Two stages as one prior of fine CTs: a base prior and the super-resolution stage that refines its samples."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from phydict.prior.contract import AnyPrior
from phydict.prior.medsyn.super_resolution import MedSynSuperResolution
from phydict.prior.super_resolution import SuperResolution
from phydict.xray.boxes import along


@dataclass(frozen=True)
class Cascade:
    """A base prior and a super-resolution stage for the same cube and HU window, such as 64^3 and 256^3.

    Raises ValueError where the stages do not fit: cube, axes, window, factor, or channels.
    """

    base: AnyPrior
    super_resolution: SuperResolution | MedSynSuperResolution

    def __post_init__(self):
        base, stage = self.base, self.super_resolution
        if not np.allclose(base.grid.extent, stage.grid.extent) or not np.allclose(base.grid.centre, stage.grid.centre):
            raise ValueError(f"the base prior's cube has sides of {_mm(base)} mm and the super-resolution stage's of "
                             f"{_mm(stage)} mm, or another centre: use stages trained with the same model.cube.side")
        if not along(base.grid, stage.grid):
            raise ValueError("the base prior's voxels are stacked in other directions than the super-resolution "
                             "stage's: use stages whose affines have axes of the same directions")
        if base.window != stage.window:
            raise ValueError(f"the base prior's HU window is [{base.window.low:g}, {base.window.high:g}] and the "
                             f"super-resolution stage's [{stage.window.low:g}, {stage.window.high:g}]: use stages "
                             "trained with the same model.window")
        if tuple(stage.factor * n for n in base.grid.shape) != stage.grid.shape:
            raise ValueError(f"the super-resolution stage makes {stage.grid.shape} voxels from a factor {stage.factor} "
                             f"less, but the base prior has {base.grid.shape}: use stages of "
                             "matching model.cube.voxels")
        if base.state_channels < stage.coarse_channels:
            raise ValueError(f"the super-resolution stage needs {stage.coarse_channels} channels of the base prior, "
                             f"which has {base.state_channels}")


def _mm(stage: AnyPrior | SuperResolution | MedSynSuperResolution) -> str:
    return " x ".join(f"{side:g}" for side in stage.grid.extent)
