"""What a network that knows coarse voxels finds of an estimate on finer ones."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import avg_pool3d, interpolate

from phydict.grid import Grid
from phydict.posterior.discretisation import beyond_means, has_finer
from phydict.posterior.evidence import Evidence
from phydict.posterior.measurement import Measurement
from phydict.posterior.posterior import Posterior
from phydict.prior import BoundRefiner, Refiner
from phydict.reconstruction import Reconstruction
from phydict.runtime.profiling import stage
from phydict.xray import Projector
from phydict.xray.boxes import divided
from phydict.xray.finer import FinerProjector

TIME = 0.15
"""The label under which the network takes an estimate that the X-rays were met with: the last of Unrolled's."""


class CoarseCorrection:
    """A refiner's next call, at an estimate on finer voxels than its own.

    The refiner sees the estimate's means over its voxels, and evidence from which what finer voxels explain of the
    X-rays is taken: the coarse-grid correction of the full approximation scheme (Brandt 1977,
    doi:10.1090/S0025-5718-1977-0431719-X), with a network where that solves. What it changes of the means is
    interpolated and added.

    refiner: bound to a report. measurement: the X-rays on the refiner's voxels. state: its last (1, C, X, Y, Z).
    factor: how many times finer the estimates are, 2 or more. calls: of the network.
    """

    def __init__(self, refiner: BoundRefiner, measurement: Measurement, state: Tensor, factor: int):
        self.refiner, self.measurement, self.factor, self.calls = refiner, measurement, factor, 0
        self.start, self.state = state[:, :1], state
        self.fine, self.evidence = measurement.on(FinerProjector(measurement.projector, factor)), Evidence(measurement)

    @property
    def projector_calls(self) -> int:
        """How many times A or its adjoint ran over all views, on coarse and on finer voxels."""
        return self.measurement.calls + self.fine.calls

    def __call__(self, z: Tensor) -> Tensor:
        """The corrected estimate of z (1, 1, X, Y, Z), in the prior's range."""
        measurement, before = self.measurement, self.state[:, :1]
        means = avg_pool3d(z, self.factor)
        measurement.subgrid = beyond_means(measurement, self.fine, z)
        measurement.refit(means)
        self.evidence.measure_noise()
        evidence = self.evidence(means, before, self.start)
        signal = float(self.refiner.schedule.scales(TIME)[0])
        with stage("network"):
            answer = self.refiner.refine(signal * torch.cat([means, self.state[:, 1:]], 1), TIME, evidence)
        self.state, self.calls = answer.clamp(-1, 1), self.calls + 1
        change = interpolate(self.state[:, :1] - means, scale_factor=self.factor, mode="trilinear")
        return (z + change).clamp(-1, 1)


def _factor(grid: Grid, level: Grid) -> int:
    """How many of a level's voxels make one of the grid's along each axis; 0 where they do not."""
    factor = round(level.shape[0] / grid.shape[0])
    fits = factor > 0 and level.same_as(divided(grid, factor))
    return factor if fits else 0


def coarse_correction(base: object, level: Grid, seen: tuple[Tensor, Projector], found: Reconstruction,
                      report: str, display: bool) -> CoarseCorrection | None:
    """The correction of estimates on a level's voxels by the network of `base`, which found the reconstruction `found`
    of the X-rays that it has `seen`.

    seen: the X-rays and their projector. None where `base` uses no refiner or left the X-rays to another method, where
    one of its voxels is not a whole number, two or more, of the level's along each axis, and where detectors are
    tilted, for which finer voxels cost too much.
    """
    xrays, projector = seen
    if not (isinstance(base, Posterior) and isinstance(base.prior, Refiner)) or _factor(base.grid, level) < 2:
        return None
    if not has_finer(projector) or found.masks is None or len(found.masks) + 1 != base.prior.state_channels:
        return None
    measurement = Measurement(projector, xrays, base.window, display, base.mu_water, told=True)
    measurement.adopt(found)
    state = torch.cat([base.window.to_range(found.within)[None], 2 * found.masks - 1])[None].to(xrays)
    refiner = base.prior.bind(report, base.guidance, base.precision)
    return CoarseCorrection(refiner, measurement, state, _factor(base.grid, level))
