"""The beam that the tags of DICOM X-rays state.

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

Rows and columns: where PatientOrientation says what way those of a file's first frame run, it is believed, and other
frames lie alike on the detector. Without it an XA or RF image is taken as head up and as seen from the detector (PS3.17
FFF.2.1.3), which shows the patient's right on the left in a PA view, unless it was flipped or rotated since it was
taken; a CR or DX image must have it.
"""

from __future__ import annotations

import math
import reprlib

import numpy as np
from pydicom.tag import Tag

from phydict.datasets.dicom import DicomTags
from phydict.runtime.warning import warn
from phydict.xray.geometry import ConeBeam
from phydict.xray.stated import MOST_MM

DIRECTIONS = {"R": (1, 0, 0), "L": (-1, 0, 0), "A": (0, 1, 0), "P": (0, -1, 0), "H": (0, 0, 1), "F": (0, 0, -1)}
OVERRIDES = ("source_to_detector", "source_to_isocentre", "pixel", "primary_degrees", "secondary_degrees",
             "patient_orientation")


def tags_beam(tags: list[DicomTags], shape: tuple[int, int], overrides: dict | None = None,
              turned: bool = False, source: str = "`dicom:`") -> ConeBeam:
    """The beam of the frames whose tags are given, for images of `shape` (V, U).

    overrides: values to use instead of the tags', one for all frames or a list with one per frame, by the names of
    OVERRIDES. turned: the images were turned by a quarter since they were stored, so that rows have become columns.
    source: where the overrides stand, for messages.
    Raises ValueError naming the frame and the tags that are missing, zero or contradictory.
    """
    stated, poses, axes = _per_frame(overrides or {}, len(tags), source), [], (0, 0)
    each = isinstance((overrides or {}).get("patient_orientation"), list)
    for k, frame in enumerate(tags):
        values = _values(frame, {name: of_frames[k] for name, of_frames in stated.items()})
        if each or not frame.frame:  # PatientOrientation is of a file's first frame (PS3.3 C.7.6.6.1)
            axes = _image_axes(frame, values)
        poses.append(_pose(values, axes, turned))
    if tilted := next((frame for frame in tags if frame.detector), None):
        warn(f"{tilted.name} has {tilted.detector} degrees, but the beam is taken as perpendicular to the detector: "
             "describe it by another form of `beam:` where that matters")
    sources, detectors, u, v = (np.stack(part) for part in zip(*poses))
    return ConeBeam(sources, detectors, u, v, shape)


def _per_frame(overrides: dict, frames: int, source: str) -> dict[str, list]:
    """Every override as a list with one value per frame."""
    unknown = [reprlib.repr(name) for name in overrides if name not in OVERRIDES]
    if unknown:
        raise ValueError(f"unknown key {', '.join(unknown)} in {source}; the keys are {', '.join(OVERRIDES)}")
    stated = {}
    for name, value in overrides.items():
        alone = not isinstance(value, list) or (name == "pixel" and not any(isinstance(part, list) for part in value))
        values = [value] * frames if alone else value
        if len(values) != frames:
            raise ValueError(f"`{name}` in {source} has {len(values)} values for {frames} views; give one, or one each")
        stated[name] = [_stated(name, value, source) for value in values]
    return stated


def _stated(name: str, value, source: str):
    """One frame's value of an override. Raises ValueError where it is of the wrong kind."""
    if name == "patient_orientation":
        if not isinstance(value, str):
            raise ValueError(f"`{name}` in {source} is a text such as 'L\\F', but {reprlib.repr(value)} was "
                             "given")
        return value
    parts = value if name == "pixel" and isinstance(value, list) and len(value) == 2 else [value]
    if not all(isinstance(part, int | float) and not isinstance(part, bool) and abs(part) < MOST_MM for part in parts):
        wanted = "[row height, column width]" if name == "pixel" else "a number"
        raise ValueError(f"`{name}` in {source} needs {wanted}, but {reprlib.repr(value)} was given")
    return float(value) if name != "pixel" else (float(parts[0]), float(parts[-1]))


def _values(tags: DicomTags, stated: dict) -> dict:
    """What is stated of one frame, or else its tags say, by the names of OVERRIDES."""
    values = {name: stated.get(name, getattr(tags, name)) for name in OVERRIDES}
    if values["source_to_isocentre"] is None and tags.magnification and values["source_to_detector"] is not None:
        values["source_to_isocentre"] = values["source_to_detector"] / tags.magnification
    _check(tags, values, "primary_degrees" in stated)
    return values


def _directions(values: dict) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Unit vectors (3,) towards the detector, and to the right and down for a viewer at the detector, head up."""
    p, s = math.radians(values["primary_degrees"]), math.radians(values["secondary_degrees"])
    towards = np.array([-math.sin(p) * math.cos(s), math.cos(p) * math.cos(s), math.sin(s)])
    right = np.array([-math.cos(p), -math.sin(p), 0.0])
    return towards, right, np.cross(right, towards)


def _sides(right: np.ndarray, down: np.ndarray) -> tuple[np.ndarray, ...]:
    return right, -right, down, -down


def _image_axes(tags: DicomTags, values: dict) -> tuple[int, int]:
    """Which of `_sides` the columns and the rows of a frame run to."""
    _, right, down = _directions(values)
    if values["patient_orientation"] is not None:
        return _oriented(tags.name, values["patient_orientation"], right, down)
    if tags.reoriented:
        raise ValueError(f"{tags.name} was {tags.reoriented} since it was taken (FieldOfViewRotation, "
                         "FieldOfViewHorizontalFlip): state which way its columns and rows run, `beam: {dicom: "
                         "{patient_orientation: ...}}` in geometry.yaml, such as 'L\\F'")
    return 0, 2


def _pose(values: dict, axes: tuple[int, int], turned: bool) -> tuple[np.ndarray, ...]:
    """Source, detector's centre, u and v (3,) in RAS+ mm of one frame."""
    towards, right, down = _directions(values)
    columns, rows = (_sides(right, down)[axis] for axis in axes)
    height, width = reversed(values["pixel"]) if turned else values["pixel"]
    to_isocentre, to_detector = values["source_to_isocentre"], values["source_to_detector"]
    return -to_isocentre * towards, (to_detector - to_isocentre) * towards, width * columns, height * rows


def _check(tags: DicomTags, values: dict, primary_stated: bool) -> None:
    middle = "DistanceSourceToPatient" if tags.angiographic else "EstimatedRadiographicMagnificationFactor"
    keywords = dict(zip(OVERRIDES, ("DistanceSourceToDetector", middle, "ImagerPixelSpacing", "PositionerPrimaryAngle",
                                    "PositionerSecondaryAngle", "PatientOrientation")))
    missing = [name for name in OVERRIDES if values[name] is None
               and not (name == "patient_orientation" and tags.angiographic)
               and not (name == "source_to_isocentre" and tags.magnification)]
    if missing:
        named = ", ".join(f"{keywords[name]} {_tag(keywords[name])}" for name in missing)
        raise ValueError(f"{tags.name} lacks {named}, so its geometry is unknown; state `beam: {{dicom: "
                         f"{{{', '.join(f'{name}: ...' for name in missing)}}}}}` in geometry.yaml")
    for name in OVERRIDES[:3]:
        numbers = np.asarray(values[name], float)
        if not (np.isfinite(numbers).all() and (numbers > 0).all()):
            raise ValueError(f"{tags.name}: {name} is {values[name]} (from {keywords[name]} or geometry.yaml), but it "
                             f"must be positive; state `beam: {{dicom: {{{name}: ...}}}}` in mm in geometry.yaml")
    for name in OVERRIDES[3:5]:
        if math.isnan(values[name]):
            raise ValueError(f"{tags.name}: {keywords[name]}Increment does not hold one value for each frame of its "
                             "file, as in a part of a run, so that the angle of this one is unknown; state `beam: "
                             f"{{dicom: {{{name}: [...]}}}}`, one value per view, in geometry.yaml")
    apart = abs((values["primary_degrees"] - (tags.view_degrees or 0) + 180) % 360 - 180)
    if tags.view_degrees is not None and not primary_stated and apart > 45:
        raise ValueError(f"{tags.name}: PositionerPrimaryAngle {values['primary_degrees']:g} contradicts ViewPosition, "
                         f"which means {tags.view_degrees:g}; state `beam: {{dicom: {{primary_degrees: ...}}}}` in "
                         "geometry.yaml")
    near, far = values["source_to_isocentre"], values["source_to_detector"]
    if not near < far:
        raise ValueError(f"{tags.name}: the isocentre must lie between source and detector, but source_to_isocentre="
                         f"{near:g} mm and source_to_detector={far:g} mm were found; correct them under "
                         "`beam: {dicom: ...}` in geometry.yaml")


def _tag(keyword: str) -> str:
    tag = Tag(keyword)
    return f"({tag.group:04x},{tag.element:04x})"


def _oriented(name: str, orientation, right: np.ndarray, down: np.ndarray) -> tuple[int, int]:
    """Which of `_sides` agree best with PatientOrientation's columns and rows."""
    sides = _sides(right, down)
    letters = orientation.split("\\") if isinstance(orientation, str) else list(orientation)
    shown, steps, along = reprlib.repr(letters), [], []
    for word in letters:
        if not word or any(letter not in DIRECTIONS for letter in word):
            raise ValueError(f"{name}: PatientOrientation {shown} must name directions by R, L, A, P, H, F")
        wanted = sum(np.array(DIRECTIONS[letter], float) for letter in word)
        steps.append(max(range(4), key=lambda side: sides[side] @ wanted))
        along.append(sides[steps[-1]] @ wanted / max(float(np.linalg.norm(wanted)), 1e-12))
    if len(steps) != 2 or steps[0] // 2 == steps[1] // 2 or min(along) < 0.3:
        raise ValueError(f"{name}: PatientOrientation {shown} does not give two directions across this view; correct "
                         "it or the positioner angles under `beam: {dicom: ...}` in geometry.yaml")
    return steps[0], steps[1]
