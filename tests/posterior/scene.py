"""A small scene that several modules reconstruct."""

from __future__ import annotations

import torch

from phydict.grid import Grid
from phydict.xray import ConeBeam, Projector

BEAM = ConeBeam.orbit(4, 1020, 740, (14, 14), 40.0)
GRID = Grid.cube(16)
PROJECTOR = Projector(GRID, BEAM)


def views(seed: int = 0) -> torch.Tensor:
    """Line integrals of an ellipse of soft tissue with a random hollow."""
    mu = torch.zeros(1, 1, *GRID.shape)
    mu[:, :, 3:13, 4:12] = 0.02
    low = 4 + seed % 4
    mu[:, :, low:low + 4, 6:10, 5:11] = 0.005
    return PROJECTOR(mu)[0]
