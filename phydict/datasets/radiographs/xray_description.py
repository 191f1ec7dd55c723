"""geometry.yaml: where the X-rays of a folder were taken, what their pixels mean and what way their images are turned.

    beam:                                                # ConeBeam's YAML, which may also stand at the top level
      orbit: {views: 8, source_to_detector: 1020.0, source_to_isocentre: 740.0, shape: [448, 448], pixel: [1.25, 1.25]}
    # beam: {file: geometry.xml, pixel: [1.25, 1.25]}    # a file that phydict.xray.geometry_files reads, beside this
    #                                                    # one; pixel is for RTK's XML and matrices
    # beam: {dicom: {source_to_isocentre: 765.0}}        # values used instead of tags; see
    #                                                    # phydict.datasets.radiographs.dicom_beam
    intensity: {kind: counts, air: 50000}                # see phydict.datasets.intensity
    orientation: {rotate_degrees: 0, flip_rows: false, flip_columns: false}
    uncertain: {detector_shift_mm: 5, rotation_degrees: 2}    # what is not exactly known, for --calibrate; see
    #                                                         # phydict.xray.poses.uncertain
    continued: true                                      # the patient continues above and below the volume
    mu_water: 0.0206                                     # 1/mm that water attenuates in these X-rays

Without `beam:` the tags of DICOM images decide. Rotation is clockwise, in quarters, and comes before the flips. The
beam, wherever it comes from, is that of the images once they are turned.
"""

from __future__ import annotations

import reprlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml

from phydict.datasets.dicom import DicomTags
from phydict.datasets.intensity import KINDS, Intensity, is_file_name
from phydict.datasets.radiographs.dicom_beam import tags_beam
from phydict.runtime.files import atomic_write
from phydict.runtime.reading import naming
from phydict.runtime.yaml_file import read_yaml
from phydict.xray.geometry import ConeBeam
from phydict.xray.geometry_files import read_beam
from phydict.xray.poses.uncertain import Uncertain, by_hand
from phydict.xray.stated import pixel_sizes

GEOMETRY = "geometry.yaml"

WATER = (0.005, 0.1)
"""1/mm that water attenuates from 20 keV to 1 MeV, and some more."""


@dataclass(frozen=True)
class Orientation:
    """How stored images are turned until row 0 is superior: clockwise by rotate_degrees, then flipped."""

    rotate_degrees: int = 0
    flip_rows: bool = False
    flip_columns: bool = False

    def __post_init__(self):
        flips = [self.flip_rows, self.flip_columns]
        if not all(isinstance(flip, bool) for flip in flips):
            raise ValueError(f"flip_rows and flip_columns are true or false, but {flips} was given")
        if isinstance(self.rotate_degrees, bool) or self.rotate_degrees not in (0, 90, 180, 270):
            raise ValueError(f"rotate_degrees is 0, 90, 180 or 270, but {self.rotate_degrees!r} was given")
        object.__setattr__(self, "rotate_degrees", int(self.rotate_degrees))

    @property
    def turned(self) -> bool:
        """Whether rows become columns."""
        return self.rotate_degrees in (90, 270)

    def shape(self, stored: tuple[int, int]) -> tuple[int, int]:
        """The shape (V, U) of a stored image once it is turned."""
        return stored[::-1] if self.turned else stored

    def apply(self, images: np.ndarray) -> np.ndarray:
        """Images (K, V, U), turned."""
        images = np.rot90(images, -(self.rotate_degrees // 90), axes=(1, 2))
        return images[:, ::-1 if self.flip_rows else 1, ::-1 if self.flip_columns else 1]


@dataclass(frozen=True)
class Description:
    """What one geometry file says. source: the file; beam: its mapping, None where the tags of DICOM images decide;
    continued: as ConeBeam's, whatever states the beam; None: as the beam says; mu_water: what water attenuates in 1/mm,
    None where a method's own is taken."""

    source: Path
    beam: dict | None = None
    intensity: Intensity | None = None
    orientation: Orientation = Orientation()
    uncertain: Uncertain | None = None
    continued: bool | None = None
    mu_water: float | None = None

    @property
    def views(self) -> int | None:
        """How many views the beam's mapping states, None where other files do or it states none that can be counted."""
        beam = self.beam or {}
        if isinstance(beam.get("orbit"), dict):
            return beam["orbit"]["views"] if type(beam["orbit"].get("views")) is int else None
        return len(beam["sources"]) if isinstance(beam.get("sources"), list) else None

    def beam_of(self, shape: tuple[int, int], tags: list[DicomTags]) -> ConeBeam:
        """The beam for images of `shape` (V, U), turned, and their DICOM tags, if any. Raises ValueError."""
        beam = self._stated_beam(shape, tags)
        with naming(self.source):
            return beam.with_continued(self.continued)

    def _stated_beam(self, shape: tuple[int, int], tags: list[DicomTags]) -> ConeBeam:
        beam = self.beam or {}
        if self._left_to_tags:
            if not tags:
                raise ValueError(f"{self.source} leaves the beam to DICOM's tags, but the images are not DICOM, so "
                                 "that they have no scale; state `beam:` with pixel size and distances in mm")
            tagged = next((tag.name for tag in tags if tag.patient_orientation), None)
            stated = "patient_orientation" in (beam.get("dicom") or {})
            if tagged and not stated and self.orientation != Orientation():
                raise ValueError(f"{self.source}: PatientOrientation of {tagged} says already how its image is turned: "
                                 "leave `orientation:` out, or state that of the turned image as `beam: {dicom: "
                                 "{patient_orientation: ...}}`")
            return tags_beam(tags, shape, beam.get("dicom"), self.orientation.turned,
                             f"`dicom:` of {self.source}")
        if "file" in beam:
            return read_beam(self.source.parent / beam["file"], shape, beam.get("pixel"))
        with naming(self.source):
            return ConeBeam.from_dict(beam)

    @property
    def _left_to_tags(self) -> bool:
        return self.beam is None or "dicom" in self.beam

    def uncertain_of(self, beam: ConeBeam, tags: list[DicomTags]) -> Uncertain | None:
        """What is not sure of the beam: what the file says or, where CR and DX tags state the beam, what is usual."""
        usual = self._left_to_tags and not any(frame.angiographic for frame in tags)
        return by_hand(beam) if self.uncertain is None and usual else self.uncertain

    def reference_files(self, intensity: Intensity | None) -> dict[str, list[Path]]:
        """The flat and dark images that an intensity names, beside the geometry file."""
        names = intensity.references if intensity else {}
        return {name: [self.source.parent / file for file in files] for name, files in names.items()}

    def named_files(self) -> list[Path]:
        """The files that it names: of the beam, of flat and of dark images."""
        beam = [self.source.parent / self.beam["file"]] if self.beam and "file" in self.beam else []
        return beam + [file for files in self.reference_files(self.intensity).values() for file in files]


def read_description(path: Path, needed: bool = True) -> Description:
    """Read geometry.yaml, or a file of another program's geometry, whose name becomes the beam's `file`.

    needed: whether a missing file is an error; otherwise DICOM's tags say everything.
    Raises FileNotFoundError, and ValueError naming the file and the key.
    """
    if not path.is_file():
        if not needed:
            return Description(path)
        raise FileNotFoundError(f"there is no geometry file {path}; write one with `beam:` and `intensity:` beside the "
                                "images, or give a file by --data.geometry (in Python geometry=)")
    if path.suffix.lower() not in (".yaml", ".yml"):
        return Description(path, {"file": path.name})
    content = read_yaml(path)
    if not isinstance(content, dict):
        raise ValueError(f"{path} must hold `beam:`, and may hold `intensity:`, `orientation:`, `uncertain:`, "
                         "`continued:` and `mu_water:`")
    intensity, orientation = content.pop("intensity", None) or {}, content.pop("orientation", None) or {}
    uncertain, continued = content.pop("uncertain", None), content.pop("continued", None)
    if not isinstance(continued, bool | None):
        raise ValueError(f"{path}: `continued:` is true or false, but {reprlib.repr(continued)} was found")
    if not isinstance(mu_water := content.pop("mu_water", None), float | None) or not (
            mu_water is None or WATER[0] < mu_water < WATER[1]):
        raise ValueError(f"{path}: `mu_water:` is what water attenuates in 1/mm, between {WATER[0]} and {WATER[1]}, "
                         f"but {reprlib.repr(mu_water)} was found")
    if "beam" in content and len(content) > 1:
        unknown = [reprlib.repr(key) for key in content if key != "beam"]
        raise ValueError(f"{path}: unknown key {', '.join(unknown)}; the keys are beam, intensity, orientation, "
                         "uncertain, continued, mu_water")
    beam = content.get("beam", content or None)
    _check_beam(path, beam)
    for block, value, kind in (("intensity", intensity, Intensity), ("orientation", orientation, Orientation)):
        keys = tuple(kind.__dataclass_fields__)
        unknown = [reprlib.repr(key) for key in value if key not in keys] if isinstance(value, dict) else [
            reprlib.repr(value)]
        if unknown:
            raise ValueError(f"{path}: unknown {', '.join(unknown)} in `{block}:`; the keys are {', '.join(keys)}")
    if intensity and "kind" not in intensity:
        raise ValueError(f"{path}: `intensity:` needs `kind`, one of {', '.join(KINDS)}")
    with naming(path):
        return Description(path, beam, Intensity(**intensity) if intensity else None, Orientation(**orientation),
                           None if uncertain is None else Uncertain.from_dict(uncertain), continued, mu_water)


def save_geometry(path: Path, beam: ConeBeam, described: Description | None = None) -> None:
    """Write `beam` as geometry.yaml, with what `described`, the file of the same images, says of their intensity, of
    uncertain gains and offsets, which no beam holds, and of orientation; images that it names are named with their
    folder."""
    content: dict = {"beam": beam.to_dict()}
    if described and described.intensity:
        folder = described.source.parent.absolute()
        names = {name: [str(folder / file) for file in files] for name, files in described.intensity.references.items()}
        content["intensity"] = {name: value for name, value in (vars(described.intensity) | names).items()
                                if value != getattr(Intensity, name, None)}
    if described:
        content["orientation"] = vars(described.orientation)
        if described.mu_water is not None:
            content["mu_water"] = described.mu_water
    if described and described.uncertain:
        open_still = {name: value for name in ("gain", "offset") if (value := getattr(described.uncertain, name))}
        content |= {"uncertain": open_still} if open_still else {}
    with atomic_write(path) as part:
        part.write_text(yaml.safe_dump(content, sort_keys=False, default_flow_style=None))


def _check_beam(path: Path, beam) -> None:
    """Raises ValueError unless `beam` is of a known form: the values are checked when the beam is built."""
    if beam is not None and not isinstance(beam, dict):
        raise ValueError(f"{path}: `beam:` must be a mapping, but {reprlib.repr(beam)} was found")
    beam = beam or {}
    for key, allowed in (("file", ("file", "pixel")), ("dicom", ("dicom",))):
        unknown = [reprlib.repr(name) for name in beam if key in beam and name not in allowed]
        if unknown:
            raise ValueError(f"{path}: unknown key {', '.join(unknown)} in `beam:`; the keys are {', '.join(allowed)}")
    if not is_file_name(beam.get("file", "")):
        raise ValueError(f"{path}: `file:` is the name of a geometry file, but {reprlib.repr(beam['file'])} was found")
    if "file" in beam and beam.get("pixel") is not None:
        with naming(path):
            pixel_sizes(beam["pixel"])
    if not isinstance(beam.get("dicom", {}), dict):
        raise ValueError(f"{path}: `dicom:` must be a mapping, but {reprlib.repr(beam['dicom'])} was found")
