"""Simulated observations: what a detector would read of a known volume."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from numbers import Real

import torch

from phydict.units import MU_WATER
from phydict.xray.noise import normal, poisson
from phydict.xray.projectors.projector import Projector


class Simulator(ABC):
    """Makes X-rays of volumes. Implementations hold settings only and say how they may be reconstructed."""

    def __call__(self, projector: Projector, mu: torch.Tensor, seed: int | Sequence[int] = 0) -> torch.Tensor:
        """X-rays (B, K, V, U) of mu (B, 1, X, Y, Z), on its device.

        mu: attenuation in 1/mm on the scale on which water has units.MU_WATER, as units.hu_to_mu makes it of HU.
        seed: one per case, or a single int for a single case. A case's noise depends on its own seed alone, not on
        the rest of the batch or the device. Raises ValueError when their number is wrong.
        """
        seeds = list(seed) if isinstance(seed, Iterable) else [seed]
        if len(seeds) != len(mu):
            raise ValueError(f"{len(mu)} cases need one seed each, but {len(seeds)} were given; pass a list of ints")
        with torch.no_grad():
            return torch.stack([self._measure(projector, case, torch.Generator().manual_seed(int(s)))
                                for case, s in zip(mu, seeds)])

    @property
    @abstractmethod
    def effective_mu_water(self) -> float:
        """Attenuation of water in 1/mm with which a reconstruction of these X-rays comes out in HU."""

    @abstractmethod
    def _measure(self, projector: Projector, mu: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
        """X-rays (K, V, U) of one case mu (1, X, Y, Z), with random numbers from a generator on the CPU."""


@dataclass(frozen=True)
class Ideal(Simulator):
    """Monoenergetic X-rays without scatter: the projector's line integrals, with noise.

    Reconstructing with the projector that made the X-rays is an inverse crime: the model error of a real
    measurement is missing. To lessen it, simulate on a finer grid or with another method, or use Polychromatic.

    Args:
        noise: standard deviation of added Gaussian noise, as a fraction of the case's largest line integral; 0 = none
        photons: photons per pixel that leave the source, None for no counting noise; a pixel with line integral p reads
            -log(max(Poisson(photons exp(-p)), 0.5) / photons)
    """

    noise: float = 0.005
    photons: float | None = None

    def __post_init__(self):
        if not (isinstance(self.noise, Real) and 0 <= self.noise < math.inf):
            raise ValueError(f"noise is a fraction >= 0 of the largest line integral, but {self.noise!r} was given")
        check_photons(self.photons)

    @property
    def effective_mu_water(self) -> float:
        return MU_WATER

    def _measure(self, projector: Projector, mu: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
        integrals = projector(mu[None])[0]
        y = integrals.double()
        largest = y.max()
        if self.photons is not None:
            counts = poisson(self.photons * torch.exp(-y), generator)
            y = -torch.log(counts.clamp_min(0.5) / self.photons)
        if self.noise > 0:
            y = y + self.noise * largest * normal(y, generator)
        return y.to(integrals)


def check_photons(photons: float | None) -> None:
    """Raises ValueError unless `photons` is None or finite and > 0."""
    if photons is not None and not (isinstance(photons, Real) and 0 < photons < math.inf):
        raise ValueError(f"photons per pixel must be > 0, or None for no counting noise; {photons!r} was given")
