"""What is not exactly known of every view's pose and intensity, and how well it is known."""

from __future__ import annotations

import reprlib
from dataclasses import dataclass, fields
from numbers import Real

import numpy as np

from phydict.xray.geometry import ConeBeam
from phydict.xray.poses.unknowns import POSE

MOST_DEVIATION = {"rotation_degrees": 20.0, "gain": 1.0, "offset": 10.0}
"""Standard deviations that are no longer small; MOST_DEVIATION_MM for those in mm."""
MOST_DEVIATION_MM = 200.0
MOST_STRETCH = 0.2
"""Share of the source-detector distance by which it may be uncertain where a volume's density has no scale either."""


@dataclass(frozen=True)
class Uncertain:
    """Standard deviations of what a geometry says of each view; 0: exactly known.

    detector_shift_mm, source_shift_mm: along the detector's rows and along its columns, each
    source_to_detector_mm: of the distance, by which a shadow's magnification is unknown too
    rotation_degrees: of source and detector together, or of the patient, about each of three axes
    gain: of the factor, about 1, between line integrals and what was measured
    offset: of what was measured without a patient, in line integrals
    Raises ValueError for what is no standard deviation, and where nothing is uncertain.
    """

    detector_shift_mm: float = 0.0
    source_shift_mm: float = 0.0
    source_to_detector_mm: float = 0.0
    rotation_degrees: float = 0.0
    gain: float = 0.0
    offset: float = 0.0

    def __post_init__(self):
        for name, value in vars(self).items():
            most = MOST_DEVIATION.get(name, MOST_DEVIATION_MM)
            if isinstance(value, bool) or not isinstance(value, Real) or not 0 <= float(value) <= most:
                raise ValueError(f"uncertain {name} is a standard deviation from 0, exactly known, to {most:g}, but "
                                 f"{reprlib.repr(value)} was given")
        if not any(vars(self).values()):
            raise ValueError("`uncertain:` says of everything that it is exactly known: state what is not, such as "
                             "detector_shift_mm: 5")

    @classmethod
    def from_dict(cls, content: object) -> Uncertain:
        """As a geometry file states it. Raises ValueError naming the key."""
        names = [field.name for field in fields(cls)]
        if not isinstance(content, dict):
            raise ValueError(f"`uncertain:` is a mapping with some of the keys {', '.join(names)}, but "
                             f"{reprlib.repr(content)} was found")
        unknown = [reprlib.repr(key) for key in content if key not in names]
        if unknown:
            raise ValueError(f"unknown {', '.join(unknown)} in `uncertain:`; the keys are {', '.join(names)}")
        return cls(**content)

    @property
    def deviations(self) -> np.ndarray:
        """Standard deviations (10,) of a view's unknowns, as POSE lists eight of them, then gain and offset."""
        return np.array([getattr(self, name) for name in (*POSE, "gain", "offset")], float)

    @property
    def poses(self) -> np.ndarray:
        """Of these, those of the pose (8,)."""
        return self.deviations[:len(POSE)]

    def check(self, views: int, pixels: int) -> None:
        """Raises ValueError where so many views of so many pixels cannot hold the unknowns."""
        unknowns = views * int((self.deviations > 0).sum())
        if views == 1 and self.poses.any():
            raise ValueError(f"one view leaves its {int((self.poses > 0).sum())} unknowns of pose undecided: "
                             "whatever its pose, a moved patient explains it; give two views or more, or leave "
                             "calibrate out")
        if unknowns >= views * pixels / 2:
            raise ValueError(f"{unknowns} unknowns of {views} views cannot be found from {views * pixels} pixels: "
                             "state fewer under `uncertain:`, or give finer images")

    def check_scale(self, beam: ConeBeam) -> None:
        """Raises ValueError where display values of a beam would have no scale at all, neither of density nor of
        size."""
        distance = float(beam.distances.min())
        if self.source_to_detector_mm > MOST_STRETCH * distance:
            raise ValueError(f"display values have no scale of density, and where {distance:.4g} mm from source to "
                             f"detector are uncertain by {self.source_to_detector_mm:g} mm they have none of size "
                             f"either: state source_to_detector_mm up to {MOST_STRETCH * distance:.0f} under "
                             "`uncertain:`, with the pixel size and distances that go with it, or give line integrals")


def by_hand(beam: ConeBeam) -> Uncertain:
    """What is usual of radiographs for which a patient stands and turns between exposures: a magnification within 10 %
    of what was noted among it."""
    return Uncertain(detector_shift_mm=10.0, rotation_degrees=4.0,
                     source_to_detector_mm=min(0.06 * float(beam.distances.min()), MOST_DEVIATION_MM))
