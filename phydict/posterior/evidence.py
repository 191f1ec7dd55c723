"""What the X-rays say of each voxel, as channels that a network can see."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from phydict.posterior.measurement import Measurement
from phydict.prior.evidence_channels import CHANGE_SCALE, COVERAGE_SCALE, RESIDUAL_SCALE
from phydict.xray import Projector
from phydict.xray.binning import pixel_sides


class Evidence:
    """Channels (1, 5, X, Y, Z) of a measurement at an estimate z (1, 1, X, Y, Z) of the CT, in the prior's range.

    0: the residual's back-projection, one SIRT step C A' R (y - P(z)), R = 1 / A 1 and C = 1 / A' 1 (Gilbert 1972,
    doi:10.1016/0022-5193(72)90180-4); 1: the coverage log2(1 + n), n the number of views that see a voxel; 2: what the
    X-rays changed of the estimate before; 3: how the start of the reconstruction differs from z; 4: the noise of the
    X-rays, log10 of its share of their largest value, plus 2, as they are at first or at the last `measure_noise`.
    The order of the views does not matter. A' 1 is computed once.
    """

    def __init__(self, measurement: Measurement):
        projector = measurement.projector
        rays = measurement.background / measurement.offset
        backprojection = projector.T(torch.ones_like(measurement.y))
        measurement.calls += 1
        self.measurement = measurement
        self.rows = torch.where(rays > 1e-3 * rays.max(), 1 / rays.clamp(min=1e-12), 0)
        self.columns = torch.where(backprojection > 1e-3 * backprojection.max(), 1 / backprojection.clamp(min=1e-12), 0)
        self.coverage = COVERAGE_SCALE * torch.log2(1 + views_seen(projector, backprojection))
        self.measure_noise()

    def measure_noise(self) -> None:
        """From now on the noise is that of the X-rays as they are now, such as after a refit."""
        level = self.measurement.noise_variance.mean().sqrt() / self.measurement.y.max().clamp(min=1e-6)
        self.noise = torch.full_like(self.columns, float(level.clamp(1e-4, 1).log10()) + 2)

    def __call__(self, z: Tensor, before: Tensor, start: Tensor) -> Tensor:
        """The channels at the estimate z; before: the estimate that the X-rays changed into z; start: the first z."""
        measurement = self.measurement
        residual = self.rows * (measurement.y - measurement.project(z)) / measurement.slope
        back_projected = self.columns * measurement.projector.T(residual)
        measurement.calls += 1
        return torch.cat([RESIDUAL_SCALE * back_projected, self.coverage, CHANGE_SCALE * (z - before),
                          CHANGE_SCALE * (start - z), self.noise], 1)


def views_seen(projector: Projector, seen: Tensor) -> Tensor:
    """How many views see each voxel, of A' 1: a view that sees the grid's centre gives it the volume of a voxel over
    the area of a pixel there."""
    each = float(np.prod(projector.grid.spacing) / pixel_sides(projector.grid, projector.beam).prod(1).mean())
    return (seen / each).clamp(0, projector.beam.views)
