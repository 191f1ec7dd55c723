"""DICOM radiographs (CR, DX) and angiographic or fluoroscopic runs (XA, RF): images, and what their tags say.

Pixels: rescale slope and intercept, or the modality LUT but that of LOG images, are applied; the VOI window, a choice
for the eye, never is.
Padding is told by the values as they are stored (PS3.3 C.7.5.1.1.2). MONOCHROME1 says how values are shown, so it
inverts display images alone. Tags are looked for in a frame's own functional groups, in the shared ones, and in the
file. The beam they state is phydict.datasets.radiographs.dicom_beam's.
"""

from __future__ import annotations

import math
import reprlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pydicom
import scipy
from pydicom.multival import MultiValue
from pydicom.pixels import apply_modality_lut

from phydict.datasets.intensity import Intensity
from phydict.runtime.reading import MOST_SQUEEZED, check_held, check_memory, one_line, reading, refusing

VIEW_POSITIONS = {"PA": 0.0, "LL": 90.0, "AP": 180.0, "RL": -90.0}

TILTS, LEVEL = ("DetectorPrimaryAngle", "DetectorSecondaryAngle", "ColumnAngulation"), 1.0
"""Tags of a detector or a tube that is tilted against the other, and the degrees below which it counts as level."""


FALLING = ("its values fall where more X-rays arrive: give it a RescaleSlope of the other sign, a RescaleIntercept "
           "by which no value is negative, and state `intensity: {kind: counts, air: ...}` in geometry.yaml, or state "
           "{kind: display, bright_is_dense: ...} there")
"""What to do with values of sign -1 that are not logarithmic."""


@dataclass(frozen=True)
class DicomTags:
    """What the tags of one frame say of its geometry and pixel values; None or "" where they are silent, NaN of angles
    that they leave open.

    name: of file and frame; frame: its index in the file. Lengths in mm, angles in degrees; pixel: (row height, column
    width); view_degrees: of ViewPosition; patient_orientation: letters of the directions in which (columns, rows) of
    the file's first frame run. reoriented: how the image was flipped or rotated since it was taken, in words; detector:
    how the detector is tilted against the beam, in words. magnification: of CR and DX, detector over isocentre
    distance. inverted: MONOCHROME1. relationship, sign: PixelIntensityRelationship(Sign).
    """

    name: str
    frame: int
    source_to_detector: float | None
    source_to_isocentre: float | None
    magnification: float | None
    pixel: tuple[float, ...] | None
    primary_degrees: float | None
    secondary_degrees: float | None
    view_degrees: float | None
    patient_orientation: tuple[str, str] | None
    reoriented: str
    detector: str
    angiographic: bool
    inverted: bool
    relationship: str
    sign: int | None


def open_dicom(path: Path, **settings) -> pydicom.Dataset:
    """`pydicom.dcmread` of a file that is not deflated as a whole: a small one of those may take any memory. For use
    inside `reading`: raises ValueError for those, and whatever a damaged one leads pydicom to."""
    with path.open("rb") as stream:
        if stream.read(132)[128:] == b"DICM" and pydicom.filereader.read_file_meta_info(path).get(
                "TransferSyntaxUID") == pydicom.uid.DeflatedExplicitVRLittleEndian:
            raise ValueError("it is deflated as a whole, which is not read")
    return pydicom.dcmread(path, **settings)


def read_dicom(path: Path, padding: float | None = None) -> list[tuple[np.ndarray, DicomTags]]:
    """The frames of a DICOM file: pixels (V, U) float64 after the modality transform, and their tags.

    padding: the most that padding which reaches an edge of its image is read as; None: an image may have no padding.
    Raises ValueError naming the file where it cannot be read or decoded, is not grey, or has padding.
    """
    with refusing(path, "export it again, uncompressed"):
        return _frames(path, padding)


def _frames(path: Path, padding: float | None) -> list[tuple[np.ndarray, DicomTags]]:
    with reading(f"the DICOM file {path}", "export it again, uncompressed"):
        dataset = open_dicom(path)
        if dataset.get("SamplesPerPixel", 1) != 1:
            raise ValueError(f"it has {dataset.SamplesPerPixel} colours per pixel; export it as grey")
        if "PixelData" not in dataset:
            raise ValueError("it holds no image")
        if lacking := [keyword for keyword in ("Rows", "Columns") if dataset.get(keyword) is None]:
            raise ValueError(f"it lacks {' and '.join(lacking)}")
        pixels = int(dataset.Rows) * int(dataset.Columns) * int(dataset.get("NumberOfFrames") or 1)
        check_held(pixels, path, "pixels", 8 * MOST_SQUEEZED)
        check_memory(8 * pixels, "what its tags promise", "give a smaller one")
        stored = dataset.pixel_array
    frames = stored[None] if stored.ndim == 2 else stored
    several = len(frames) > 1
    names = [f"{path} frame {k + 1}" if several else str(path) for k in range(len(frames))]
    return [(_values(frame, dataset, k, name, padding), _tags(dataset, k, name))
            for k, (frame, name) in enumerate(zip(frames, names))]


def tags_intensity(tags: list[DicomTags]) -> Intensity:
    """What the pixel values mean by the tags alone: LOG images are display images of known polarity.

    Raises ValueError where the tags do not suffice: linear images need the air value, which no tag holds.
    """
    first = tags[0]
    if first.relationship == "LOG" and first.sign in (1, -1):
        return Intensity("display", bright_is_dense=(first.sign == -1) != first.inverted)
    advice = "state `intensity:` in geometry.yaml: kind line_integrals, counts or display"
    if first.relationship == "LIN":
        advice = FALLING if first.sign == -1 else (
            "state `intensity: {kind: counts, air: ...}` in geometry.yaml, air being the value without a patient")
    sign = f", sign {first.sign}" if first.sign else ""
    raise ValueError(f"{first.name} has PixelIntensityRelationship {first.relationship or 'unknown'}{sign}, from which "
                     f"line integrals do not follow; {advice}")


def shown(intensity: Intensity, tags: list[DicomTags]) -> Intensity:
    """An intensity stated for the images as they are shown, for the values as they are stored.

    Raises ValueError where counts are stated of images whose tags say that they are logarithmic or inverted.
    """
    for frame in tags:
        if intensity.kind == "counts" and (frame.relationship == "LOG" or frame.sign == -1):
            raise ValueError(f"{frame.name} is declared as counts, but its PixelIntensityRelationship is "
                             f"{frame.relationship or 'unknown'}, sign {frame.sign}: "
                             + ("correct `intensity:`" if frame.relationship == "LOG" else FALLING))
    if intensity.kind != "display" or not tags[0].inverted:
        return intensity
    return Intensity("display", bright_is_dense=not intensity.bright_is_dense)


def _find(dataset: pydicom.Dataset, frame: int, keyword: str, name: str):
    """A tag's value for one frame: from its own functional groups, the shared ones, or the file; None if empty.

    Raises ValueError naming the tag and the frame's `name` where it cannot be read.
    """
    with reading(f"{keyword} of {name}", "export it again, or correct that tag"):
        groups = []
        for group, index in (("PerFrameFunctionalGroupsSequence", frame), ("SharedFunctionalGroupsSequence", 0)):
            sequence = dataset.get(group) or []
            groups += [item[0] for element in (sequence[index] if index < len(sequence) else [])
                       if (item := element.value) and element.VR == "SQ"]
        for group in (*groups, dataset):
            value = group.get(keyword)
            if value is not None and value != "" and not (hasattr(value, "__len__") and len(value) == 0):
                return value
    return None


def _values(stored: np.ndarray, dataset: pydicom.Dataset, frame: int, name: str, padding: float | None) -> np.ndarray:
    """Stored values (V, U) after the modality transform, with padding as `read_dicom` says."""
    values, padded = _rescaled(stored, dataset, frame, name), _padded(stored, dataset, frame, name)
    if not padded.any():
        return values
    if padding is None:
        raise ValueError(f"{int(padded.sum())} pixels of {name} are padding (PixelPaddingValue "
                         f"{_find(dataset, frame, 'PixelPaddingValue', name)}): crop the views to the exposed field, "
                         "and state shape and the detector's shift in geometry.yaml, or remove that tag if they are no "
                         "padding")
    regions, _ = scipy.ndimage.label(np.pad(padded, 1, constant_values=True))
    outside = regions[1:-1, 1:-1] == regions[0, 0]
    return np.where(outside, np.minimum(values, padding), values)


def _padded(stored: np.ndarray, dataset: pydicom.Dataset, frame: int, name: str) -> np.ndarray:
    """Which stored values (V, U) lie between PixelPaddingValue and PixelPaddingRangeLimit, both included."""
    value, limit = (_number(dataset, frame, f"PixelPadding{part}", name) for part in ("Value", "RangeLimit"))
    if value is None:
        return np.zeros(stored.shape, bool)
    ends = np.array([int(value), int(value if limit is None else limit)]).astype(stored.dtype)  # some lack a sign
    return (stored >= ends.min()) & (stored <= ends.max())


def _rescaled(pixels: np.ndarray, dataset: pydicom.Dataset, frame: int, name: str) -> np.ndarray:
    """Stored values after the modality transform. The LUT of a LOG image leads back to intensity (PS3.3 C.8.7.1.1.2),
    which is no display image, so that it is passed over."""
    if "ModalityLUTSequence" in dataset and _code(dataset, frame, "PixelIntensityRelationship", name) != "LOG":
        with reading(f"the modality LUT of {name}", "export it with RescaleSlope and RescaleIntercept"):
            return np.asarray(apply_modality_lut(pixels, dataset), np.float64)
    slope, intercept = (_number(dataset, frame, f"Rescale{part}", name) for part in ("Slope", "Intercept"))
    return pixels * (1.0 if slope is None else slope) + (intercept or 0.0)


def _tags(dataset: pydicom.Dataset, frame: int, name: str) -> DicomTags:
    angiographic = _code(dataset, frame, "Modality", name) in ("XA", "RF")
    to_isocentre = magnification = None
    if angiographic:
        to_isocentre = _number(dataset, frame, "DistanceSourceToIsocenter", name)
        if to_isocentre is None:
            to_isocentre = _number(dataset, frame, "DistanceSourceToPatient", name)
    else:
        magnification = _number(dataset, frame, "EstimatedRadiographicMagnificationFactor", name)
    primary = _angle(dataset, frame, "PositionerPrimaryAngle", name)
    secondary = _angle(dataset, frame, "PositionerSecondaryAngle", name)
    view = VIEW_POSITIONS.get(_code(dataset, frame, "ViewPosition", name))
    if view is not None:
        primary = view if primary is None else primary
        secondary = secondary or 0.0
    turn = _number(dataset, frame, "FieldOfViewRotation", name) or 0.0
    reoriented = " and ".join([f"rotated by {turn:g} degrees"] * bool(turn) + ["flipped"] * (
        _code(dataset, frame, "FieldOfViewHorizontalFlip", name) == "YES"))
    tilts = {keyword: _number(dataset, frame, keyword, name) or 0.0 for keyword in TILTS}
    detector = " and ".join(f"{keyword} {degrees:g}" for keyword, degrees in tilts.items() if abs(degrees) > LEVEL)
    orientation = _find(dataset, frame, "PatientOrientation", name)
    if orientation is not None:
        letters = orientation if isinstance(orientation, MultiValue) else str(orientation).split("\\")
        orientation = tuple(map(str, letters))
    sign = _number(dataset, frame, "PixelIntensityRelationshipSign", name)
    if sign and (_number(dataset, frame, "RescaleSlope", name) or 1) < 0:
        sign = -sign  # the tag speaks of stored values
    return DicomTags(
        name, frame, _number(dataset, frame, "DistanceSourceToDetector", name), to_isocentre, magnification,
        tag_numbers(dataset, frame, "ImagerPixelSpacing", name, 2), primary, secondary, view, orientation, reoriented,
        detector, angiographic, _code(dataset, frame, "PhotometricInterpretation", name) == "MONOCHROME1",
        _code(dataset, frame, "PixelIntensityRelationship", name), None if sign is None else int(sign))


def _code(dataset: pydicom.Dataset, frame: int, keyword: str, name: str) -> str:
    """A tag that holds one word, of which DICOM allows 16 characters; "" where it is empty."""
    return one_line(str(_find(dataset, frame, keyword, name) or ""))[:16]


def tag_numbers(dataset: pydicom.Dataset, frame: int, keyword: str, name: str,
                count: int | None = None) -> tuple[float, ...] | None:
    """The finite numbers of a tag, `count` of them if it is given; None where the tag is empty.

    Raises ValueError naming the tag and the frame's `name`.
    """
    value = _find(dataset, frame, keyword, name)
    if value is None:
        return None
    wanted = "numbers" if count is None else "a number" if count == 1 else f"{count} finite numbers"
    try:
        numbers = tuple(float(part) for part in (value if isinstance(value, MultiValue) else [value]))
    except (TypeError, ValueError, OverflowError):
        numbers = (math.nan,)
    if len(numbers) != (count or len(numbers)) or not all(map(math.isfinite, numbers)):
        raise ValueError(f"{name}: {keyword} must be {wanted}, but {reprlib.repr(value)} was found")
    return numbers


def _number(dataset: pydicom.Dataset, frame: int, keyword: str, name: str) -> float | None:
    numbers = tag_numbers(dataset, frame, keyword, name, 1)
    return None if numbers is None else numbers[0]


def _angle(dataset: pydicom.Dataset, frame: int, keyword: str, name: str) -> float | None:
    """A positioner angle with its increment: one value per frame counts from the first, a single one is the step; NaN
    where their number is another, as in a part of a run."""
    angle = _number(dataset, frame, keyword, name)
    if angle is None or (steps := tag_numbers(dataset, frame, f"{keyword}Increment", name)) is None:
        return angle
    if len(steps) == 1:
        return angle + frame * steps[0]
    return angle + steps[frame] if len(steps) == int(dataset.get("NumberOfFrames") or 1) else math.nan
