"""The box of voxels that a prepared case is of, in the patient's own space or in MedSyn's.

The space `medsyn` approximates MedSyn's (10.1109/TMI.2024.3415032), which registers each patient's lungs to those of an
atlas by an affine map: here the box around the lungs is scaled along each axis and moved onto the atlas' box. Rotation
and shear of the registration are left out, and voxels are averages where MedSyn interpolates.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from phydict.datasets.cts.anatomy import lung_box_centre, lung_box_size
from phydict.datasets.cts.reading import load_ct
from phydict.datasets.cts.resampling import moved_to
from phydict.grid import Grid
from phydict.units import AIR

SPACES, SEGMENTERS = ("patient", "medsyn"), ("threshold", "lungmask")
LEAST_SIDE, MOST_SIDE = 10.0, 2000.0
"""mm along a cube around lungs that can be meant."""
ATLAS_MM = (316.0, 316.0, 292.0)
"""MedSyn's atlas volume, right-left, posterior-anterior and inferior-superior."""
ATLAS_LUNGS_MM = (275.0, 193.0, 256.0)
"""The box around the atlas' lungs, an assumption, because the atlas may not be shipped: the mean over seven uncut CTs
of LIDC-IDRI, placed in the middle of the atlas volume. `atlas_lungs` measures a copy of the atlas instead."""


@dataclass(frozen=True)
class Settings:
    """What a prepared case is to be.

    voxels: per side of the box. side: mm of the cube in the space `patient`. window: HU, recorded and not applied.
    space: patient or medsyn. segmenter: of CTs without a segmentation beside them, threshold or lungmask.
    atlas_lungs_mm, atlas_offset_mm: of MedSyn's atlas, the box around the lungs, and where its middle lies from the
    volume's middle.
    """

    voxels: int = 256
    side: float = 384.0
    window: tuple[float, float] = (-1000.0, 1000.0)
    space: str = "patient"
    segmenter: str = "threshold"
    atlas_lungs_mm: tuple[float, float, float] = ATLAS_LUNGS_MM
    atlas_offset_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self):
        if self.voxels < 8 or not LEAST_SIDE <= self.side <= MOST_SIDE:
            raise ValueError(f"a case needs at least 8 voxels and a side of {LEAST_SIDE:g} to {MOST_SIDE:g} mm, but "
                             f"{self.voxels} voxels and {self.side} mm were given")
        if not self.window[0] < self.window[1]:
            raise ValueError(f"an HU window needs low < high, but {list(self.window)} was given")
        for name, value, values in (("space", self.space, SPACES), ("segmenter", self.segmenter, SEGMENTERS)):
            if value not in values:
                raise ValueError(f"{name} is {' or '.join(values)}, but {value!r} was given")

    @property
    def extent(self) -> tuple[float, float, float]:
        """Edge lengths in mm of the box, in the space's own millimetres."""
        return (self.side,) * 3 if self.space == "patient" else ATLAS_MM

    @property
    def outside(self) -> float:
        """HU where there is no scan, and the least that is kept."""
        return min(AIR, self.window[0]) if self.space == "medsyn" else AIR

    def grid(self, lung_centre: np.ndarray, lung_mm: np.ndarray) -> Grid:
        """The voxels in the patient's world, for lungs in a box of `lung_mm` (3,) around `lung_centre` (3,)."""
        shape, extent = (self.voxels,) * 3, np.asarray(self.extent)
        if self.space == "patient":
            return moved_to(Grid(shape, tuple(extent / shape)), lung_centre)
        shrink = lung_mm / self.atlas_lungs_mm
        return moved_to(Grid(shape, tuple(extent * shrink / shape)), lung_centre - shrink * self.atlas_offset_mm)


def atlas_lungs(mask: Path) -> dict:
    """Settings' atlas_lungs_mm and atlas_offset_mm by a copy of MedSyn's atlas lung mask (NIfTI).

    Raises ValueError where it cannot be read, is empty or is not of the atlas' size.
    """
    lungs, affine = load_ct(mask)
    volume = Grid(lungs.shape, affine=affine)
    if not (lungs > 0.5).any() or not np.allclose(volume.extent, ATLAS_MM, atol=2):
        raise ValueError(f"{mask} is not MedSyn's atlas: a lung mask of {' x '.join(f'{n:g}' for n in ATLAS_MM)} mm "
                         f"was expected, but its box has {' x '.join(f'{n:g}' for n in volume.extent)} mm")
    offset = lung_box_centre(lungs, affine) - volume.centre
    return {"atlas_lungs_mm": tuple(lung_box_size(lungs, volume.spacing).tolist()),
            "atlas_offset_mm": tuple(offset.tolist())}
