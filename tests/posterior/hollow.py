"""X-rays of a block of soft tissue with a hollow from three views, also of finer voxels."""

from __future__ import annotations

import torch
from scenes import WINDOW, block

from phydict.grid import Grid
from phydict.posterior import Measurement
from phydict.xray import ConeBeam, Projector
from phydict.xray.finer import FinerProjector

GRID = Grid.cube(16)
ORBIT = ConeBeam.orbit(3, 1020, 740, (28, 28), 20.0)


def measured(beam: ConeBeam = ORBIT, dtype: torch.dtype = torch.float32, noise: float = 0.0) -> Measurement:
    projector = Projector(GRID, beam, full_detector=True)
    y = projector(WINDOW.to_mu(block().double()))
    y = y + noise * y.max() * torch.randn(y.shape, generator=torch.Generator().manual_seed(0), dtype=y.dtype)
    return Measurement(projector, y[0].to(dtype), WINDOW)


def fine_scene(noise: float) -> tuple[Measurement, torch.Tensor]:
    """X-rays of voxels half as long as the grid's, each drawn on its own within the block, and the grid's means."""
    fine = torch.nn.functional.interpolate(block(), scale_factor=2)
    grain = 0.6 * torch.randn(fine.shape, generator=torch.Generator().manual_seed(1)) * (fine > -0.5)
    fine = (fine + grain).clamp(-1, 1)
    projector = Projector(GRID, ORBIT, full_detector=True)
    y = FinerProjector(projector)(WINDOW.to_mu(fine))
    y = y + noise * y.max() * torch.randn(y.shape, generator=torch.Generator().manual_seed(0))
    return Measurement(projector, y[0], WINDOW, noise=noise), torch.nn.functional.avg_pool3d(fine, 2)
