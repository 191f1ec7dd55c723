"""Geometry files of other programs to and from ConeBeam: RTK's XML, ASTRA's cone vectors, projection matrices, tables.

    .yaml .yml   ours (ConeBeam.load)
    .xml         RTK's circular geometry (phydict.xray.rtk)
    .npy         ASTRA's cone_vec, (views, 12): source, detector centre, u, v; u leads from one column to the next, v
                 from one row to the next
    .npy         projection matrices, (views, 3, 4): phydict.xray.projection_matrices
    .csv .txt    a header that names the columns of COLUMNS in any order, among others that are passed over, or without
                 a header the numbers of cone_vec; pandas' and R's row names may stand before them

Vectors are taken as world millimetres, RAS+: where another program's axes differ, turn them first.
"""

from __future__ import annotations

import re
from itertools import takewhile
from pathlib import Path

import numpy as np

from phydict.runtime.files import atomic_write
from phydict.runtime.reading import naming, read_npy, read_text, reading, reason
from phydict.runtime.warning import warn
from phydict.xray.geometry import ConeBeam
from phydict.xray.projection_matrices import are_matrices, beam_of_matrices
from phydict.xray.rtk import check_beam, read_rtk, write_rtk
from phydict.xray.stated import pixel_sizes

VECTORS = ("source", "detector", "u", "v")
COLUMNS = tuple(f"{vector}_{axis}" for vector in VECTORS for axis in "xyz")
ENDINGS = (".yaml", ".yml", ".xml", ".npy", ".csv", ".txt")


def read_beam(path: str | Path, shape: tuple[int, int] | None = None,
              pixel: float | tuple[float, float] | None = None) -> ConeBeam:
    """The beam of a geometry file of any of the module's kinds, chosen by its ending.

    shape: (V, U) pixels, needed but for YAML. pixel: (row height, column width) in mm, needed for RTK's XML and
    projection matrices, stated by the other kinds themselves.
    Raises FileNotFoundError, and ValueError naming the file for other endings, a missing shape, a pixel that is missing
    or not the file's own, and bad content.
    """
    path = Path(path)
    ending = _ending(path)
    if not path.is_file():
        raise FileNotFoundError(f"there is no geometry file {path}; give one of {', '.join(ENDINGS)}")
    if ending in (".yaml", ".yml"):
        return _of_pixels(path, ConeBeam.load(path), pixel)
    if shape is None:
        raise ValueError(f"{path} does not say how many pixels the detector has; state its `shape`: [rows, columns]")
    if ending == ".xml":
        return read_rtk(path, shape, _stated(path, pixel))
    vectors = _read_npy(path) if ending == ".npy" else _read_table(path)
    if vectors.shape[1:] == (3, 4) and len(vectors):
        sides = _stated(path, pixel)
        with naming(path):
            return beam_of_matrices(vectors, shape, sides)
    if vectors.ndim != 2 or vectors.shape[1] != 12 or not len(vectors):
        raise ValueError(f"{path} holds numbers of shape {vectors.shape}, but 12 per view were expected: source, "
                         "detector centre, u and v; or (views, 3, 4), projection matrices")
    if are_matrices(vectors):
        raise ValueError(f"{path} holds projection matrices as numbers of shape {vectors.shape}, but 12 per view are "
                         "source, detector centre, u and v: save matrices of shape (views, 3, 4) in an .npy, by "
                         "numpy.save(path, numbers.reshape(-1, 3, 4))")
    with naming(path):
        sources, detectors, u, v = np.split(vectors, 4, axis=1)
        beam = ConeBeam(sources, detectors, u, v, shape)
    return _of_pixels(path, beam, pixel)


def _of_pixels(path: Path, beam: ConeBeam, pixel: float | tuple[float, float] | None) -> ConeBeam:
    """The beam of a file that states its pixels itself. Raises ValueError where `pixel` is given and not the same."""
    with naming(path):
        if pixel is not None and (apart := ~np.isclose(beam.pixel, pixel_sizes(pixel), rtol=1e-3).all(1)).any():
            raise ValueError(f"its v and u state pixels of {beam.pixel[apart][0].round(4).tolist()} mm, but `pixel` "
                             f"{pixel} was given as well; leave it out")
    return beam


def _stated(path: Path, pixel: float | tuple[float, float] | None) -> float | tuple[float, float]:
    if pixel is None:
        raise ValueError(f"{path} does not say how large the pixels are; state `pixel`: [row height, column width] in "
                         "mm")
    return pixel


def write_beam(path: str | Path, beam: ConeBeam) -> None:
    """Write a beam as the kind of file that its ending names; `read_beam` reads it back.

    Warns where a beam states `continued`, which YAML alone can hold. Raises ValueError for other endings, where RTK's
    XML cannot hold the beam, and for what is no beam.
    """
    check_beam("write_beam", path, beam)
    ending = _ending(Path(path))
    vectors = np.concatenate([beam.sources, beam.detectors, beam.u, beam.v], axis=1)
    if ending in (".yaml", ".yml"):
        beam.save(path)
        return
    if ending == ".xml":
        write_rtk(path, beam)
    elif ending == ".npy":
        with atomic_write(Path(path)) as part, part.open("wb") as file:
            np.save(file, vectors)
    else:
        lines = [",".join(COLUMNS), *(",".join(repr(float(value)) for value in row) for row in vectors)]
        with atomic_write(Path(path)) as part:
            part.write_text("\n".join(lines) + "\n")
    if beam.continued is not None:
        warn(f"{path} cannot say whether the patient continues: state `continued: {str(beam.continued).lower()}` in "
             "the geometry.yaml that names it")


def _ending(path: Path) -> str:
    ending = path.suffix.lower()
    if ending not in ENDINGS:
        raise ValueError(f"{path} is no known geometry file; its name must end in one of {', '.join(ENDINGS)}")
    return ending


def _read_npy(path: Path) -> np.ndarray:
    with reading(path, "save cone_vec, (views, 12) numbers, with numpy.save"):
        vectors = read_npy(path)
        if vectors.dtype.kind not in "iuf":
            raise ValueError(f"it holds values of type {vectors.dtype}")
        return vectors.astype(float)


def _read_table(path: Path) -> np.ndarray:
    lines = [line for line in (line.rstrip(" ,;\t").lstrip() for line in read_text(path).splitlines()) if line]
    header = next((line for line in takewhile(lambda line: line.startswith("#"), lines) if _names_columns(line)), None)
    lines = [line for line in lines if not line.startswith("#")]
    if header and lines and not _is_header(lines[0]):  # as numpy.savetxt writes it
        lines.insert(0, header.lstrip("# "))
    columns = list(COLUMNS)
    if lines and _is_header(lines[0]):
        columns = _cells(lines.pop(0).lower())
        missing = [name for name in COLUMNS if name not in columns]
        if missing:
            raise ValueError(f"{path} has no column {', '.join(missing)}; the columns are {', '.join(COLUMNS)}")
        if _are_counted(lines, len(columns) + 1):
            columns.insert(0, "")
    rows = [_row(path, number, line, len(columns)) for number, line in enumerate(lines)]
    places = [columns.index(name) for name in COLUMNS]
    try:
        return np.array([[row[place] for place in places] for row in rows], float).reshape(len(rows), len(COLUMNS))
    except ValueError as error:
        raise ValueError(f"{path}: {reason(error)[:100]}; give numbers in mm") from error


def _row(path: Path, number: int, line: str, expected: int) -> list[str]:
    """The cells of one view. Raises ValueError where they are more or fewer than expected."""
    cells = _cells(line)
    if len(cells) == expected:
        return cells
    if "," in line and len(re.split(r"[;\s]+", line)) == expected:
        raise ValueError(f"{path}: view {number} has decimal commas; write its numbers with decimal points")
    raise ValueError(f"{path}: view {number} has {len(cells)} values, but {expected} were expected")


def _cells(line: str) -> list[str]:
    """What stands in a line of a table, without quotes."""
    return [cell.strip("\"'") for cell in re.split(r"\s*[,;]\s*|\s+", line)]


def _is_header(line: str) -> bool:
    return line.lstrip("\"',; \t")[:1].isalpha()


def _are_counted(lines: list[str], width: int) -> bool:
    """Whether rows of `width` cells begin with their count, from 0 or 1 on, as pandas and R name them."""
    rows = [_cells(line) for line in lines]
    return all(len(row) == width for row in rows) and [row[0] for row in rows] in (
        [str(first + k) for k in range(len(rows))] for first in (0, 1))


def _names_columns(line: str) -> bool:
    return set(COLUMNS) <= set(_cells(line.lstrip("# ").lower()))
