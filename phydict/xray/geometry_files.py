"""Geometry files of other programs to and from ConeBeam: RTK's XML, ASTRA's cone vectors, tables with named columns.

    .yaml .yml   ours (ConeBeam.load)
    .xml         RTK's circular geometry (phydict.xray.rtk)
    .npy         ASTRA's cone_vec, (views, 12): source, detector centre, u, v; u leads from one column to the next, v
                 from one row to the next
    .csv .txt    a header that names the columns of COLUMNS in any order, or without a header the numbers of cone_vec

Vectors are taken as world millimetres, RAS+: where another program's axes differ, turn them first.
"""

from __future__ import annotations

import re
from itertools import takewhile
from pathlib import Path

import numpy as np

from phydict.runtime.files import atomic_write
from phydict.runtime.reading import read_npy, read_text, reading, reason
from phydict.runtime.warning import warn
from phydict.xray.geometry import ConeBeam
from phydict.xray.rtk import check_beam, read_rtk, write_rtk

VECTORS = ("source", "detector", "u", "v")
COLUMNS = tuple(f"{vector}_{axis}" for vector in VECTORS for axis in "xyz")
ENDINGS = (".yaml", ".yml", ".xml", ".npy", ".csv", ".txt")


def read_beam(path: str | Path, shape: tuple[int, int] | None = None,
              pixel: float | tuple[float, float] | None = None) -> ConeBeam:
    """The beam of a geometry file of any of the module's kinds, chosen by its ending.

    shape: (V, U) pixels, needed but for YAML. pixel: (row height, column width) in mm, needed for RTK's XML.
    Raises FileNotFoundError, and ValueError naming the file for other endings, missing shape or pixel and bad content.
    """
    path = Path(path)
    ending = _ending(path)
    if not path.is_file():
        raise FileNotFoundError(f"there is no geometry file {path}; give one of {', '.join(ENDINGS)}")
    if ending in (".yaml", ".yml"):
        return ConeBeam.load(path)
    if shape is None:
        raise ValueError(f"{path} does not say how many pixels the detector has; state its `shape`: [rows, columns]")
    if ending == ".xml":
        if pixel is None:
            raise ValueError(f"{path} does not say how large the pixels are; state `pixel`: [row height, column width] "
                             "in mm")
        return read_rtk(path, shape, pixel)
    vectors = _read_npy(path) if ending == ".npy" else _read_table(path)
    if vectors.ndim != 2 or vectors.shape[1] != 12 or not len(vectors):
        raise ValueError(f"{path} holds numbers of shape {vectors.shape}, but 12 per view were expected: source, "
                         "detector centre, u and v")
    try:
        sources, detectors, u, v = np.split(vectors, 4, axis=1)
        return ConeBeam(sources, detectors, u, v, shape)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


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
    lines = [line for line in (line.strip(" ,;\t") for line in read_text(path).splitlines()) if line]
    header = next((line for line in takewhile(lambda line: line.startswith("#"), lines) if _names_columns(line)), None)
    rows = [re.split(r"[,;\s]+", line) for line in lines if not line.startswith("#")]
    if header and rows and not rows[0][0][:1].isalpha():  # as numpy.savetxt writes it
        rows.insert(0, re.split(r"[,;\s]+", header.lstrip("# ")))
    columns = list(COLUMNS)
    if rows and rows[0][0][:1].isalpha():
        columns = [name.lower() for name in rows.pop(0)]
        missing = [name for name in COLUMNS if name not in columns]
        if missing:
            raise ValueError(f"{path} has no column {', '.join(missing)}; the columns are {', '.join(COLUMNS)}")
    for number, row in enumerate(rows):
        if len(row) != len(columns):
            raise ValueError(f"{path}: view {number} has {len(row)} values, but {len(columns)} were expected")
    try:
        table = np.array(rows, float).reshape(len(rows), len(columns))
    except ValueError as error:
        raise ValueError(f"{path}: {reason(error)[:100]}; give numbers in mm") from error
    return table[:, [columns.index(name) for name in COLUMNS]]


def _names_columns(line: str) -> bool:
    return set(COLUMNS) <= set(re.split(r"[,;\s]+", line.lstrip("# ").lower()))
