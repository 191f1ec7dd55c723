"""A volume that goes on above and below its voxels, each column as its last voxel does."""

from __future__ import annotations

from typing import Any

from torch import Tensor
from torch.nn.functional import pad

from phydict.grid import Grid


class Continued:
    """The projection, and its adjoint, of a volume (B, X, Y, Z) whose first and last slices are repeated `slices` times
    beyond it, by the operator of the taller grid."""

    def __init__(self, operator: Any, slices: int):
        self.operator, self.slices = operator, slices

    def forward(self, mu: Tensor) -> Tensor:
        return self.operator.forward(pad(mu, (self.slices, self.slices, 0, 0, 0, 0), mode="replicate"))

    def adjoint(self, xrays: Tensor) -> Tensor:
        tall, n = self.operator.adjoint(xrays), self.slices
        back = tall[..., n:-n].clone()
        back[..., 0] += tall[..., :n].sum(-1)
        back[..., -1] += tall[..., -n:].sum(-1)
        return back


def with_slices(grid: Grid, slices: int) -> Grid:
    """A grid with `slices` more above and below it."""
    x, y, z = grid.shape
    affine = grid.affine.copy()
    affine[:3, 3] -= slices * affine[:3, 2]
    return Grid((x, y, z + 2 * slices), affine=affine)
