"""On what voxels a CT's X-rays are made, its volume is reconstructed and this is scored, and the way between them."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from nibabel.orientations import apply_orientation, inv_ornt_aff, io_orientation, ornt_transform
from torch import Tensor

from phydict.datasets.case import Case, lacking
from phydict.datasets.cts.resampling import to_grid
from phydict.grid import Grid
from phydict.inference.protocols import Protocol
from phydict.methods import DEFAULT_GRID
from phydict.reconstruction import Reconstruction
from phydict.units import AIR, HUWindow
from phydict.xray.boxes import along, covers, in_other_voxels


@dataclass(frozen=True)
class Voxels:
    """Those of a test or a comparison.

    own: the method's; box: those that were chosen for the result, if any; protocol: the one that it is taken by, which
    may have voxels of its own.
    """

    own: Grid
    box: Grid | None = None
    protocol: Protocol | None = None

    @property
    def _fixed(self) -> Grid | None:
        return self.protocol.grid if self.protocol else None

    @property
    def made(self) -> Grid:
        """Those of the CT that X-rays are made of."""
        return self._fixed or (whole(self.box) if self.box else self.own)

    @property
    def result(self) -> Grid:
        """Those that are reconstructed."""
        return self.box or self.own

    @property
    def scored(self) -> Grid:
        """Those that volumes are scored on, which are stacked as metrics take them."""
        return self._fixed or in_ras(self.result)

    def window(self, own: HUWindow) -> HUWindow:
        """The HU range that the CT is clipped to, where the method has one of its own."""
        return (self.protocol and self.protocol.hu) or own

    def as_scored(self, case: Case, window: HUWindow) -> Case:
        """A CT case, which is on the voxels `made`, on those that are scored."""
        if self.scored.same_as(self.made):
            return case
        return lacking(case, "features", "clip_latent", "segmented") | cut_out(case, self.made, self.scored, window)


def in_ras(grid: Grid) -> Grid:
    """The same voxels, stacked towards right, anterior and superior."""
    turn = io_orientation(grid.affine)
    if np.array_equal(turn, [[0, 1], [1, 1], [2, 1]]):
        return grid
    x, y, z = (grid.shape[axis] for axis in turn[:, 0].argsort())
    return Grid((x, y, z), affine=grid.affine @ inv_ornt_aff(turn, grid.shape))


def resampled(volume: Tensor, grid: Grid, onto: Grid, outside: float = AIR) -> Tensor:
    """A volume (X, Y, Z) in HU on `grid` by voxel averages on another one, itself where that has the same voxels in
    another order; outside: what lies outside, air."""
    if grid.same_as(onto):
        return volume
    if in_ras(grid).same_as(in_ras(onto)):
        turn = ornt_transform(io_orientation(grid.affine), io_orientation(onto.affine))
        return torch.from_numpy(np.ascontiguousarray(apply_orientation(volume.cpu().numpy(), turn)))
    return torch.from_numpy(to_grid(volume.cpu().numpy(), grid.affine, onto, outside).astype(np.float32))


def whole(grid: Grid) -> Grid:
    """The voxels of the CT that X-rays are made of: those of the result where they hold the whole chest, centred, else
    those of the chest, as long as the result's or half again."""
    if along(grid, DEFAULT_GRID) and covers(grid, DEFAULT_GRID) and np.allclose(grid.centre, 0):
        return grid
    halvings = max(0, math.ceil(math.log2(DEFAULT_GRID.spacing[0] / min(grid.spacing)) - 0.1))
    return Grid.cube(DEFAULT_GRID.shape[0] * 2 ** min(halvings, 2))


def cut_out(case: Case, grid: Grid, box: Grid, window: HUWindow) -> Case:
    """What a CT case on `grid` holds in a box: volume, from its finest, masks and, where it has one, affine."""
    source = case["volume"] if in_ras(grid).same_as(box) else case.get("fine", case["volume"])
    volume = resampled(window.to_hu(source)[0].cpu(), in_other_voxels(grid, source.shape[1:]), box)
    masks = torch.stack([resampled(mask.cpu(), grid, box, 0.0) for mask in case["masks"]])
    cut: Case = {"volume": window.to_range(volume)[None], "masks": masks}
    if "affine" in case:
        cut["affine"] = torch.from_numpy(placed(box, grid, case["affine"].numpy()).affine.copy())
    return cut


def placed(grid: Grid, like: Grid, affine: np.ndarray) -> Grid:
    """A grid after the movement that gave the grid `like` this affine."""
    if grid.same_as(like):
        return Grid(grid.shape, affine=affine)
    return Grid(grid.shape, affine=affine @ np.linalg.inv(like.affine) @ grid.affine)


def in_its_ct(result: Reconstruction, case: Case, grid: Grid, window: HUWindow) -> tuple[Reconstruction, Tensor]:
    """A result of a CT case on `grid` in its place in the CT that it came from, where that is known, and the truth, HU
    (X, Y, Z), on its voxels."""
    truth = resampled(window.to_hu(case["volume"])[0].cpu(), grid, result.grid)
    return (_moved(result, grid, case["affine"].numpy()) if "affine" in case else result), truth


def _moved(result: Reconstruction, like: Grid, affine: np.ndarray) -> Reconstruction:
    """A result, with what it carries and its coarse one, after the movement that gave `like` this affine."""
    carried = result.carried and replace(result.carried, grid=placed(result.carried.grid, like, affine))
    return replace(result, grid=placed(result.grid, like, affine), carried=carried,
                   coarse=result.coarse and _moved(result.coarse, like, affine))
