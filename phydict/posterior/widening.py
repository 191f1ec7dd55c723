"""By how much intervals are wider than a network says: of scenes unlike its calibration's, and of limited angles."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from phydict.guard import worst_view
from phydict.posterior.measurement import Measurement
from phydict.runtime.warning import warn
from phydict.xray import ConeBeam, Projector

WIDENING = 0.25
"""Power of the residual, over the most in calibration, by which intervals widen: of held-out CTs, from
polychromatic X-rays with residuals of 1.3 to 4 times their noise, 91 to 98 % of the body is then in the 90 % one."""

FAR_OUTSIDE = 4.5
"""How many times the most residual in calibration is far outside of it: beyond a tube's spectrum, whose residual is 4
times as large at most. What views contradict counts as noise there, and has a warning of its own."""

WORST_VIEW = 16.0
"""The ratio, of the noise of a view with what contradicts the rest counted as such to its own, from which on intervals
widen by its root, whatever the other views say: with one of eight views flipped, negated or another's, of a held-out
CT, 58 to 87 % of the body is otherwise in the 90 % interval."""

CONTRADICTION_WIDENING = 0.4
"""Power of the geometric mean of these ratios over the views by which intervals widen: in eight scenes of two held-out
CTs, 4 to 16 views in poses wrong by up to 5 mm and 2 degrees or with breathing by 10 mm, 88 to 92 % of the body is then
in the 90 % interval, before 75 to 92 %. A gain that drifts by 20 %, which they see less of, is held to 70 % on one."""

STANDS_OUT = 1.2
"""How many times the median view's is the share of a view that counts as noise for it to be named as the one that fits
worst: of five views of which one is another patient's it is 1.4."""

LIMITED_ANGLE_VIEWS, WIDE_SPREAD, LIMITED_POWER = 6, 0.35, 0.6
"""Views up to which, and `angular_spread` from which on, errors are as large as the network says that tells their size;
and the power of the views over LIMITED_ANGLE_VIEWS by which more of them come from one line at most. Over 144 scenes of
two held-out CTs, from 3 to 32 views, what is left of the differences between scenes has a standard deviation of 10 %,
otherwise 16 %; with 16 to 32 views from less than 60 degrees errors are 1.6 to 1.9 times as large as it says."""

FEW_VIEWS, LEAST_SPREAD, NARROW_POWER = 3, 0.037, 0.15
"""Views up to which the width of an arc changes nothing; `angular_spread` of the narrowest arc of the calibration, 40
degrees; and the power of how far that of more views is below it, by which intervals widen: of two held-out CTs 79 to
88 % of the body are otherwise in the 90 % interval from 8 and 16 views within 15 and 25 degrees. From 64 and 128 views,
and tilted by 30 and 45 degrees, it holds 88 to 94 % as it is."""

ALIKE, REPEATED_POWER = math.radians(0.2), 0.5
"""Angle within which views come from one direction; and the power of how many come from one, on average, by which
intervals widen, since the network counts them all. Of two CTs from 3 to 8 directions with two, three and four views
each they have to be 1.3, 1.6 and 1.9 times as wide to hold what they hold of single ones; as they are the 90 % one
holds 82 to 84, 74 and 66 to 71 % of the body."""

MANY_DIRECTIONS = 64
"""Directions from a wide angle (WIDE_SPREAD) from which on repeats change nothing: from 64 single ones of a full orbit
the 90 % interval holds 98 % of the body, 1.7 times as wide as it has to be. Views of an orbit of 1,800 are ALIKE to
their neighbours and no repeats."""


def widening_of(measurement: Measurement, reprojection: Tensor, most_residual: float) -> float:
    """The factor, 1 or more, by which intervals are wider than calibrated: where the residual of the X-rays is larger
    than was usual in the calibration, or they contradict each other, come from a narrower arc or repeat. Warns where it
    is more than FAR_OUTSIDE times as large, less what counted as noise, of a narrower arc and of repeated views."""
    residual = float(measurement.normalised_error(reprojection, modelled=True))
    if residual > FAR_OUTSIDE * most_residual:
        warn(f"the residual of the X-rays is {residual:.3g} times their noise, and usually at most {most_residual:.3g} "
             "in the scenes that the intervals were calibrated on: they are widened, and may still be too narrow; "
             "check the geometry and the scale, and whether the patient moved or is wider than the volume")
    widening = max(1.0, residual / most_residual) ** WIDENING * contradiction_widening(measurement)
    return widening * max(narrow_arc_widening(measurement.projector), repeated_widening(measurement.projector))


def narrow_arc_widening(projector: Projector) -> float:
    """The factor, 1 or more, by which intervals widen where views come from a narrower arc than in the calibration;
    warns of it."""
    spread = angular_spread(projector)
    if projector.beam.views <= FEW_VIEWS or spread >= LEAST_SPREAD:
        return 1.0
    factor = (LEAST_SPREAD / max(spread, 1e-3)) ** NARROW_POWER
    warn(f"{projector.beam.views} views come from a narrower arc than any that the intervals were calibrated on, 40 "
         f"degrees: they are {factor:.1f} times as wide for it, and may still be too narrow")
    return factor


def repeated_widening(projector: Projector) -> float:
    """The factor, 1 or more, by which intervals widen where several views come from one direction; warns of it. 1 from
    MANY_DIRECTIONS of a wide angle on."""
    views, distinct = projector.beam.views, directions(projector.beam, projector.grid.centre)
    if distinct >= MANY_DIRECTIONS and angular_spread(projector) >= WIDE_SPREAD:
        return 1.0
    factor = (views / distinct) ** REPEATED_POWER
    if distinct < views:
        warn(f"{views} views come from {distinct} direction{'s' * (distinct > 1)} alone, which tell less than as many "
             f"directions would: intervals are at least {factor:.1f} times as wide for it")
    return factor


def contradiction_widening(measurement: Measurement) -> float:
    """The factor, 1 or more, by which intervals widen where a part of the X-rays counted as noise because no volume
    explains it, by all views or by the worst; 1 where nothing did. It compares with the noise of the X-rays, so that
    the same contradiction widens the less the noisier they are: 3.5 times without noise what widens 2 times with noise
    of 0.5 % of the largest line integral, with which it was calibrated."""
    noise = measurement.noise_variance.mean((1, 2)).clamp(min=1e-12)
    counted = torch.as_tensor(measurement.model_variance).flatten().to(noise)
    ratios = (1 + counted / noise).sqrt()
    return max(float(ratios.log().mean().exp()) ** CONTRADICTION_WIDENING, (float(ratios.max()) / WORST_VIEW) ** 0.5)


def warn_of_contradictions(measurement: Measurement, widening: float | None) -> None:
    """Warns where a part of the X-rays counted as noise because no volume explains it, and names the view that fits
    worst where it stands out of three or more; widening: of the intervals, if there are any."""
    variance = torch.as_tensor(measurement.model_variance).flatten()
    views = variance.nonzero().flatten().tolist()
    if views:
        which = "any view" if len(views) == measurement.projector.beam.views else (
            f"view {', '.join(map(str, views))} (counted from 0)")
        wider = "" if widening is None else f", and intervals are {widening:.1f} times as wide as calibrated"
        worst, ratio = worst_view((variance / measurement.y[0].square().mean((1, 2)).clamp(min=1e-12)).sqrt().tolist())
        alone = f"; view {worst} (counted from 0) fits worst: reconstruct without it and compare" if (
            len(variance) > 2 and ratio >= STANDS_OUT) else ""
        warn(f"no volume explains {which}: as much of it as contradicts the rest counted as noise, so that the volume "
             f"follows it less and the prior more{wider}; check geometry and scale, and whether the patient moved or "
             f"is wider than the volume{alone}")


def angular_spread(projector: Projector) -> float:
    """How widely the views see the grid's centre, from 0, all along one line, to 0.5, evenly around it: the second
    largest eigenvalue of the mean of d d^T over their directions d; 0.09 for an arc of 60 degrees, 0.18 for 90."""
    towards = projector.grid.centre - projector.beam.sources
    towards = towards / np.linalg.norm(towards, axis=1, keepdims=True)
    return float(np.linalg.eigvalsh(towards.T @ towards / len(towards))[1])


def directions(beam: ConeBeam, centre: np.ndarray) -> int:
    """From how many directions views see a place (3,) in mm: those of which neither sources, seen from there, nor
    detectors, seen from these, are more than ALIKE apart count as one."""
    rays = np.stack([beam.sources - centre, beam.detectors - beam.sources])
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    cosines = (rays @ rays.swapaxes(-2, -1)).min(0)
    return round(float((1 / (cosines > math.cos(ALIKE) - 1e-12).sum(1)).sum()))


def limited_angle_factor(projector: Projector) -> float:
    """The factor, 1 or more, by which errors are larger than the network says that tells their size where many views
    come from a limited angle, which it does not see."""
    narrow = max(0.0, 1 - angular_spread(projector) / WIDE_SPREAD)
    return max(1.0, projector.beam.views / LIMITED_ANGLE_VIEWS) ** (LIMITED_POWER * narrow)
