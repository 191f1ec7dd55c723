"""RTK's circular projection geometry (ThreeDCircularProjectionGeometry, its XML of version 2 or 3) as a ConeBeam.

RTK's fixed system is that of IEC 61217: y along the rotation axis, z up. For a patient who lies supine, head towards
the gantry, x points left, y superior and z anterior: RAS+ = (-x, z, y). The source of GantryAngle 0 is anterior (an AP
view), that of 90 degrees at the patient's left.

    M = Rz(-InPlaneAngle) Rx(-OutOfPlaneAngle) Ry(-GantryAngle)     its rows are the turned axes in the fixed system
    source   = M' (SourceOffsetX, SourceOffsetY, SourceToIsocenterDistance)
    detector = M' (x + ProjectionOffsetX, y + ProjectionOffsetY, SourceToIsocenterDistance - SourceToDetectorDistance)

(x, y) are a projection's coordinates in mm. Projections are taken as ITK holds them: columns grow with x, rows with y,
(0, 0) at the detector's middle. A view of InPlaneAngle 0 thus has row 0 inferior, one of 180 degrees row 0 superior.
Source: RTK's documentation of the geometry; IEC 61217.
"""

from __future__ import annotations

import math
import reprlib
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from phydict.runtime.files import atomic_write
from phydict.runtime.reading import naming, read_text, reason
from phydict.xray.geometry import ConeBeam
from phydict.xray.stated import pixel_sizes

FIXED_TO_RAS = np.array([[-1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 1.0, 0.0]])
PARAMETERS = ("SourceToIsocenterDistance", "SourceToDetectorDistance", "GantryAngle", "OutOfPlaneAngle", "InPlaneAngle",
              "SourceOffsetX", "SourceOffsetY", "ProjectionOffsetX", "ProjectionOffsetY")
NEEDED = PARAMETERS[:3]
ROOT = "RTKThreeDCircularGeometry"


def read_rtk(path: str | Path, shape: tuple[int, int], pixel: float | tuple[float, float]) -> ConeBeam:
    """The beam of an RTK geometry file.

    shape: (V, U) pixels and pixel: (row height, column width) in mm of the projections, which the file does not hold.
    Raises ValueError naming the file for other XML, missing or zero distances, and detectors that are not flat.
    """
    text = read_text(path)
    try:
        root = ElementTree.fromstring(text)
    except Exception as error:  # an entity, an encoding or a nesting that the parser refuses, each in its own way
        raise ValueError(f"{path} is not valid XML: {reason(error)}") from error
    if root.tag != ROOT or root.get("version") not in ("2", "3"):
        raise ValueError(f"{path} holds <{root.tag} version={root.get('version')}>, but RTK's <{ROOT}> of version 2 or "
                         "3 was expected; write it again with a current RTK")
    height, width = pixel_sizes(pixel)
    stated = {name: 0.0 for name in PARAMETERS if name not in NEEDED}
    poses: list[tuple[np.ndarray, ...]] = []
    for element in root:
        if element.tag != "Projection":
            stated |= _numbers(path, [element])
            continue
        stated |= _numbers(path, element)  # RTK, too, keeps a value until the next one is given
        poses.append(_pose(path, len(poses), stated))
    if not poses:
        raise ValueError(f"{path} holds no <Projection>; give the geometry of at least one view")
    sources, detectors, across, along = (np.stack(part) for part in zip(*poses))
    with naming(path):
        return ConeBeam(sources, detectors, width * across, height * along, shape)


def write_rtk(path: str | Path, beam: ConeBeam) -> None:
    """Write a beam as RTK's XML, version 3; `read_rtk` with its shape and pixel size gives the same beam.

    Raises ValueError where u x v points away from the source: such images are mirrored, which RTK cannot say; and for
    what is no beam.
    """
    check_beam("write_rtk", path, beam)
    root = ElementTree.Element(ROOT, version="3")
    for k in range(beam.views):
        values, matrix = _parameters(beam, k)
        projection = ElementTree.SubElement(root, "Projection")
        for name, value in values.items():
            ElementTree.SubElement(projection, name).text = repr(float(value))
        rows = (" ".join(repr(float(value)) for value in row) for row in matrix)
        ElementTree.SubElement(projection, "Matrix").text = "\n" + "\n".join(rows) + "\n"
    ElementTree.indent(root)
    text = ElementTree.tostring(root, encoding="unicode")
    with atomic_write(Path(path)) as part:
        part.write_text(f'<?xml version="1.0"?>\n<!DOCTYPE RTKGEOMETRY>\n{text}\n')


def check_beam(function: str, path, beam) -> None:
    """Raises ValueError unless a function that writes a beam was given a path and a beam, in that order."""
    if not isinstance(beam, ConeBeam):
        swapped = isinstance(path, ConeBeam)
        shown = " ".join(reprlib.repr(beam).split())
        order = f"the beam first; call {function}(path, beam)" if swapped else f"{shown} as the beam"
        raise ValueError(f"{function} takes a path and then a ConeBeam, but was given {order}")


def _numbers(path, elements) -> dict[str, float]:
    values = {}
    for element in elements:
        if element.tag not in (*PARAMETERS, "RadiusCylindricalDetector"):
            continue  # the matrix follows from the parameters; collimation does not move a ray
        try:
            values[element.tag] = float(element.text)
        except (TypeError, ValueError):
            values[element.tag] = math.nan
        if not math.isfinite(values[element.tag]):
            raise ValueError(f"{path}: <{element.tag}> must hold a number, but {reprlib.repr(element.text)} was "
                             "found; give a finite one")
    if values.pop("RadiusCylindricalDetector", 0.0):
        raise ValueError(f"{path} describes a cylindrical detector; resample the projections to a flat one")
    return values


def _pose(path, view: int, values: dict[str, float]) -> tuple[np.ndarray, ...]:
    """Source, detector's centre and unit axes of columns and rows (3,) in RAS+ of one view."""
    from scipy.spatial.transform import Rotation

    missing = [name for name in NEEDED if name not in values]
    if missing:
        raise ValueError(f"{path}: view {view} has no {', '.join(missing)}; state every distance and angle")
    isocentre, detector = (values[name] for name in NEEDED[:2])
    if not (isocentre > 0 and detector > 0):
        raise ValueError(f"{path}: view {view} has SourceToIsocenterDistance {isocentre:g} mm and "
                         f"SourceToDetectorDistance {detector:g} mm, but both must be positive; a parallel geometry, "
                         "which RTK writes as 0, has no cone beam")
    angles = [-values[name] for name in ("InPlaneAngle", "OutOfPlaneAngle", "GantryAngle")]
    axes = Rotation.from_euler("ZXY", angles, degrees=True).as_matrix() @ FIXED_TO_RAS.T
    source = np.array([values["SourceOffsetX"], values["SourceOffsetY"], isocentre]) @ axes
    centre = np.array([values["ProjectionOffsetX"], values["ProjectionOffsetY"], isocentre - detector]) @ axes
    return source, centre, axes[0], axes[1]


def _parameters(beam: ConeBeam, k: int) -> tuple[dict[str, float], np.ndarray]:
    """The nine parameters of view k, and the 3x4 matrix from fixed coordinates to a projection's that RTK checks."""
    u, v = beam.u[k] / np.linalg.norm(beam.u[k]), beam.v[k] / np.linalg.norm(beam.v[k])
    normal = np.cross(u, v)
    if (beam.detectors[k] - beam.sources[k]) @ normal > 0:
        raise ValueError(f"view {k}: u x v points away from the source, so its images are mirrored, which RTK's "
                         "geometry cannot say; flip their columns and change the sign of u")
    rotation = np.stack([u, v, normal]) @ FIXED_TO_RAS
    source, centre = (rotation @ FIXED_TO_RAS.T @ point for point in (beam.sources[k], beam.detectors[k]))
    out_of_plane = math.asin(np.clip(-rotation[2, 1], -1, 1))
    if math.hypot(rotation[2, 0], rotation[2, 2]) > 1e-9:
        gantry = math.atan2(rotation[2, 0], rotation[2, 2])
        in_plane = math.atan2(rotation[0, 1], rotation[1, 1])
    else:  # seen along y the two other angles turn about the same axis
        gantry, in_plane = math.atan2(-rotation[0, 2], rotation[0, 0]), 0.0
    distance = source[2] - centre[2]
    values = dict(zip(PARAMETERS, (source[2], distance, *(math.degrees(a) % 360 for a in (
        gantry, out_of_plane, in_plane)), *source[:2], *centre[:2])))
    shift = np.eye(3)
    shift[:2, 2] = source[:2] - centre[:2]
    magnify = np.array([[-distance, 0, 0, 0], [0, -distance, 0, 0], [0, 0, 1, -source[2]]])
    move = np.eye(4)
    move[:2, 3] = -source[:2]
    turn = np.eye(4)
    turn[:3, :3] = rotation
    return values, shift @ magnify @ move @ turn
