"""Two stages as one prior of fine CTs: a base prior and the super-resolution stage that refines its samples."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from phydict.prior.prior import Prior
from phydict.prior.super_resolution import SuperResolution


@dataclass(frozen=True)
class Cascade:
    """A base prior and a super-resolution stage for the same cube and HU window, such as 64^3 and 256^3.

    Raises ValueError where the stages do not fit: cube, window, factor, or channels.
    """

    base: Prior
    super_resolution: SuperResolution

    def __post_init__(self):
        base, fine = self.base, self.super_resolution
        if not np.allclose(base.grid.extent, fine.grid.extent) or not np.allclose(base.grid.centre, fine.grid.centre):
            raise ValueError(f"the base prior's cube has sides of {_mm(base)} mm and the super-resolution stage's of "
                             f"{_mm(fine)} mm, or another centre: use stages trained with the same model.cube.side")
        if base.window != fine.window:
            raise ValueError(f"the base prior's HU window is [{base.window.low:g}, {base.window.high:g}] and the "
                             f"super-resolution stage's [{fine.window.low:g}, {fine.window.high:g}]: use stages "
                             "trained with the same model.window")
        if tuple(fine.factor * n for n in base.grid.shape) != fine.grid.shape:
            raise ValueError(f"the super-resolution stage makes {fine.grid.shape} voxels from a factor {fine.factor} "
                             f"less, but the base prior has {base.grid.shape}: use stages of "
                             "matching model.cube.voxels")
        if base.state_channels < fine.coarse_channels:
            raise ValueError(f"the super-resolution stage needs {fine.coarse_channels} channels of the base prior, "
                             f"which has {base.state_channels}")


def _mm(stage: Prior | SuperResolution) -> str:
    return " x ".join(f"{side:g}" for side in stage.grid.extent)
