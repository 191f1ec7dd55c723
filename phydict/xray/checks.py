"""What X-rays and their geometry must be, and what makes them doubtful."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from phydict.grid import Grid
from phydict.runtime.warning import warn
from phydict.xray.geometry import ConeBeam

LINE_INTEGRAL_RANGE = 1.0, 20.0
"""Between these lies the largest line integral of a chest: 50 mm and 1 m of water."""

LEAST_LINE_INTEGRAL = -10.0
"""Below it a pixel's signal is 22,000 times that of air, which a detector of 16 bits has room for only where air reads
less than 3 of its values."""

CUT_OFF = 1.2
"""A view cuts the patient off at both sides where the medians of their outermost columns, over the middle half of the
rows, are larger: 60 mm of water. Of nine CTs on a detector that holds them it was 1.0 at most."""

AIR_BLOCKS, AIR_FLAT, AIR_MOST, AIR_DRIFT = 8, 0.05, 0.5, 0.1
"""At a side of the detector a view's line integrals are those of air where the medians of so many blocks of rows differ
by less than AIR_FLAT and are below AIR_MOST; between views, and from 0, those of air differ by less than AIR_DRIFT. Of
12 CTs in nine geometries, with and without scatter, what the thinner side of a view read was 0.03 at most."""

FLAT_VIEWS, FLAT_ALIKE, UNEVEN = 3, 0.03, 0.05
"""Of so many views or more, a side of the detector on which every block of rows reads the same, up to FLAT_ALIKE, in
all of them shows air; values of air that differ by more than UNEVEN between blocks are those of a missing flat image.
Scatter makes them negative, which counts as 0."""


CLIPPED, CLIPPED_FEW = 0.02, 16
"""A view counts as cut off where this share of its pixels, and so many of them, hold exactly its densest value. Of
three CTs from eight directions 0.0001 did at most, also in 8 bits; where counts end at 0, displays in white, or a
collimator covers the detector's sides, it is up to 0.5."""


def check_xrays(xrays: Tensor, beam: ConeBeam, display: bool = False) -> None:
    """Raises ValueError unless the X-rays (K, V, U) are finite, as many and as large as the beam's views, and none of
    them is blank, but for line integrals that are 0 everywhere, those of air."""
    expected = (beam.views, *beam.shape)
    if tuple(xrays.shape) != expected:
        raise ValueError(f"the geometry describes {expected[0]} views of {expected[1]} x {expected[2]} pixels, "
                         f"but the X-rays have shape {tuple(xrays.shape)}: give images and geometry that match")
    if not xrays.isfinite().all():
        raise ValueError("the X-rays contain NaN or infinite pixels: repair or remove those views first")
    blank = xrays.flatten(1).amin(1) == xrays.flatten(1).amax(1)
    if blank.any() and (display or xrays.any()):
        which = "every view" if blank.all() else f"view {int(blank.nonzero()[0])}"
        raise ValueError(f"{which} holds the same value in every pixel, as a missing or saturated image does: leave it "
                         "out of the X-rays and of the geometry")


def check_fit(xrays: Tensor, beam: ConeBeam, grid: Grid, survey: Grid | None, display: bool) -> None:
    """Raises ValueError where X-rays (K, V, U), geometry and the voxels of `grid` do not fit; warns where X-rays look
    inverted, cut off or repeated. survey: the voxels that hold the whole scene, where `grid` does not. display: whether
    they are display values."""
    check_xrays(xrays, beam, display)
    check_air(upright(xrays, beam))
    check_clipped(xrays)
    check_repeated(xrays, beam)
    if not display:
        check_bright(xrays)
    beam.check(grid)
    check_scale(beam, survey or grid)
    check_meets(beam, grid)
    if beam.continued and not grid.is_upright:
        raise ValueError("a patient who continues above and below is repeated along the third axis of the voxels, "
                         "which is to run upwards, but "
                         f"{np.round(grid.affine[:3, 2] / grid.spacing[2], 2).tolist()} was given: give voxels whose "
                         "third axis is superior, or leave out `continued`")


def check_scale(beam: ConeBeam, grid: Grid) -> None:
    """Look for lengths that are not in mm: compare the shadow of the box of voxels with the detectors.

    Raises ValueError for a view of which no ray meets the box, and where both sides of a shadow differ from the
    detector's by a factor of 6 or more; warns from a factor of 3. The box must lie between source and detector.
    """
    sides, met = _sides(beam), _meets(beam, grid)
    for k, (low, high) in enumerate(zip(*_shadow(beam, grid))):
        if not met[k]:
            raise ValueError(f"view {k}: no ray from the source to the detector meets the volume; check the view's "
                             "source, detector centre, u and v, and that the volume's centre is the isocentre")
        ratio = (high - low) / sides[k]
        factor = max(float(ratio.min()), 1 / float(ratio.max()))
        if factor < 3:
            continue
        comparison = "larger" if ratio.min() > 1 else "smaller"
        message = (f"view {k}: the volume's shadow is {factor:.1f} times {comparison} than the detector of "
                   f"{sides[k][0]:.4g} x {sides[k][1]:.4g} mm; check that the pixel size and all distances are in "
                   "mm, not in cm or m, and that the pixel size is that of these images")
        if factor >= 6:
            raise ValueError(message)
        warn(message)
        return


def check_meets(beam: ConeBeam, grid: Grid) -> None:
    """Raise ValueError unless a ray of some view meets the box of voxels, which must lie between source and
    detector."""
    if not _meets(beam, grid).any():
        size, centre = (", ".join(f"{mm:g}" for mm in np.round(place, 3) + 0.0)
                        for place in (grid.extent, grid.centre))
        raise ValueError(f"no ray of any view meets the box of voxels, which has sides of ({size}) mm and its "
                         f"centre at ({centre}) mm: give a centre, in mm towards right, anterior and superior, and "
                         "sides of a box that is seen in the X-rays")


def is_smaller_scene(beam: ConeBeam, grid: Grid) -> bool:
    """Whether the scene is that of something smaller than the box of voxels: a part of it lies beside or behind a
    source, or a source stands in the sphere about it and sees, along both sides of the detector, less than a third.
    """
    if (beam.depths(grid) <= 0).any():
        return True
    near = np.linalg.norm(beam.sources - grid.centre, axis=1) < np.linalg.norm(grid.extent) / 2
    low, high = _shadow(beam, grid)
    return bool((near & ((high - low) > 3 * _sides(beam)).all(1)).any())


def _sides(beam: ConeBeam) -> np.ndarray:
    """The detectors' sides (K, 2) in mm, along their columns and their rows."""
    return beam.pixel * beam.shape


def _meets(beam: ConeBeam, grid: Grid) -> np.ndarray:
    """Whether (K,) the box's shadow, as far as it reaches along rows and columns, meets each detector."""
    (low, high), half = _shadow(beam, grid), _sides(beam) / 2
    return np.all((low <= half) & (high >= -half), axis=1)


def _shadow(beam: ConeBeam, grid: Grid) -> tuple[np.ndarray, np.ndarray]:
    """The ends (K, 2) in mm, along rows' and columns' direction from the detector's centre, of the box's shadow."""
    places = beam.shadows(grid.corners())[..., ::-1]
    return places.min(1), places.max(1)


def upright(xrays: Tensor, beam: ConeBeam) -> Tensor:
    """X-rays (K, V, U), or, where the rows of all detectors rather than their columns run along the patient,
    (K, U, V), so that the columns at both ends are those beside the patient."""
    up_rows, up_columns = (np.abs(step[:, 2]) / np.linalg.norm(step, axis=1) for step in (beam.u, beam.v))
    return xrays.mT if (up_rows > up_columns).all() else xrays


def outer_columns(xrays: Tensor) -> Tensor:
    """A fiftieth of the columns of views (K, V, U), one or more, at each side of the detector: (2, K, V, columns)."""
    width = max(1, xrays.shape[2] // 50)
    return torch.stack([xrays[..., :width], xrays[..., -width:]])


def check_air(xrays: Tensor) -> None:
    """Warns where views (K, V, U) look inverted: more than half of the pixels in their outermost columns, where air is
    seen, or what is thin where the detector is narrow, lie in the uppermost tenth of their range (median view)."""
    views = xrays.float().flatten(1)
    views = views[:, ::max(1, views.shape[1] // 10_000)]
    rank = max(1, views.shape[1] // 100)
    low, high = views.kthvalue(rank).values, views.kthvalue(views.shape[1] + 1 - rank).values
    sides = outer_columns(xrays).movedim(0, 1).flatten(1)
    share = (sides > (high - 0.1 * (high - low))[:, None]).float().mean(1)
    if share.median() > 0.5:
        warn("the X-rays are densest at their left and right sides, where air should be seen, as inverted "
             "images are: turn them by a negative `scale` with an `offset`, or by the other "
             "`bright_is_dense`, or cut off what a collimator covered")


def check_clipped(xrays: Tensor) -> None:
    """Warns where many pixels of views (K, V, U), but not all of one, hold exactly the densest value of their view."""
    pixels = xrays[0].numel()
    share = (xrays == xrays.amax((1, 2), keepdim=True)).sum((1, 2)) / pixels
    shown = (share >= max(CLIPPED, CLIPPED_FEW / pixels)) & (share < 1)
    if shown.any():
        warn(f"{int(shown.sum())} of {len(xrays)} views hold exactly their densest value in up to "
             f"{float(share[shown].max()):.0%} of their pixels: what is denser was cut off there, as by a display "
             "window, or too few bits so that counts end at 0, or a collimator covers it: export them without a window "
             "and with more bits, of whole counts state `floor: 0.5`, or crop off what is covered")


def check_bright(xrays: Tensor) -> None:
    """Warns where line integrals (K, V, U) that reach no higher than a chest's lie below LEAST_LINE_INTEGRAL."""
    lowest = xrays.flatten(1).amin(1)
    if lowest.min() < LEAST_LINE_INTEGRAL and xrays.max() < LINE_INTEGRAL_RANGE[1]:
        warn(f"the smallest line integral is {float(lowest.min()):.3g}, in view {int(lowest.argmin())} (counted from "
             "0), of a signal far above that of air: the volume follows such pixels at the expense of all others: give "
             "defective ones the mean of their neighbours")


def check_repeated(xrays: Tensor, beam: ConeBeam) -> None:
    """Warns where a view of X-rays (K, V, U) holds, pixel for pixel, what another one does that stands elsewhere, but
    for images that are their own mirror images, as of air or a cylinder."""
    poses = np.concatenate([beam.sources, beam.detectors, beam.u, beam.v], 1)
    first: dict[float, int] = {}
    for k, view in enumerate(xrays):
        other = first.setdefault(float(view.double().sum()), k)
        if (not np.allclose(poses[k], poses[other]) and torch.equal(view, xrays[other])
                and not torch.allclose(view, view.flip(-1), atol=1e-3)):
            warn(f"view {k} (counted from 0) holds exactly the same image as view {other}, but the geometry has it "
                 "elsewhere: give the image of that direction in its place, or leave the view out of X-rays and "
                 "geometry")
            return


def check_line_integrals(xrays: Tensor) -> None:
    """Warns of line integrals (K, V, U) that no chest has, and where most views cut the patient off at both sides."""
    largest = float(xrays.max())
    low, high = LINE_INTEGRAL_RANGE
    if not low < largest < high:
        warn(f"the largest line integral is {largest:.3g}, but those of a chest lie between {low:g} and {high:g}: "
             "check that the X-rays are line integrals of attenuation in 1/mm along mm; of display values state "
             "`intensity: {kind: display, bright_is_dense: true}` in geometry.yaml, or in Python display=True")
        return
    quarter = xrays.shape[1] // 4
    middle = outer_columns(xrays[:, quarter:xrays.shape[1] - quarter]).float()
    if (views := int((middle.flatten(2).median(2).values.amin(0) > CUT_OFF).sum())) > len(xrays) / 2:
        warn(f"{views} of {len(xrays)} views cut the patient off at the left and right side of the detector: what lies "
             "beyond is the method's guess, and HU near it are less certain; a wider detector would show it")


def check_flat(xrays: Tensor) -> None:
    """Warns where air beside the patient, which all views (K, V, U) show alike, reads otherwise from place to place, as
    without a flat image."""
    blocks = side_blocks(xrays)
    shown = (blocks.amax(1) - blocks.amin(1) < FLAT_ALIKE).all(1) & (blocks < AIR_MOST).all(2).all(1)
    if len(xrays) < FLAT_VIEWS or not shown.any():
        return
    air = blocks[shown].median(1).values.clamp(min=0)
    if air.max() - air.min() > UNEVEN:
        warn(f"air is not the same across the detector: beside the patient it reads from {float(air.min()):.2f} to "
             f"{float(air.max()):.2f}, in all views alike, but as a line integral it is 0: give `flat:`, an image "
             "without a patient, in place of one number for `air:`")


def check_offset(xrays: Tensor) -> None:
    """Warns where all views (K, V, U) of a chest that show air read more than AIR_DRIFT there, as with a wrong value of
    air."""
    air = air_levels(xrays)
    seen = air[air.isfinite()]
    if len(seen) > 1 and seen.min() > AIR_DRIFT and xrays.max() > LINE_INTEGRAL_RANGE[0]:
        warn(f"in air beside the patient, which {len(seen)} of {len(air)} views show, all of them read "
             f"{float(seen.min()):.2f} or more, but as a line integral it is 0, and each ray counts as much more than "
             "the patient: correct `air` of counts or `offset` of line integrals, or crop off what is not air")


def air_levels(xrays: Tensor) -> Tensor:
    """What each of the views (K, V, U) reads in air at the thinner of its sides that show it: (K,), infinite where
    none does."""
    blocks = side_blocks(xrays)
    level = blocks.median(2).values
    is_air = (blocks.amax(2) - blocks.amin(2) < AIR_FLAT) & (level.abs() < AIR_MOST)
    return torch.where(is_air, level, torch.inf).amin(0)


def side_blocks(xrays: Tensor) -> Tensor:
    """Medians (2, K, AIR_BLOCKS or fewer) of blocks of rows in the outer columns of views (K, V, U) at each side."""
    return torch.stack([rows.flatten(2).median(2).values for rows in
                        outer_columns(xrays).float().tensor_split(min(AIR_BLOCKS, xrays.shape[1]), 2)], 2)


def prepared_xrays(xrays: Tensor, beam: ConeBeam, display: bool, told: bool = False) -> Tensor:
    """X-rays (K, V, U) as a reconstruction takes them: checked and, of no display values, as `with_air_at_zero`. Raises
    as `check_xrays`, and warns as `check_line_integrals`, `check_flat` and `check_offset`. told: whether the same
    X-rays, binned otherwise, were warned of before, so that nothing is said."""
    check_xrays(xrays, beam, display)
    if display:
        return xrays
    if not told:
        seen = upright(xrays, beam)
        check_line_integrals(seen)
        check_flat(seen)
        check_offset(seen)
    return with_air_at_zero(xrays, beam, told)


def with_air_at_zero(xrays: Tensor, beam: ConeBeam, told: bool = False) -> Tensor:
    """The line integrals (K, V, U), less what each view reads in air where that differs from view to view, which is
    said in a warning, unless it was `told` before: of a tube's output or a detector's gain that drifts. Views that show
    no air stay, and all of them where none reads it as 0 within AIR_DRIFT, as where the patient fills the detector."""
    air = air_levels(upright(xrays, beam))
    visible = air.isfinite()
    if visible.sum() < 2 or air[visible].max() - air[visible].min() <= AIR_DRIFT or air.abs().min() > AIR_DRIFT:
        return xrays
    if not told:
        few = "" if visible.all() else f", but not of the {len(air) - int(visible.sum())} views that show no air"
        warn(f"air beside the patient reads from {float(air[visible].min()):.2f} to {float(air[visible].max()):.2f} "
             "from view to view, but as a line integral it is 0: the tube's output or the detector's gain drifted; "
             f"each view's own value of air is subtracted{few}. If what lies there is not air, crop it off")
    return xrays - torch.where(visible, air, 0).to(xrays)[:, None, None]
