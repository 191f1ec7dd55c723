"""What X-rays hold that a grid's voxels cannot."""

from __future__ import annotations

from torch import Tensor
from torch.nn.functional import avg_pool3d, interpolate

from phydict.posterior.likelihood.likelihood import LikelihoodStep
from phydict.posterior.measurement import Measurement
from phydict.xray.finer import FinerProjector

FACTOR = 2


def subgrid_projection(measurement: Measurement, x: Tensor, step: LikelihoodStep, x0_std: float) -> Tensor:
    """Line integrals (1, K, V, U) that voxels half as long have beyond those of their means over the grid's.

    A CT x (1, 1, X, Y, Z) is interpolated onto the finer voxels and there met with the X-rays by `step`, to which
    x0_std is the standard deviation of its error. Added to a measurement, as its `subgrid`, they take from the X-rays
    what no volume on the grid explains: the defect correction of Stetter 1978 (doi:10.1007/BF01432879), with a guess
    of the finer volume.
    """
    fine = measurement.on(FinerProjector(measurement.projector, FACTOR))
    projection = beyond_means(
        measurement, fine, step(fine, interpolate(x, scale_factor=FACTOR, mode="trilinear"), x0_std))
    measurement.calls += fine.calls
    return projection


def beyond_means(measurement: Measurement, fine: Measurement, z: Tensor) -> Tensor:
    """Line integrals (1, K, V, U) that a CT z (1, 1, X, Y, Z) on the voxels of `fine`, a FinerProjector's, has beyond
    those of its means over the voxels of `measurement`."""
    measurement.subgrid = 0.0
    return fine.project(z) - measurement.project(avg_pool3d(z, z.shape[2] // measurement.projector.grid.shape[0]))
