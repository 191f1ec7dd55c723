"""A volume whose last axis is not the one that runs upwards."""

from __future__ import annotations

from typing import Any

import numpy as np
from torch import Tensor

from phydict.grid import Grid
from phydict.xray.geometry import ConeBeam


class InOtherOrder:
    """The projection, and its adjoint, of a volume (B, X, Y, Z) by the operator of the grid with `axis` put last."""

    def __init__(self, operator: Any, axis: int):
        self.operator, self.axis = operator, axis + 1

    def forward(self, mu: Tensor) -> Tensor:
        return self.operator.forward(mu.movedim(self.axis, -1).contiguous())

    def adjoint(self, xrays: Tensor) -> Tensor:
        return self.operator.adjoint(xrays).movedim(-1, self.axis).contiguous()


def axis_upwards(grid: Grid, beam: ConeBeam) -> int:
    """The axis of a grid along which the detectors stand upright or, of tilted ones and of a patient who continues
    above and below, that runs nearest to the superior direction; the third where others are no nearer."""
    upwards = np.abs(grid.affine[2, :3]) / grid.spacing
    superior = int(upwards.argmax()) if upwards.max() > upwards[2] + 1e-6 else 2
    if beam.continued:  # detectors whose rows run up the patient stand upright along another axis
        return superior
    return next((axis for axis in (2, 0, 1) if beam.is_upright(put_last(grid, axis))), superior)


def put_last(grid: Grid, axis: int) -> Grid:
    """The same voxels with one axis put last."""
    order = [other for other in range(3) if other != axis] + [axis]
    affine = grid.affine.copy()
    affine[:3, :3] = affine[:3, order]
    x, y, z = (grid.shape[other] for other in order)
    return Grid((x, y, z), affine=affine)
