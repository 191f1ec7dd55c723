"""Where the X-ray sources and detectors are: the poses of a set of cone-beam views, in world millimetres."""

from __future__ import annotations

import math
import reprlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from phydict.grid import Grid, whole_sizes
from phydict.runtime.files import atomic_write
from phydict.runtime.memory import check_memory
from phydict.runtime.reading import naming
from phydict.runtime.yaml_file import read_yaml
from phydict.xray.orbits import on_circle, on_line, turned
from phydict.xray.stated import (
    LEAST_MM,
    MOST_MM,
    check_degrees,
    check_isocentre,
    check_keys,
    number_of,
    numbers_of,
    pixel_sizes,
    radians_of,
)

VECTOR_KEYS = ("sources", "detectors", "u", "v", "shape")
ORBIT_KEYS = ("views", "source_to_detector", "source_to_isocentre", "shape", "pixel")
ORBIT_OPTIONS = ("start_degrees", "arc_degrees", "start", "arc")
FORMS: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "orbit": (ORBIT_KEYS, ORBIT_OPTIONS), "angles": (("angles_degrees", *ORBIT_KEYS[1:]), ()),
    "sweep": ((*ORBIT_KEYS, "sweep_degrees"), ())}
"""Required and optional keys of the mappings that a YAML file may hold in place of vectors."""
CONTINUED = ("continued",)
PLACE_OPTIONS = ("detector_shift", "tilt_degrees")
INSTEAD = {"orbit": ", or angles_degrees: [...] in the place of views, start and arc",
           "angles": "; angles_degrees takes the place of views, start and arc"}
LISTS = ("shape", "pixel", "angles_degrees", "detector_shift")
LEAST_ARC_DEGREES = 1e-3
"""Several views over less of an arc would all come from one angle."""
SHORT_MM = 200
"""Of a distance from the source that may have been meant in another unit, where it fits no volume."""


@dataclass(frozen=True, eq=False)
class ConeBeam:
    """K cone-beam views onto flat detectors of V rows and U columns, in RAS+ world millimetres.

    sources, detectors: (K, 3) the focal spots and the detectors' centres.
    u, v: (K, 3) the step from one column to the next and from one row to the next, perpendicular to each other.
    shape: (V, U) pixels. Pixel (r, c) is centred on detector + (c - (U-1)/2) u + (r - (V-1)/2) v.
    continued: whether what a volume holds continues above and below it where rays meet it, each column as its end voxel
        does, as a patient is taller than a scan; False: there is nothing beyond. None: a reconstruction asks the X-rays
        (phydict.xray.beyond), and a projector sees nothing beyond.
    Raises ValueError for wrong shapes, non-finite numbers, degenerate detectors and a source in a detector's plane.
    """

    sources: np.ndarray
    detectors: np.ndarray
    u: np.ndarray
    v: np.ndarray
    shape: tuple[int, int]
    continued: bool | None = None

    def __post_init__(self):
        shape = whole_sizes(self.shape)
        if shape is None or len(shape) != 2:
            raise ValueError(f"a detector needs two positive sizes (rows, columns), whole numbers, but {self.shape} "
                             "was given")
        _check_room(len(np.atleast_1d(self.sources)), shape)
        object.__setattr__(self, "shape", shape)
        if not isinstance(self.continued, bool | None):
            raise ValueError("a beam's continued is true or false, or None, but "
                             f"{reprlib.repr(self.continued)} was given")
        for name in ("sources", "detectors", "u", "v"):
            value = np.array(getattr(self, name), float) + 0.0  # no negative zeros
            if value.ndim != 2 or value.shape[1] != 3 or len(value) < 1:
                raise ValueError(f"a beam's {name} must be (views, 3) numbers in mm, but shape {value.shape} was given")
            if len(value) != len(np.asarray(self.sources)):
                raise ValueError(f"a beam has {len(self.sources)} sources, but {len(value)} rows in {name}; "
                                 "give one row per view")
            if not (np.abs(value) < MOST_MM).all():
                wrong = int((~(np.abs(value) < MOST_MM).all(1)).argmax())
                raise ValueError(f"a beam's {name} must be finite numbers in mm, less than {MOST_MM:g}, but view "
                                 f"{wrong} has {value[wrong].tolist()}")
            value.setflags(write=False)
            object.__setattr__(self, name, value)
        if self.pixel.min() < LEAST_MM:
            raise ValueError(f"a beam's u and v, its pixels' sides, must be at least {LEAST_MM:g} mm long, but one of "
                             f"{self.pixel.min():g} mm was given")
        slant = np.abs((self.u * self.v).sum(1)) / self.pixel.prod(1)
        if slant.max() > 1e-4:
            raise ValueError(f"view {slant.argmax()}: u must be perpendicular to v, but the cosine of their angle is "
                             f"{slant.max():.2g}; give the steps along the rows and columns of a rectangular detector")
        flat = np.abs(self.distances) < 1e-6 * np.linalg.norm(self.detectors - self.sources, axis=1) + 1e-9
        if flat.any():
            raise ValueError(f"view {flat.argmax()}: the source lies in the plane of its detector; check that sources, "
                             "detectors, u and v are given in mm and in the same order")

    @classmethod
    def orbit(cls, views: int, source_to_detector: float, source_to_isocentre: float, shape: tuple[int, int],
              pixel: float | tuple[float, float], start: float | None = None, arc: float | None = None,
              start_degrees: float | None = None, arc_degrees: float | None = None) -> ConeBeam:
        """Upright detectors on a circle about the superior axis: view k stands at start + arc k / views.

        start (0) and arc (a full turn) are in radians, start_degrees and arc_degrees the same in degrees.
        Angle 0 is the PA view (source posterior, patient's right at the image's left, row 0 superior); at 90 degrees
        the source is at the patient's left. Distances and pixel = (row height, column width) in mm.
        Raises ValueError unless views >= 1 and 0 < source_to_isocentre < source_to_detector and pixel > 0, for an
        angle given twice or in radians beyond two turns, and for several views on an arc of less than 0.001 degrees.
        """
        count, sizes = whole_sizes(views), whole_sizes(shape)
        if count is None or len(count) != 1:
            raise ValueError(f"an orbit needs at least one view, a whole number, but views={reprlib.repr(views)} was "
                             "given")
        if sizes is not None and len(sizes) == 2:
            _check_room(count[0], sizes)
        check_isocentre(source_to_detector, source_to_isocentre)
        first, turn = radians_of("start", start, start_degrees, 0.0), radians_of("arc", arc, arc_degrees, 2 * math.pi)
        if count[0] > 1 and abs(turn) < math.radians(LEAST_ARC_DEGREES):
            raise ValueError(f"an orbit of {count[0]} views has an arc that they are spread over, but one of "
                             f"{math.degrees(turn):g} degrees, at which all come from one angle, was given: give "
                             f"{LEAST_ARC_DEGREES:g} degrees or more, leave the arc out for a full turn, or give one "
                             "view")
        if arc_degrees is not None:
            check_degrees("arc_degrees", arc_degrees, count[0])
        angles = first + turn * np.arange(int(views)) / int(views)
        return cls(*on_circle(angles, source_to_detector, source_to_isocentre, pixel_sizes(pixel)), shape)

    @classmethod
    def at_angles(cls, angles_degrees: Sequence[float], source_to_detector: float, source_to_isocentre: float,
                  shape: tuple[int, int], pixel: float | tuple[float, float]) -> ConeBeam:
        """Views of an orbit at any angles, in degrees, and in any order."""
        angles = numbers_of("angles_degrees", angles_degrees)
        if np.ndim(angles) != 1 or not np.size(angles):
            raise ValueError("angles_degrees is a list of an angle for each view, but "
                             f"{reprlib.repr(angles_degrees)} was given")
        check_degrees("angles_degrees", float(np.ptp(angles)), np.size(angles))
        check_isocentre(source_to_detector, source_to_isocentre)
        poses = on_circle(np.radians(angles), source_to_detector, source_to_isocentre, pixel_sizes(pixel))
        return cls(*poses, shape)

    @classmethod
    def sweep(cls, views: int, source_to_detector: float, source_to_isocentre: float, shape: tuple[int, int],
              pixel: float | tuple[float, float], sweep_degrees: float) -> ConeBeam:
        """Tomosynthesis: a resting PA detector, and a source that moves along a line from inferior to superior.

        sweep_degrees: the angle between the first and the last source, seen from the isocentre, in (0, 160]; the steps
        between them are of equal length. Else as `orbit`.
        """
        count = whole_sizes(views)
        if count is None or len(count) != 1 or count[0] < 2:
            raise ValueError(f"a sweep needs two views or more, but views={reprlib.repr(views)} was given")
        if not 0 < number_of("sweep_degrees", sweep_degrees) <= 160:
            raise ValueError(f"sweep_degrees lies in (0, 160], but {sweep_degrees} was given")
        check_degrees("sweep_degrees", sweep_degrees, count[0])
        check_isocentre(source_to_detector, source_to_isocentre)
        reach = math.tan(math.radians(sweep_degrees) / 2)
        tangents = np.linspace(-reach, reach, count[0])
        return cls(*on_line(tangents, source_to_detector, source_to_isocentre, pixel_sizes(pixel)), shape)

    def shifted(self, rows: float = 0.0, columns: float = 0.0) -> ConeBeam:
        """The beam with its detectors moved in their planes, by mm in the direction from row to row and from column to
        column, as for a half-fan acquisition."""
        rows, columns = number_of("rows", rows), number_of("columns", columns)
        height, width = self.pixel.T[:, :, None]
        move = rows * self.v / height + columns * self.u / width
        return replace(self, detectors=self.detectors + move)

    def at(self, sources: np.ndarray, detectors: np.ndarray, u: np.ndarray, v: np.ndarray) -> ConeBeam:
        """The beam in other poses."""
        return replace(self, sources=sources, detectors=detectors, u=u, v=v)

    def tilted(self, degrees: float) -> ConeBeam:
        """The beam with each view turned about the line through the isocentre that its rows run along, so that the
        source rises by `degrees`: the angulation of a C-arm."""
        if not abs(number_of("tilt_degrees", degrees)) < 90:
            raise ValueError(f"tilt_degrees lies between -90 and 90, but {degrees} was given")
        return self.at(*turned((self.sources, self.detectors, self.u, self.v), math.radians(degrees)))

    @property
    def views(self) -> int:
        return len(self.sources)

    @property
    def pixel(self) -> np.ndarray:
        """Row height and column width (K, 2) in mm of each view's pixels."""
        return np.stack([np.linalg.norm(self.v, axis=1), np.linalg.norm(self.u, axis=1)], 1)

    @property
    def normals(self) -> np.ndarray:
        """Unit vectors (K, 3) perpendicular to the detectors, pointing from source to detector."""
        normal = np.cross(self.u, self.v)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        return normal * np.where(((self.detectors - self.sources) * normal).sum(1, keepdims=True) < 0, -1, 1)

    @property
    def distances(self) -> np.ndarray:
        """Perpendicular distances (K,) in mm from each source to its detector's plane."""
        return ((self.detectors - self.sources) * self.normals).sum(1)

    def pixels(self) -> np.ndarray:
        """World positions (K, V, U, 3) in mm of the pixels' centres."""
        rows, columns = (np.arange(n) - (n - 1) / 2 for n in self.shape)
        return (self.detectors[:, None, None] + columns[None, None, :, None] * self.u[:, None, None]
                + rows[None, :, None, None] * self.v[:, None, None])

    def shadows(self, points: np.ndarray) -> np.ndarray:
        """Where points (N, 3) appear on each detector: (K, N, 2) mm from its centre, from column to column and from row
        to row."""
        rays = points - self.sources[:, None]
        depth = (rays * self.normals[:, None]).sum(2, keepdims=True)
        hits = self.sources[:, None] + rays * self.distances[:, None, None] / depth - self.detectors[:, None]
        return np.stack([(hits * (step / np.linalg.norm(step, axis=1, keepdims=True))[:, None]).sum(2)
                         for step in (self.u, self.v)], 2)

    def select(self, views) -> ConeBeam:
        """The beam with only `views` (indices, slice or mask), in the order given. Raises ValueError for others."""
        try:
            index = np.atleast_1d(np.arange(self.views)[views])
        except IndexError as error:
            raise ValueError(f"views are indices below {self.views}, a slice or a mask, but {reprlib.repr(views)} was "
                             "given") from error
        return self.at(self.sources[index], self.detectors[index], self.u[index], self.v[index])

    def binned(self, factor: int) -> ConeBeam:
        """The beam whose pixels are blocks of factor x factor pixels; what fills no block is left out (`in_blocks`)."""
        if factor != int(factor) or not 1 <= factor <= min(self.shape):
            raise ValueError(f"a detector of {self.shape[0]} x {self.shape[1]} pixels cannot be binned by {factor}; "
                             f"give a whole number from 1 to {min(self.shape)}")
        factor = int(factor)
        rows, columns = (in_blocks(n, factor) for n in self.shape)
        down, across = ((kept.start + kept.stop - n) / 2 for kept, n in zip((rows, columns), self.shape))
        return replace(self, detectors=self.detectors + down * self.v + across * self.u, u=factor * self.u,
                       v=factor * self.v, shape=(self.shape[0] // factor, self.shape[1] // factor))

    def divided(self, factor: int) -> ConeBeam:
        """The beam each of whose pixels is divided into factor x factor; `binned` undoes it."""
        return replace(self, u=self.u / factor, v=self.v / factor,
                       shape=(self.shape[0] * factor, self.shape[1] * factor))

    def check(self, grid: Grid) -> None:
        """Raise ValueError unless the whole box of voxels lies between every source and its detector's plane."""
        depth = self.depths(grid)
        centre = ((grid.centre - self.sources) * self.normals).sum(1)
        for k, distance in enumerate(self.distances):
            near, far = depth[:, k].min(), depth[:, k].max()
            if near > 0 and far < distance:
                continue
            reach = (depth.max(0) - centre).max()  # of the view along which the box is longest
            least, most = math.floor(reach) + 1, math.ceil(distance - reach) - 1
            room = f"a source_to_isocentre of {least} to {most} mm would do with" if least <= most else (
                f"no source_to_isocentre would do, since {2 * least} mm are needed, with")
            culprit = "source" if near <= 0 else "detector"
            units = ", with lengths in mm, not in cm or m" if min(distance, abs(centre[k])) < SHORT_MM else ""
            raise ValueError(
                f"view {k}: the {culprit} lies inside the volume or the volume extends behind it: "
                f"source to volume centre is {centre[k]:.1f} mm and volume centre to detector is "
                f"{distance - centre[k]:.1f} mm along the view, but the volume reaches {centre[k] - near:.1f} mm from "
                f"its centre; {room} this source_to_detector of {distance:g} mm; move the source or the detector, or "
                f"give a smaller volume{units}")

    def has_room_for(self, grid: Grid) -> bool:
        """Whether the whole box of voxels lies between every source and its detector's plane."""
        depth = self.depths(grid)
        return bool((depth > 0).all() and (depth < self.distances).all())

    def depths(self, grid: Grid) -> np.ndarray:
        """How far (8, K) in mm the box's corners lie from the sources' planes, towards the detectors."""
        return (grid.corners() @ self.normals.T) - (self.sources * self.normals).sum(1)

    def is_upright(self, grid: Grid) -> bool:
        """Whether every detector's columns of pixels run along the grid's third axis."""
        axis = grid.affine[:3, 2] / grid.spacing[2]
        tilt = np.linalg.norm(np.cross(self.v, axis), axis=1) / np.linalg.norm(self.v, axis=1)
        return bool((tilt < 1e-6).all())

    def same_as(self, other: ConeBeam, tolerance: float = 1e-6) -> bool:
        """Whether both beams have the same poses to `tolerance` mm, the same detector shape and, where both state it,
        the same `continued`."""
        contradict = {self.continued, other.continued} == {True, False}
        return self.shape == other.shape and self.views == other.views and not contradict and all(
            np.allclose(getattr(self, name), getattr(other, name), rtol=0, atol=tolerance)
            for name in ("sources", "detectors", "u", "v"))

    def to_dict(self) -> dict:
        """Plain lists, from which `ConeBeam(**d)` builds the same beam."""
        return {name: np.asarray(getattr(self, name)).tolist() for name in VECTOR_KEYS} | (
            {} if self.continued is None else {"continued": self.continued})

    def save(self, path: str | Path) -> None:
        """Write the beam as YAML in the vector form (keys sources, detectors, u, v in mm, shape)."""
        with atomic_write(Path(path)) as part:
            part.write_text(yaml.safe_dump(self.to_dict(), sort_keys=False, default_flow_style=None))

    def with_continued(self, continued: bool | None) -> ConeBeam:
        """The same beam with `continued`; None leaves it. Raises ValueError where it has the other value."""
        if continued is None or continued is self.continued:
            return self
        if self.continued is not None:
            raise ValueError(f"`continued` is {self.continued} in `beam:`, but {continued} beside it: leave one of the "
                             "two out")
        return replace(self, continued=continued)

    @classmethod
    def load(cls, path: str | Path) -> ConeBeam:
        """Read a beam from YAML: the vector form that `save` writes, or one mapping `orbit:`, at the top
        level or under `beam:` as in geometry.yaml.

        orbit: {views, source_to_detector, source_to_isocentre, shape: [rows, columns], pixel: [row mm, column mm]}
        and optionally start_degrees (0) and arc_degrees (360), or start and arc in radians; angles_degrees: [...] in
        place of views, start and arc; or one mapping `sweep:` with sweep_degrees beside the orbit's five keys. Both
        take detector_shift (mm from column to column, or [from row to row, from column to column]) and tilt_degrees.
        Beside any of these forms, or beside `beam:`, `continued` says whether the patient continues above and below the
        volume.
        Raises FileNotFoundError, and ValueError naming the file for unknown or missing keys and impossible geometry.
        """
        path = Path(path)
        if not path.is_file():
            raise FileNotFoundError(f"there is no geometry file {path}; write one with ConeBeam.save or by hand")
        content = read_yaml(path)
        with naming(path):
            if not isinstance(content, dict) or "beam" not in content:
                return cls.from_dict(content)
            return cls.from_dict(content["beam"]).with_continued(content.get("continued"))

    @classmethod
    def from_dict(cls, content: object) -> ConeBeam:
        """The beam of a mapping in one of the forms that `load` reads. Raises ValueError naming the key."""
        form = next((name for name in ("orbit", "sweep") if isinstance(content, dict) and name in content), None)
        if form is None:
            content = dict(check_keys(content, VECTOR_KEYS, CONTINUED, ", or orbit or sweep in their place"))
            continued = content.pop("continued", None)
            numbers: dict[str, Any] = {key: numbers_of(key, value) for key, value in content.items()}
            return cls(**numbers, continued=continued)
        content = check_keys(content, (form,), CONTINUED)
        given: Any = content[form]
        if form == "orbit" and isinstance(given, dict) and "angles_degrees" in given:
            form = "angles"
        required, optional = FORMS[form]
        given = dict(check_keys(given, required, optional + PLACE_OPTIONS, INSTEAD.get(form, "")))
        for key, value in given.items():
            (numbers_of if key in LISTS else number_of)(key, value)
        shift, tilt = given.pop("detector_shift", 0.0), given.pop("tilt_degrees", 0.0)
        if np.shape(shift) not in ((), (2,)):
            raise ValueError("detector_shift is mm from column to column, or [from row to row, from column to column], "
                             f"but {reprlib.repr(shift)} was given")
        make: dict[str, Callable[..., ConeBeam]] = {"orbit": cls.orbit, "angles": cls.at_angles, "sweep": cls.sweep}
        beam = make[form](**given)
        if np.any(shift):
            beam = beam.shifted(*((0.0, shift) if np.ndim(shift) == 0 else shift))
        beam = beam.tilted(tilt) if tilt else beam
        return replace(beam, continued=content.get("continued"))


def in_blocks(count: int, factor: int) -> slice:
    """Of so many pixels in a row, those of whole blocks of `factor`: half of the rest is left out at each end."""
    rest = count % factor
    return slice(rest // 2, rest // 2 + count - rest)


def _check_room(views: int, shape: tuple[int, int]) -> None:
    check_memory(views * (8 * 12 + 4 * math.prod(shape)), f"{views:,} views of {shape[0]:,} x {shape[1]:,} pixels",
                 "give fewer views or pixels")
