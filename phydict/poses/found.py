"""What a search of poses found, in words and figures."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from torch import Tensor

from phydict.reconstruction import Reconstruction
from phydict.units import HUWindow
from phydict.xray.geometry import ConeBeam
from phydict.xray.poses.unknowns import POSE

NAMES = ("detector_shift_columns_mm", "detector_shift_rows_mm", "source_shift_columns_mm", "source_shift_rows_mm",
         "source_to_detector_mm", "rotation_columns_degrees", "rotation_rows_degrees", "rotation_normal_degrees",
         "gain", "offset")
"""A view's unknowns: shifts in the direction from column to column and from row to row, rotations about these axes and
about the detector's normal, what was measured as (1 + gain) times the line integral plus the offset."""

LARGE_CORRECTION, LARGE_SHIFT = 3.0, 2.0
"""A warning names gains and offsets that were corrected by more than the first number of their stated standard
deviations, and views whose shadows were shifted by more than the second times what the stated deviations shift them by
(root mean square). No single unknown of a pose is judged, since many combinations shift shadows alike. On two training
CTs the second ratio is 1.5 at most for poses drawn as stated, where the right ones are found; for one view off by 25 mm
and 6 degrees, where 5 mm and 2 degrees are stated, it is 2.2 to 2.6, and for the other views 0.5 at most."""

SWAY, SWAY_ERRORS = 0.6, 4.0
"""Views whose sway is more mm and more of its standard errors are warned of. On two training CTs at rest it was 0.4 at
most; where the lower half of the chest was 10 mm lower in every second view it was 0.6 to 1.8."""

UNDETERMINED_VIEWS = 2
"""So many views or fewer cannot tell much of their poses, and nothing of a sway, from the volume."""

FEW_WIDENING = 1.5
"""Factor by which intervals widen where so few views' poses were searched, since a volume explains what is left of
their errors: of ten pairs of radiographs of five training CTs, eight then hold 90 % of the body and of the lungs or
more, without it five."""

SWAY_WIDENING = 1.25
"""Factor by which intervals widen where views are found to sway: with breathing by 10 mm between eight views of two CTs
kept from training, 83 and 86 % of the body are otherwise in the 90 % one, which holds 90 % at 1.17 and 1.27 times."""

WIDEST_HU = 2 * HUWindow().half_width
"""HU of half the widest interval, which leaves out nothing."""


@dataclass(frozen=True)
class FoundPoses:
    """The beam found; corrections of the nominal one and their standard errors (K, 10), as NAMES lists them.

    deviations (10,): what was stated to be uncertain; 0: exactly known. The errors hold for the volume as it was found,
    so that they are too small where volume and poses are entangled. misfits: relative residual of the search's own
    volumes, at first and at last. sway (2, K): by how many mm on the detector each view shows the lower end of the body
    moved against the upper one, and the standard error of that. shift (2, K): by how many mm on the detector (root mean
    square over the middle of the volume) each view's shadows were corrected, and what the stated deviations shift them
    by. The beam is the corrected one carried as a whole to the nominal one, its detectors drawn back to behind the
    volume's box: neither changes a projection. display: of display values, whose gains and offsets are unknown anyway.
    """

    beam: ConeBeam
    deviations: np.ndarray
    corrections: np.ndarray
    errors: np.ndarray
    misfits: tuple[float, float]
    sway: np.ndarray
    shift: np.ndarray
    seconds: float
    display: bool = False

    def corrected(self, xrays: Tensor) -> Tensor:
        """X-rays (K, V, U) without their gains and offsets."""
        gain, offset = (xrays.new_tensor(self.corrections[:, n])[:, None, None] for n in (8, 9))
        return (xrays - offset) / (1 + gain)

    def record(self) -> dict:
        """Plain lists, one value per view, of what was uncertain."""
        chosen = [n for n, deviation in enumerate(self.deviations) if deviation > 0]
        return {"corrections": {NAMES[n]: self.corrections[:, n].tolist() for n in chosen},
                "standard_errors": {NAMES[n]: self.errors[:, n].tolist() for n in chosen},
                "shadow_shift_mm": self.shift[0].tolist(), "misfit_before": self.misfits[0],
                "misfit_after": self.misfits[1], "sway_mm": self.sway[0].tolist()}

    @property
    def undetermined(self) -> bool:
        """Whether poses were searched of so few views that a volume explains what is left of their errors."""
        return len(self.corrections) <= UNDETERMINED_VIEWS and bool(self.deviations[:len(POSE)].any())

    @property
    def swaying(self) -> np.ndarray:
        """The views that show the lower end of the body moved."""
        size = self._relative_sway()
        return np.flatnonzero((size > SWAY) & (size > SWAY_ERRORS * self.sway[1]) & (len(size) > UNDETERMINED_VIEWS))

    def _relative_sway(self) -> np.ndarray:
        return np.abs(self.sway[0] - self.sway[0].mean())  # what all share is the volume's

    def added_to(self, result: Reconstruction) -> Reconstruction:
        """A reconstruction by the beam found, with what was found, and with wider intervals, if it has any, where that
        is little or leaves a movement unexplained."""
        factor = (FEW_WIDENING if self.undetermined else 1.0) * (SWAY_WIDENING if self.swaying.size else 1.0)
        factor = factor if result.intervals else 1.0
        return replace(result, beam=self.beam, poses=self.record(),
                       seconds={"calibrate": self.seconds} | result.seconds,
                       intervals={level: (factor * half_width).clamp(max=WIDEST_HU)
                                  for level, half_width in result.intervals.items()},
                       interval_widening=factor * result.interval_widening)

    def warnings(self) -> list[str]:
        """What is to be said: that few views cannot show depth, which views were corrected by more than stated, and
        which show that the patient moved."""
        messages = []
        if len(self.corrections) <= UNDETERMINED_VIEWS:
            wider = f"; intervals, if any, are {FEW_WIDENING} times as wide for it" if self.undetermined else ""
            messages.append(f"{len(self.corrections)} views show the volume from so few sides that most of its depth, "
                            "and of what was found of the poses, comes from the method and from the stated geometry: "
                            "read outlines and large structures alone, and no sizes, places or densities of small "
                            f"ones; lengths are as right as the stated distances{wider}")
        for view in np.flatnonzero(self.shift[0] > LARGE_SHIFT * self.shift[1]):
            size, stated = self.shift[:, view]
            messages.append(f"view {view} (counted from 0) was corrected by {size:.3g} mm on the detector, "
                            f"{size / stated:.1f} times what is stated of its pose: check this view's geometry, or "
                            "state more under `uncertain:`")
        for name, stated, column in zip(NAMES[len(POSE):], self.deviations[len(POSE):],
                                        self.corrections.T[len(POSE):], strict=True):
            for view in np.flatnonzero((np.abs(column) > LARGE_CORRECTION * stated) & (stated > 0) & ~self.display):
                messages.append(f"view {view} (counted from 0) was corrected by {column[view]:.3g} in {name}, "
                                f"{abs(column[view]) / stated:.1f} times the stated {stated:g}: check this view, or "
                                "state more under `uncertain:`")
        if len(swaying := self.swaying):
            messages.append(f"view {', '.join(map(str, swaying))} (counted from 0) show the lower end of the body up "
                            f"to {self._relative_sway().max():.1f} mm away from where the volume of all views has it, "
                            "which no pose explains: the patient breathed or moved between the views, and the volume "
                            f"is blurred there; intervals, if any, are {SWAY_WIDENING} times as wide for it")
        return messages
