"""Simulated observations: what a detector would read of a known volume."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch

from phydict.xray.projector import Projector


@dataclass(frozen=True)
class Ideal:
    """Monoenergetic X-rays without scatter: the projector's line integrals, with noise.

    noise: standard deviation of added Gaussian noise, as a fraction of the case's largest line integral; 0 = none.
    photons: photons per pixel that leave the source, None for no counting noise. A pixel with line integral p reads
        -log(max(Poisson(photons exp(-p)), 0.5) / photons).

    Reconstructing with the projector that made the X-rays is an inverse crime: the model error of a real
    measurement is missing. To lessen it, simulate on a finer grid or with the other method.
    """

    noise: float = 0.005
    photons: float | None = None

    def __post_init__(self):
        if not self.noise >= 0:
            raise ValueError(f"noise is a fraction >= 0 of the largest line integral, but {self.noise} was given")
        if self.photons is not None and not self.photons > 0:
            raise ValueError(f"photons per pixel must be > 0, or None for no counting noise; {self.photons} was given")

    def __call__(self, projector: Projector, mu: torch.Tensor, seed: int | Sequence[int] = 0) -> torch.Tensor:
        """X-rays (B, K, V, U) of mu (B, 1, X, Y, Z) in 1/mm.

        seed: one per case, or a single int for a single case. A case's noise depends on its own seed alone, not on
        the rest of the batch or the device. Raises ValueError when their number is wrong.
        """
        seeds = [seed] if isinstance(seed, int) else list(seed)
        if len(seeds) != len(mu):
            raise ValueError(f"{len(mu)} cases need one seed each, but {len(seeds)} were given; pass a list of ints")
        with torch.no_grad():
            xrays = projector(mu)
            return torch.stack([self._measure(case, int(s)) for case, s in zip(xrays, seeds)])

    def _measure(self, integrals: torch.Tensor, seed: int) -> torch.Tensor:
        generator = torch.Generator().manual_seed(seed)
        y = integrals.double().cpu()
        largest = y.max()
        if self.photons is not None:
            counts = torch.poisson(self.photons * torch.exp(-y), generator=generator)
            y = -torch.log(counts.clamp_min(0.5) / self.photons)
        if self.noise > 0:
            y = y + self.noise * largest * torch.randn(y.shape, generator=generator, dtype=y.dtype)
        return y.to(integrals)
