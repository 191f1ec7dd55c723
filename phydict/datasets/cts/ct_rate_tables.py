"""CT-RATE's tables: reports, and DICOM values."""

from __future__ import annotations

import csv
import math
import reprlib
from pathlib import Path

from phydict.datasets.cts.reading import Calibration, case_id
from phydict.datasets.reports import join_report
from phydict.runtime.reading import Unreadable, reading, refusing

TABLE_ADVICE = "save it as CSV in UTF-8"


def read_reports(path: str | Path) -> dict[str, str]:
    """Reports by volume name (without .nii.gz) from one CT-RATE CSV, or from all CSVs of a folder.

    Columns VolumeName, Findings_EN, Impressions_EN; a report is laid out by `join_report`. Raises FileNotFoundError,
    and ValueError for missing columns, for rows of more fields than the header, for quotes that are not closed, and for
    volumes without a name or with two rows.
    """
    with refusing(path, TABLE_ADVICE):
        rows = _rows(path, ("VolumeName", "Findings_EN", "Impressions_EN"))
        return {case_id(row["VolumeName"]): join_report(row["Findings_EN"], row["Impressions_EN"]) for row in rows}


def read_calibrations(path: str | Path) -> dict[str, Calibration]:
    """HU scale, spacing and orientation by volume name from CT-RATE's metadata CSV, or from all CSVs of a folder.

    Raises FileNotFoundError, and ValueError as `read_reports` and for numbers that cannot be read.
    """
    columns = ("VolumeName", "RescaleSlope", "RescaleIntercept", "XYSpacing", "ZSpacing")
    with refusing(path, TABLE_ADVICE):
        return {case_id(row["VolumeName"]): _calibration(path, row) for row in _rows(path, columns)}


def _calibration(path: str | Path, row: dict[str, str]) -> Calibration:
    """What a row of metadata says."""
    slope, intercept, z_mm = (_numbers(path, row, name, 1)[0] for name in ("RescaleSlope", "RescaleIntercept",
                                                                           "ZSpacing"))
    x_mm, y_mm = _numbers(path, row, "XYSpacing", 2)
    spacing = (x_mm, y_mm, z_mm)
    if min(spacing) <= 0:
        raise ValueError(f"the metadata of {row['VolumeName']} in {path} give it voxels of {spacing} mm; correct "
                         "XYSpacing and ZSpacing")
    orientation = _numbers(path, row, "ImageOrientationPatient", 6) if row.get("ImageOrientationPatient") else ()
    return Calibration(slope, intercept, spacing, *filter(None, [orientation]))


def _numbers(path: str | Path, row: dict[str, str], column: str, count: int) -> tuple[float, ...]:
    """The finite numbers in one field: "1.5", or "[0.7, 0.7]" where there are several."""
    written = str(row[column])
    try:
        numbers = tuple(map(float, written.strip(" []").split(",")))
    except ValueError:
        numbers = ()
    if len(numbers) != count or not all(map(math.isfinite, numbers)):
        raise ValueError(f"the metadata of {row['VolumeName']} in {path} cannot be read: {column} must be {count} "
                         f"finite number{'s' * (count > 1)}, but {reprlib.repr(written)} was found")
    return numbers


def _rows(path: str | Path, columns: tuple[str, ...]) -> list[dict[str, str]]:
    path = Path(path)
    files = sorted(path.glob("*.csv")) if path.is_dir() else [path]
    if not files or not files[0].is_file():
        raise FileNotFoundError(f"there is no CSV table at {path}; give a .csv file or a folder that holds some")
    rows = {}
    for file in files:
        for number, row in enumerate(_table(file, columns), 2):
            id = case_id(row["VolumeName"] or "")
            if not 0 < len(id) < 256:
                raise ValueError(f"row {number} of {file} has no VolumeName that is one of a file; fill it in or "
                                 "remove that row")
            if id in rows:
                raise ValueError(f"{id} has two rows, the second in row {number} of {file}; keep one row per volume")
            rows[id] = row
    return list(rows.values())


def _table(file: Path, columns: tuple[str, ...]) -> list[dict[str, str]]:
    rows: list[dict[str, str]] = []
    with reading(f"the table {file}", TABLE_ADVICE), file.open(newline="", encoding="utf-8-sig") as lines:
        table = csv.DictReader(lines, strict=True)
        try:
            header = table.fieldnames or ()
            if missing := [name for name in columns if name not in header]:
                between = ", separated by commas" if len(header) == 1 else ""
                raise Unreadable(f"{file} lacks the columns {', '.join(missing)}; CT-RATE's tables have "
                                 f"{', '.join(columns)}{between}")
            for row in table:
                if any(row.pop(None, ())):
                    raise Unreadable(f"row {len(rows) + 2} of {file} has more fields than its header: quote texts that "
                                     "hold commas")
                rows.append(row)
        except csv.Error as error:
            raise Unreadable(f"row {len(rows) + 2} of {file} cannot be read ({error}): close each quote, and write "
                             "those within a text twice") from error
    return rows
