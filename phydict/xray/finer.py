"""What a detector measures of finer voxels than a grid's."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate

from phydict.linalg.power_iteration import operator_norm
from phydict.xray.boxes import divided
from phydict.xray.projectors.projector import Projector


class FinerProjector(Projector):
    """A projector's X-rays of the same box in voxels `factor` times finer.

    Attenuation (B, 1, X, Y, Z) in 1/mm on `grid` -> mean line integrals (B, K, V, U) of factor^2 rays in each pixel.
    T is the exact adjoint.
    """

    def __init__(self, projector: Projector, factor: int = 2):
        self.beam, self.factor, self.device = projector.beam, factor, getattr(projector, "device", torch.device("cpu"))
        self.grid = divided(projector.grid, factor)
        self._rays = Projector(self.grid, projector.beam.divided(factor), device=self.device, full_detector=True)
        self.method, self.reason = self._rays.method, self._rays.reason

    def __call__(self, mu: Tensor) -> Tensor:
        return avg_pool2d(self._rays(mu), self.factor)

    def T(self, xrays: Tensor) -> Tensor:
        return self._rays.T(interpolate(xrays, scale_factor=self.factor) / self.factor**2)

    def norm(self) -> float:
        return operator_norm(self, self.T, torch.ones(1, 1, *self.grid.shape))
