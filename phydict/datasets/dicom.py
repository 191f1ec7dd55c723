"""DICOM radiographs (CR, DX) and angiographic or fluoroscopic runs (XA, RF): images, and the beam of their tags.

Positioner angles (DICOM PS3.3 C.8.7.5.1.2) say where the detector stands about the patient, whatever way the patient
lies: PositionerPrimaryAngle P like longitude, 0 at the chest (a PA view), +90 at the patient's left (LAO), -90 at the
right (RAO), 180 at the back; PositionerSecondaryAngle S like latitude, positive cranial, negative caudal. In RAS+ with
the isocentre at the origin

    detector = (SDD - SOD) d    source = -SOD d    d = (-sin P cos S, cos P cos S, sin S)

SDD is DistanceSourceToDetector. SOD, to the isocentre, is DistanceSourceToPatient in XA and RF (in enhanced XA
DistanceSourceToIsocenter). In CR and DX that tag reaches only the patient's support, so there SOD is SDD over
EstimatedRadiographicMagnificationFactor. Without angles, ViewPosition PA, LL, AP, RL means P = 0, 90, 180, -90. The
beam is taken as perpendicular to the detector and centred on it; pixels are ImagerPixelSpacing, never the calibrated
PixelSpacing.

Rows and columns: where PatientOrientation says what way they run, it is believed. Without it an XA or RF image is taken
as head up and as seen from the detector (PS3.17 FFF.2.1.3), which shows the patient's right on the left in a PA view; a
CR or DX image must have it.

Pixels: rescale slope and intercept, or the modality LUT, are applied; the VOI window, a choice for the eye, never is.
MONOCHROME1 says how values are shown, so it inverts display images alone.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pydicom
from pydicom.datadict import tag_for_keyword
from pydicom.errors import InvalidDicomError
from pydicom.pixels import apply_modality_lut

from phydict.datasets.intensity import Intensity
from phydict.xray.geometry import ConeBeam

VIEW_POSITIONS = {"PA": 0.0, "LL": 90.0, "AP": 180.0, "RL": -90.0}
DIRECTIONS = {"R": (1, 0, 0), "L": (-1, 0, 0), "A": (0, 1, 0), "P": (0, -1, 0), "H": (0, 0, 1), "F": (0, 0, -1)}
OVERRIDES = ("source_to_detector", "source_to_isocentre", "pixel", "primary_degrees", "secondary_degrees",
             "patient_orientation")
UNREADABLE = (InvalidDicomError, OSError, EOFError, ValueError, AttributeError, NotImplementedError, RuntimeError)


@dataclass(frozen=True)
class DicomTags:
    """What the tags of one frame say of its geometry and pixel values; None or "" where they are silent.

    name: of file and frame. Lengths in mm, angles in degrees; pixel: (row height, column width); patient_orientation:
    letters of the directions in which (columns, rows) run. relationship, sign: PixelIntensityRelationship(Sign).
    """

    name: str
    source_to_detector: float | None
    source_to_isocentre: float | None
    pixel: tuple[float, float] | None
    primary_degrees: float | None
    secondary_degrees: float | None
    patient_orientation: tuple[str, str] | None
    angiographic: bool
    inverted: bool
    relationship: str
    sign: int | None


def read_dicom(path: Path) -> list[tuple[np.ndarray, DicomTags]]:
    """The frames of a DICOM file: pixels (V, U) float64 after the modality transform, and their tags.

    Raises ValueError naming the file where it cannot be read or decoded, or is not grey.
    """
    try:
        dataset = pydicom.dcmread(path)
        if dataset.get("SamplesPerPixel", 1) != 1:
            raise ValueError(f"it has {dataset.SamplesPerPixel} colours per pixel; export it as grey")
        if "PixelData" not in dataset:
            raise ValueError("it holds no image")
        stored = dataset.pixel_array
    except UNREADABLE as error:
        raise ValueError(f"the DICOM file {path} cannot be read ({error}); export it again, uncompressed") from error
    frames = stored[None] if stored.ndim == 2 else stored
    several = len(frames) > 1
    return [(_rescaled(frame, dataset, k), _tags(dataset, k, f"{path} frame {k + 1}" if several else str(path)))
            for k, frame in enumerate(frames)]


def tags_beam(tags: list[DicomTags], shape: tuple[int, int], overrides: dict | None = None,
              turned: bool = False) -> ConeBeam:
    """The beam of the frames whose tags are given, for images of `shape` (V, U).

    overrides: values to use instead of the tags', one for all frames or a list with one per frame, by the names of
    OVERRIDES. turned: the images were turned by a quarter since they were stored, so that rows have become columns.
    Raises ValueError naming the frame and the tags that are missing, zero or contradictory.
    """
    stated = _per_frame(overrides or {}, len(tags))
    poses = [_pose(frame, {name: values[k] for name, values in stated.items()}, turned)
             for k, frame in enumerate(tags)]
    return ConeBeam(*(np.stack(part) for part in zip(*poses)), shape)


def tags_intensity(tags: list[DicomTags]) -> Intensity:
    """What the pixel values mean by the tags alone: LOG images are display images of known polarity.

    Raises ValueError where the tags do not suffice: linear images need the air value, which no tag holds.
    """
    first = tags[0]
    if first.relationship == "LOG" and first.sign in (1, -1):
        return Intensity("display", bright_is_dense=(first.sign == -1) != first.inverted)
    advice = "state `intensity:` in geometry.yaml: kind line_integrals, counts or display"
    if first.relationship == "LIN":
        advice = "state `intensity: {kind: counts, air: ...}` in geometry.yaml, air being the value without a patient"
    raise ValueError(f"{first.name} has PixelIntensityRelationship {first.relationship or 'unknown'}, from which line "
                     f"integrals do not follow; {advice}")


def shown(intensity: Intensity, tags: list[DicomTags]) -> Intensity:
    """An intensity stated for the images as they are shown, for the values as they are stored.

    Raises ValueError where counts are stated of images whose tags say that they are logarithmic or inverted.
    """
    for frame in tags:
        if intensity.kind == "counts" and (frame.relationship == "LOG" or frame.sign == -1):
            raise ValueError(f"{frame.name} is said to hold counts, but its PixelIntensityRelationship is "
                             f"{frame.relationship or 'unknown'}, sign {frame.sign}: correct `intensity:`")
    if intensity.kind != "display" or not tags[0].inverted:
        return intensity
    return Intensity("display", bright_is_dense=not intensity.bright_is_dense)


def _find(dataset: pydicom.Dataset, frame: int, keyword: str):
    """A tag's value for one frame: from its own functional groups, the shared ones, or the file; None if empty."""
    groups = []
    for name, index in (("PerFrameFunctionalGroupsSequence", frame), ("SharedFunctionalGroupsSequence", 0)):
        sequence = dataset.get(name) or []
        groups += [item[0] for element in (sequence[index] if index < len(sequence) else [])
                   if (item := element.value) and element.VR == "SQ"]
    for group in (*groups, dataset):
        value = group.get(keyword)
        if value is not None and value != "" and not (hasattr(value, "__len__") and len(value) == 0):
            return value
    return None


def _rescaled(pixels: np.ndarray, dataset: pydicom.Dataset, frame: int) -> np.ndarray:
    if "ModalityLUTSequence" in dataset:
        return np.asarray(apply_modality_lut(pixels, dataset), np.float64)
    slope, intercept = _find(dataset, frame, "RescaleSlope"), _find(dataset, frame, "RescaleIntercept")
    return pixels * float(1 if slope is None else slope) + float(intercept or 0)


def _tags(dataset: pydicom.Dataset, frame: int, name: str) -> DicomTags:
    angiographic = dataset.get("Modality", "") in ("XA", "RF")
    to_detector = _number(dataset, frame, "DistanceSourceToDetector", name)
    if angiographic:
        to_isocentre = _number(dataset, frame, "DistanceSourceToIsocenter", name)
        if to_isocentre is None:
            to_isocentre = _number(dataset, frame, "DistanceSourceToPatient", name)
    else:
        magnification = _number(dataset, frame, "EstimatedRadiographicMagnificationFactor", name)
        to_isocentre = to_detector / magnification if to_detector and magnification else None
    pixel = _find(dataset, frame, "ImagerPixelSpacing")
    primary = _angle(dataset, frame, "PositionerPrimaryAngle", name)
    secondary = _angle(dataset, frame, "PositionerSecondaryAngle", name)
    if primary is None and dataset.get("ViewPosition") in VIEW_POSITIONS:
        primary = VIEW_POSITIONS[dataset.ViewPosition]
        secondary = secondary or 0.0
    orientation = _find(dataset, frame, "PatientOrientation")
    sign = _number(dataset, frame, "PixelIntensityRelationshipSign", name)
    if sign and (_number(dataset, frame, "RescaleSlope", name) or 1) < 0:
        sign = -sign  # the tag speaks of stored values
    return DicomTags(
        name, to_detector, to_isocentre, None if pixel is None else tuple(float(p) for p in pixel), primary, secondary,
        None if orientation is None else tuple(str(o) for o in orientation), angiographic,
        dataset.get("PhotometricInterpretation") == "MONOCHROME1",
        str(_find(dataset, frame, "PixelIntensityRelationship") or ""), None if sign is None else int(sign))


def _number(dataset: pydicom.Dataset, frame: int, keyword: str, name: str) -> float | None:
    value = _find(dataset, frame, keyword)
    try:
        return None if value is None else float(value)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name}: {keyword} must be a number, but {value!r} was found") from error


def _angle(dataset: pydicom.Dataset, frame: int, keyword: str, name: str) -> float | None:
    """A positioner angle with its increment: one value per frame counts from the first, a single one is the step."""
    angle, steps = _number(dataset, frame, keyword, name), dataset.get(f"{keyword}Increment")
    if angle is None or steps is None or steps == "":
        return angle
    steps = np.atleast_1d(np.asarray(steps, float))
    if len(steps) == 1:
        return angle + frame * float(steps[0])
    if frame >= len(steps):
        raise ValueError(f"{name}: {keyword}Increment holds {len(steps)} values; give one, or one per frame")
    return angle + float(steps[frame])


def _per_frame(overrides: dict, frames: int) -> dict[str, list]:
    """Every override as a list with one value per frame."""
    unknown = [repr(name) for name in overrides if name not in OVERRIDES]
    if unknown:
        raise ValueError(f"unknown key {', '.join(unknown)} in `dicom:`; the keys are {', '.join(OVERRIDES)}")
    stated = {}
    for name, value in overrides.items():
        alone = not isinstance(value, list) or (name == "pixel" and not any(isinstance(part, list) for part in value))
        values = [value] * frames if alone else value
        if len(values) != frames:
            raise ValueError(f"`{name}` in `dicom:` has {len(values)} values for {frames} views; give one, or one each")
        stated[name] = [_stated(name, value) for value in values]
    return stated


def _stated(name: str, value):
    """One frame's value of an override. Raises ValueError where it is of the wrong kind."""
    if name == "patient_orientation":
        if not isinstance(value, str):
            raise ValueError(f"`{name}` in `dicom:` is a text such as 'L\\F', but {value!r} was given")
        return value
    try:
        return tuple(np.broadcast_to(np.asarray(value, float), 2).tolist()) if name == "pixel" else float(value)
    except (TypeError, ValueError) as error:
        raise ValueError(f"`{name}` in `dicom:` needs {'[row height, column width]' if name == 'pixel' else 'a number'}, "
                         f"but {value!r} was given") from error


def _pose(tags: DicomTags, stated: dict, turned: bool) -> tuple[np.ndarray, ...]:
    """Source, detector's centre, u and v (3,) in RAS+ mm of one frame."""
    values = {name: stated.get(name, getattr(tags, name)) for name in OVERRIDES}
    _check(tags, values)
    p, s = math.radians(values["primary_degrees"]), math.radians(values["secondary_degrees"])
    towards = np.array([-math.sin(p) * math.cos(s), math.cos(p) * math.cos(s), math.sin(s)])
    right = np.array([-math.cos(p), -math.sin(p), 0.0])  # of a viewer at the detector, head up
    columns, rows = right, np.cross(right, towards)
    if values["patient_orientation"] is not None:
        columns, rows = _oriented(tags.name, values["patient_orientation"], right, rows)
    height, width = reversed(values["pixel"]) if turned else values["pixel"]
    to_isocentre, to_detector = values["source_to_isocentre"], values["source_to_detector"]
    return -to_isocentre * towards, (to_detector - to_isocentre) * towards, width * columns, height * rows


def _check(tags: DicomTags, values: dict) -> None:
    middle = "DistanceSourceToPatient" if tags.angiographic else "EstimatedRadiographicMagnificationFactor"
    keywords = dict(zip(OVERRIDES, ("DistanceSourceToDetector", middle, "ImagerPixelSpacing", "PositionerPrimaryAngle",
                                    "PositionerSecondaryAngle", "PatientOrientation")))
    missing = [name for name in OVERRIDES if values[name] is None]
    if tags.angiographic and "patient_orientation" in missing:
        missing.remove("patient_orientation")
    if missing:
        named = ", ".join(f"{keywords[name]} {_tag(keywords[name])}" for name in missing)
        raise ValueError(f"{tags.name} lacks {named}, so its geometry is unknown; state `beam: {{dicom: "
                         f"{{{', '.join(f'{name}: ...' for name in missing)}}}}}` in geometry.yaml")
    for name in OVERRIDES[:3]:
        numbers = np.asarray(values[name], float)
        if not (np.isfinite(numbers).all() and (numbers > 0).all()):
            raise ValueError(f"{tags.name}: {name} is {values[name]} (from {keywords[name]} or geometry.yaml), but it "
                             f"must be positive; state `beam: {{dicom: {{{name}: ...}}}}` in mm in geometry.yaml")
    near, far = values["source_to_isocentre"], values["source_to_detector"]
    if not near < far:
        raise ValueError(f"{tags.name}: the isocentre must lie between source and detector, but source_to_isocentre="
                         f"{near:g} mm and source_to_detector={far:g} mm were found; correct them under "
                         "`beam: {dicom: ...}` in geometry.yaml")


def _tag(keyword: str) -> str:
    tag = pydicom.tag.Tag(tag_for_keyword(keyword))
    return f"({tag.group:04x},{tag.element:04x})"


def _oriented(name: str, orientation, right: np.ndarray, down: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The unit steps of columns and rows that lie in the detector's plane and agree best with PatientOrientation."""
    letters = orientation.split("\\") if isinstance(orientation, str) else list(orientation)
    steps, along = [], []
    for word in letters:
        if not word or any(letter not in DIRECTIONS for letter in word):
            raise ValueError(f"{name}: PatientOrientation {letters} must name directions by R, L, A, P, H, F")
        wanted = sum(np.array(DIRECTIONS[letter], float) for letter in word)
        steps.append(max((right, -right, down, -down), key=lambda step: step @ wanted))
        along.append(steps[-1] @ wanted / max(np.linalg.norm(wanted), 1e-12))
    if len(steps) != 2 or abs(steps[0] @ steps[1]) > 0.5 or min(along) < 0.3:
        raise ValueError(f"{name}: PatientOrientation {letters} does not give two directions across this view; correct "
                         "it or the positioner angles under `beam: {dicom: ...}` in geometry.yaml")
    return steps[0], steps[1]
