"""X-rays that are blind to what small moves of their views could explain."""

from __future__ import annotations

import torch
from torch import Tensor

from phydict.posterior.measurement import Measurement


class BlindMeasurement(Measurement):
    """A measurement of which the changes that a view's unknowns make are marginalised.

    With unknowns e ~ N(0, 1) per view, e0 where they are now, and y = P(x) + C (e - e0) + noise, what is left of the
    data term once e is at its best is |F (y + C e0 - P(x))|^2 with F^2 = I - C (C'C + noise^2)^-1 C' per view (variable
    projection, Golub & Pereyra 1973, doi:10.1137/0710036). F is symmetric.
    """

    def __init__(self, plain: Measurement, changes: Tensor, now: Tensor, noise: float):
        """plain: the measurement at the current poses; changes (K, M, V, U): C, in the unit of y; now (K, M): e0."""
        self.__dict__.update(plain.__dict__)
        columns = changes.flatten(2).transpose(1, 2) / noise  # (K, V U, M)
        self.basis, sizes, _ = torch.linalg.svd(columns, full_matrices=False)
        self.shrinks = 1 - 1 / (1 + sizes**2).sqrt()
        self.y = self.filtered(plain.y + torch.einsum("km,kmvu->kvu", now, changes))

    def filtered(self, views: Tensor) -> Tensor:
        """F of views (B, K, V, U)."""
        flat = views.flatten(2)
        parts = torch.einsum("kpm,bkp->bkm", self.basis, flat) * self.shrinks
        return views - torch.einsum("kpm,bkm->bkp", self.basis, parts).view_as(views)

    def project(self, x: Tensor) -> Tensor:
        return self.filtered(super().project(x))

    def linear(self, d: Tensor) -> Tensor:
        return self.filtered(super().linear(d))

    def adjoint(self, r: Tensor) -> Tensor:
        return super().adjoint(self.filtered(r))
