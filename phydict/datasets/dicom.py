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
from pydicom.pixels import apply_modality_lut, pixel_array

from phydict.datasets.intensity import Intensity
from phydict.runtime.memory import check_memory
from phydict.runtime.reading import MOST_SQUEEZED, Unreadable, check_held, one_line, reading, refusing
from phydict.runtime.warning import warn

VIEW_POSITIONS = {"PA": 0.0, "LL": 90.0, "AP": 180.0, "RL": -90.0}

TILTS, LEVEL = ("DetectorPrimaryAngle", "DetectorSecondaryAngle", "ColumnAngulation"), 1.0
"""Tags of a detector or a tube that is tilted against the other, and the degrees below which it counts as level."""

EDGES = ("LeftVerticalEdge", "RightVerticalEdge", "UpperHorizontalEdge", "LowerHorizontalEdge")
"""Of a collimator or a shutter."""

COVERED = 0.02
"""The share of an image that a collimator or a shutter may cover: its outermost rows and columns."""

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
    distance. inverted: MONOCHROME1. relationship, sign: PixelIntensityRelationship(Sign). covered: the share of the
    pixels that lie beyond the edges of a rectangular collimator or shutter. patient: PatientID.
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
    covered: float
    patient: str


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
            raise Unreadable(f"{path} holds no image (PixelData), as reports of dose and presentation states do not: "
                             "take it out of the folder")
        if lacking := [keyword for keyword in ("Rows", "Columns") if dataset.get(keyword) is None]:
            raise ValueError(f"it lacks {' and '.join(lacking)}")
        pixels = int(dataset.Rows) * int(dataset.Columns) * int(dataset.get("NumberOfFrames") or 1)
        check_held(pixels, path, "pixels", 8 * MOST_SQUEEZED)
        check_memory(8 * pixels, "what its tags promise", "give a smaller one")
        stored = _stored(dataset)
    images = stored[None] if stored.ndim == 2 else stored
    several = len(images) > 1
    frames = [Frame(dataset, f"{path} frame {k + 1}" if several else str(path), k) for k in range(len(images))]
    return [(_values(image, frame, padding), _tags(frame)) for image, frame in zip(images, frames)]


def _stored(dataset: pydicom.Dataset) -> np.ndarray:
    """The stored values of all frames. Raises ValueError where unsigned ones have bits beyond BitsStored that hold no
    overlay, as those of old files do."""
    if dataset.get("PixelRepresentation") or dataset.BitsStored >= dataset.BitsAllocated or (
            dataset.file_meta.TransferSyntaxUID.is_compressed):
        return dataset.pixel_array
    values, most = pixel_array(dataset, correct_unused_bits=False), 2**dataset.BitsStored - 1
    overlays = (dataset.get((group, 0x0102)) for group in range(0x6000, 0x6020, 2))
    cut = int((values > most).sum())
    if cut and not any(overlay.value for overlay in overlays if overlay):
        raise ValueError(f"{cut} of its values need more than its {dataset.BitsStored} BitsStored, and would be cut "
                         "off there; correct BitsStored and HighBit, or what lies in the other bits")
    return values & most


def warn_of_frames(tags: list[DicomTags]) -> None:
    """Warns of frames of different patients, and of those that a collimator or a shutter covers in part."""
    known = [frame for frame in tags if frame.patient]
    if other := next((frame for frame in known if frame.patient != known[0].patient), None):
        warn(f"{known[0].name} and {other.name} have different PatientID, but the X-rays of a folder are taken as one "
             "patient's: keep those of each in a folder of their own")
    most = max(tags, key=lambda frame: frame.covered)
    if most.covered > COVERED:
        warn(f"{most.name}: {most.covered:.0%} of its pixels lie beyond the edges of a collimator or a shutter "
             "(CollimatorLeftVerticalEdge, ShutterLeftVerticalEdge and so on), where what is stored may be no X-ray: "
             "crop the views to the exposed field, and state shape and the detector's shift in geometry.yaml")


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


@dataclass(frozen=True)
class Frame:
    """Where the tags of one frame are looked for: in its own functional groups, the shared ones, and the file.

    name: of file and frame, for messages; index: in the file.
    """

    dataset: pydicom.Dataset
    name: str
    index: int = 0

    def find(self, keyword: str):
        """A tag's value; None if empty. Raises ValueError naming the tag and the frame where it cannot be read."""
        with reading(f"{keyword} of {self.name}", "export it again, or correct that tag"):
            groups = []
            for group, index in (("PerFrameFunctionalGroupsSequence", self.index),
                                 ("SharedFunctionalGroupsSequence", 0)):
                sequence = self.dataset.get(group) or []
                groups += [item[0] for element in (sequence[index] if index < len(sequence) else [])
                           if (item := element.value) and element.VR == "SQ"]
            for group in (*groups, self.dataset):
                value = group.get(keyword)
                if value is not None and value != "" and not (hasattr(value, "__len__") and len(value) == 0):
                    return value
        return None

    def word(self, keyword: str) -> str:
        """A tag that holds one word, of which DICOM allows 16 characters; "" where it is empty."""
        return one_line(str(self.find(keyword) or ""))[:16]

    def numbers(self, keyword: str, count: int | None = None) -> tuple[float, ...] | None:
        """The finite numbers of a tag, `count` of them if it is given; None where the tag is empty.

        Raises ValueError naming the tag and the frame.
        """
        value = self.find(keyword)
        if value is None:
            return None
        wanted = "numbers" if count is None else "a number" if count == 1 else f"{count} finite numbers"
        try:
            numbers = tuple(float(part) for part in (value if isinstance(value, MultiValue) else [value]))
        except (TypeError, ValueError, OverflowError):
            numbers = (math.nan,)
        if len(numbers) != (count or len(numbers)) or not all(map(math.isfinite, numbers)):
            raise ValueError(f"{self.name}: {keyword} must be {wanted}, but {reprlib.repr(value)} was found")
        return numbers

    def number(self, keyword: str) -> float | None:
        numbers = self.numbers(keyword, 1)
        return None if numbers is None else numbers[0]

    def angle(self, keyword: str) -> float | None:
        """A positioner angle with its increment: one value per frame counts from the first, a single one is the step;
        NaN where their number is another, as in a part of a run."""
        angle = self.number(keyword)
        if angle is None or (steps := self.numbers(f"{keyword}Increment")) is None:
            return angle
        if len(steps) == 1:
            return angle + self.index * steps[0]
        return angle + steps[self.index] if len(steps) == int(self.dataset.get("NumberOfFrames") or 1) else math.nan


def _values(stored: np.ndarray, frame: Frame, padding: float | None) -> np.ndarray:
    """Stored values (V, U) after the modality transform, with padding as `read_dicom` says."""
    values, padded = _rescaled(stored, frame), _padded(stored, frame)
    if not padded.any():
        return values
    if padding is None:
        raise ValueError(f"{int(padded.sum())} pixels of {frame.name} are padding (PixelPaddingValue "
                         f"{frame.find('PixelPaddingValue')}): crop the views to the exposed field, "
                         "and state shape and the detector's shift in geometry.yaml, or remove that tag if they are no "
                         "padding")
    regions, _ = scipy.ndimage.label(np.pad(padded, 1, constant_values=True))
    outside = regions[1:-1, 1:-1] == regions[0, 0]
    return np.where(outside, np.minimum(values, padding), values)


def _padded(stored: np.ndarray, frame: Frame) -> np.ndarray:
    """Which stored values (V, U) lie between PixelPaddingValue and PixelPaddingRangeLimit, both included."""
    value, limit = (frame.number(f"PixelPadding{part}") for part in ("Value", "RangeLimit"))
    if value is None:
        return np.zeros(stored.shape, bool)
    ends = np.array([int(value), int(value if limit is None else limit)]).astype(stored.dtype)  # some lack a sign
    return (stored >= ends.min()) & (stored <= ends.max())


def _rescaled(pixels: np.ndarray, frame: Frame) -> np.ndarray:
    """Stored values after the modality transform. The LUT of a LOG image leads back to intensity (PS3.3 C.8.7.1.1.2),
    which is no display image, so that it is passed over."""
    if "ModalityLUTSequence" in frame.dataset and frame.word("PixelIntensityRelationship") != "LOG":
        with reading(f"the modality LUT of {frame.name}", "export it with RescaleSlope and RescaleIntercept"):
            return np.asarray(apply_modality_lut(pixels, frame.dataset), np.float64)
    slope, intercept = (frame.number(f"Rescale{part}") for part in ("Slope", "Intercept"))
    return pixels * (1.0 if slope is None else slope) + (intercept or 0.0)


def _tags(frame: Frame) -> DicomTags:
    angiographic = frame.word("Modality") in ("XA", "RF")
    to_isocentre = magnification = None
    if angiographic:
        to_isocentre = frame.number("DistanceSourceToIsocenter")
        if to_isocentre is None:
            to_isocentre = frame.number("DistanceSourceToPatient")
    else:
        magnification = frame.number("EstimatedRadiographicMagnificationFactor")
    primary = frame.angle("PositionerPrimaryAngle")
    secondary = frame.angle("PositionerSecondaryAngle")
    view = VIEW_POSITIONS.get(frame.word("ViewPosition"))
    if view is not None:
        primary = view if primary is None else primary
        secondary = secondary or 0.0
    turn = frame.number("FieldOfViewRotation") or 0.0
    reoriented = " and ".join([f"rotated by {turn:g} degrees"] * bool(turn) + ["flipped"] * (
        frame.word("FieldOfViewHorizontalFlip") == "YES"))
    tilts = {keyword: frame.number(keyword) or 0.0 for keyword in TILTS}
    detector = " and ".join(f"{keyword} {degrees:g}" for keyword, degrees in tilts.items() if abs(degrees) > LEVEL)
    orientation = frame.find("PatientOrientation")
    if orientation is not None:
        letters = orientation if isinstance(orientation, MultiValue) else str(orientation).split("\\")
        orientation = tuple(map(str, letters)) if any(letters) else None
    sign = frame.number("PixelIntensityRelationshipSign")
    if sign and (frame.number("RescaleSlope") or 1) < 0:
        sign = -sign  # the tag speaks of stored values
    patient = one_line(str(frame.find("PatientID") or ""))
    return DicomTags(
        frame.name, frame.index, frame.number("DistanceSourceToDetector"), to_isocentre, magnification,
        frame.numbers("ImagerPixelSpacing", 2), primary, secondary, view, orientation, reoriented,
        detector, angiographic, frame.word("PhotometricInterpretation") == "MONOCHROME1",
        frame.word("PixelIntensityRelationship"), None if sign is None else int(sign), _covered(frame), patient)


def _covered(frame: Frame) -> float:
    """The share of a frame's pixels beyond the edges of its collimator or shutter, rows and columns counted from 1."""
    seen = [1.0]
    for kind in ("Collimator", "Shutter"):
        edges = [value for edge in EDGES if (value := frame.number(f"{kind}{edge}")) is not None]
        if "RECTANGULAR" in str(frame.find(f"{kind}Shape")) and len(edges) == len(EDGES):
            left, right, upper, lower = edges
            columns, rows = int(frame.dataset.Columns), int(frame.dataset.Rows)
            wide, high = min(right, columns) - max(left, 1) + 1, min(lower, rows) - max(upper, 1) + 1
            if wide > 0 and high > 0:  # tags that nobody filled in leave nothing
                seen.append(wide * high / (columns * rows))
    return 1 - min(seen)
