"""Settings of reconstruction and of its data, in groups."""

from __future__ import annotations

from dataclasses import dataclass

from phydict.posterior import Sampler
from phydict.prior import MedSynCheckpoint
from phydict.xray import ConeBeam


@dataclass(frozen=True)
class Sampling:
    """How the prior is sampled, whatever the method.

    Args:
        guidance: scale of classifier-free guidance when a report is given; 1: none
        samples: how many are drawn; of several the volume is the mean, and deviation.nii.gz their standard deviation
        precision: of the networks: auto (bfloat16 where the device computes it), float32 or bfloat16
    """

    guidance: float = 1.0
    samples: int = 1
    precision: str = "auto"


@dataclass(frozen=True)
class CascadeSettings:
    """A second stage, which refines what the prior gives.

    Args:
        file: the second stage's file; none given: no second stage
        guided: whether the X-rays guide it too
        sampler: the Sampler that guides it; none given: the cascade's own
        noise_augmentation: level in [0, 1] of the noise that the prior's estimate is given before the second stage sees
            it; none given: the stage's own, 0.05, or 0 for MedSyn's
        memory: GiB that its network may take; it works in tiles where the whole takes more, and MedSyn's, which cannot,
            is refused
    """

    file: str | MedSynCheckpoint | None = None
    guided: bool = True
    sampler: Sampler | None = None
    noise_augmentation: float | None = None
    memory: float = 4.0

    def __post_init__(self):
        if not 0 < self.memory < 2**20:
            raise ValueError(f"model.super_resolution.memory is an amount in GiB, above 0, but {self.memory:g} was "
                             "given")


@dataclass(frozen=True)
class Orbit:
    """The simulated X-rays' geometry: views on a full circle from anterior.

    Args:
        views: how many
        source_to_detector: distance in mm
        source_to_isocentre: distance in mm
        detector: rows and columns of pixels
        pixel: mm from row to row and from column to column
    """

    views: int = 8
    source_to_detector: float = 1020.0
    source_to_isocentre: float = 740.0
    detector: tuple[int, int] = (448, 448)
    pixel: tuple[float, float] = (1.25, 1.25)

    def beam(self) -> ConeBeam:
        """As per-view vectors. Raises ValueError for what cannot be."""
        return ConeBeam.orbit(*vars(self).values())
