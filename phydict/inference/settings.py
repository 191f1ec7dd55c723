"""Settings of reconstruction and of its data, in groups."""

from __future__ import annotations

from dataclasses import dataclass, replace

from phydict.methods import UNGUIDED
from phydict.posterior import Sampler
from phydict.prior import MedSynCheckpoint
from phydict.xray import ConeBeam
from phydict.xray.orbits import PIXEL, PIXELS, SOURCE_TO_DETECTOR, SOURCE_TO_ISOCENTRE


@dataclass(frozen=True)
class Sampling:
    """How the prior is sampled, whatever the method.

    Args:
        guidance: scale of classifier-free guidance when a report is given; 1: none
        samples: how many are drawn; of several the volume is the mean, and deviation.nii.gz their standard deviation
        precision: of the networks: auto (bfloat16 where the device computes it faster), float32 or bfloat16
        with_report: whether the cases' reports are used
    """

    guidance: float = 1.0
    samples: int = 1
    precision: str = "auto"
    with_report: bool = True


MEMORY = 4.0
"""GiB that a second stage's network may take where no other amount is given."""

WITHOUT_STAGE = ("model.super_resolution.{} means nothing without model.super_resolution.file, the second stage's: "
                 "give it too, or leave that out")
"""What is said of a setting of a second stage that is not given."""


@dataclass(frozen=True)
class CascadeSettings:
    """A second stage, which refines what the prior gives. Raises ValueError for settings of one that is not given.

    Args:
        file: the second stage's file; none given: no second stage
        guided: whether the X-rays guide it too; a method's configuration may say so of any stage, given or not
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
    memory: float = MEMORY

    def __post_init__(self):
        if not 0 < self.memory < 2**20:
            raise ValueError(f"model.super_resolution.memory is an amount in GiB, above 0, but {self.memory:g} was "
                             "given")
        alone = {"sampler": self.sampler is not None, "noise_augmentation": self.noise_augmentation is not None,
                 "memory": self.memory != MEMORY}
        if not self.file and any(alone.values()):
            name = next(name for name, given in alone.items() if given)
            raise ValueError(WITHOUT_STAGE.format(name))
        if self.sampler is not None and not self.guided:
            raise ValueError(UNGUIDED.format("model.super_resolution."))


@dataclass(frozen=True)
class Orbit:
    """The simulated X-rays' geometry: views on a circle from anterior; what is not given is PAPER's, or a protocol's.

    Args:
        views: how many; 8 if left out
        source_to_detector: distance in mm; 1020 if left out
        source_to_isocentre: distance in mm; 740 if left out
        detector: rows and columns of pixels; 448 and 448 if left out
        pixel: mm from row to row and from column to column; 1.25 and 1.25 if left out
        arc: degrees over which the views are spread evenly; 360 if left out
    """

    views: int | None = None
    source_to_detector: float | None = None
    source_to_isocentre: float | None = None
    detector: tuple[int, int] | None = None
    pixel: tuple[float, float] | None = None
    arc: float | None = None

    def filled(self, by: Orbit | None = None) -> Orbit:
        """The same with what is left out taken from another one, PAPER if none is given."""
        return replace(by or PAPER, **{name: value for name, value in vars(self).items() if value is not None})

    def settings(self) -> dict:
        """What decides the geometry; an arc of 360 degrees is left out."""
        settings = vars(self.filled())
        return {name: value for name, value in settings.items() if name != "arc" or value != PAPER.arc}

    def beam(self) -> ConeBeam:
        """As per-view vectors. Raises ValueError for what cannot be."""
        views, source_to_detector, source_to_isocentre, detector, pixel, arc = vars(self.filled()).values()
        return ConeBeam.orbit(views, source_to_detector, source_to_isocentre, detector, pixel,
                              arc_degrees=None if arc == PAPER.arc else arc)


PAPER = Orbit(8, SOURCE_TO_DETECTOR, SOURCE_TO_ISOCENTRE, (PIXELS, PIXELS), (PIXEL, PIXEL), 360.0)
"""The paper's orbit, and the default."""
