"""What is too dense for a volume and is carried beside it, on voxels of its own."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from torch import Tensor
from torch.nn.functional import avg_pool2d

from phydict.grid import Grid
from phydict.units import MU_WATER
from phydict.xray.boxes import divided, interpolated, part
from phydict.xray.projectors.projector import Projector

RAYS = 2
"""Rays along each side of a pixel, whose mean it measures: what is dense has sharp edges."""


@dataclass(frozen=True)
class Carried:
    """HU `extra` (X, Y, Z) on `grid` that a volume on other voxels along the same axes lacks; mu_water: 1/mm."""

    extra: Tensor
    grid: Grid
    mu_water: float = MU_WATER

    def projection(self, projector: Projector) -> Tensor:
        """Its line integrals (K, V, U) along a projector's rays."""
        beam = replace(projector.beam.divided(RAYS), continued=False)
        rays = Projector(self.grid, beam, device=self.extra.device, full_detector=True)
        return self.mu_water / 1000 * avg_pool2d(rays(self.extra[None, None]), RAYS)[0]

    def on(self, grid: Grid) -> Tensor:
        """The HU (X, Y, Z) that it adds to a volume on `grid`."""
        return interpolated(self.extra, self.grid, grid, 0.0)

    @property
    def centre(self) -> np.ndarray:
        """Its centre of mass (3,) in mm."""
        index = self.extra.nonzero()
        weights = self.extra[tuple(index.T)][:, None]
        mean = ((weights * index).sum(0) / weights.sum()).double().cpu().numpy()
        return self.grid.affine[:3, :3] @ mean + self.grid.affine[:3, 3]

    @property
    def density(self) -> float:
        """HU by which it is denser than what surrounds it, if it had one density and its voxels were full or empty."""
        return float(self.extra.square().sum() / self.extra.sum())

    @property
    def millilitres(self) -> float:
        """Its volume at that density."""
        return float(self.extra.sum()) / self.density * math.prod(self.grid.spacing) / 1000

    def record(self) -> dict:
        """As plain JSON values."""
        return {"millilitres": self.millilitres, "density_hu": self.density, "centre_mm": self.centre.tolist()}


def mean_carried(found: Sequence[Carried | None], grid: Grid) -> Carried:
    """The mean of what is carried, by one at least, beside each of several volumes on `grid`, on parts of the voxels of
    which RAYS^3 make one of the grid's."""
    whole = divided(grid, RAYS)
    placed = [(carried, np.rint(whole.index(carried.grid.affine[:3, 3])).astype(int)) for carried in found if carried]
    low = np.min([first for _, first in placed], 0)
    high = np.max([first + carried.grid.shape for carried, first in placed], 0)
    extra = placed[0][0].extra.new_zeros(*(high - low))
    for carried, first in placed:
        extra[tuple(slice(i, i + n) for i, n in zip(first - low, carried.grid.shape))] += carried.extra / len(found)
    return replace(placed[0][0], extra=extra, grid=part(whole, [slice(i, j) for i, j in zip(low, high)]))
