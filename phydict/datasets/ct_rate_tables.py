"""CT-RATE's tables: reports, and DICOM values."""

from __future__ import annotations

import csv
import json
from pathlib import Path

from phydict.datasets.reports import join_report
from phydict.datasets.transforms import Calibration, case_id

def read_reports(path: str | Path) -> dict[str, str]:
    """Reports by volume name (without .nii.gz) from one CT-RATE CSV, or from all CSVs of a folder.

    Columns VolumeName, Findings_EN, Impressions_EN; a report is laid out by `join_report`. Raises FileNotFoundError,
    and ValueError for missing columns and for a volume with two different reports.
    """
    reports = {}
    for row in _rows(path, ("VolumeName", "Findings_EN", "Impressions_EN")):
        name, report = case_id(row["VolumeName"]), join_report(row["Findings_EN"], row["Impressions_EN"])
        if reports.setdefault(name, report) != report:
            raise ValueError(f"the reports in {path} name {name} twice, with different texts: keep one row of each "
                             "volume")
    return reports


def read_calibrations(path: str | Path) -> dict[str, Calibration]:
    """HU scale, spacing and orientation by volume name from CT-RATE's metadata CSV, or from all CSVs of a folder.

    Raises FileNotFoundError, and ValueError for missing columns and for numbers that cannot be read.
    """
    columns = ("VolumeName", "RescaleSlope", "RescaleIntercept", "XYSpacing", "ZSpacing")
    calibrations = {}
    for row in _rows(path, columns):
        try:
            columns_mm, rows_mm = json.loads(row["XYSpacing"])
            orientation = tuple(json.loads(row.get("ImageOrientationPatient") or "[1, 0, 0, 0, 1, 0]"))
            calibration = Calibration(float(row["RescaleSlope"]), float(row["RescaleIntercept"]),
                                      (float(columns_mm), float(rows_mm), float(row["ZSpacing"])), orientation)
        except (TypeError, ValueError) as error:
            raise ValueError(f"the metadata of {row['VolumeName']} in {path} cannot be read: {error}") from error
        calibrations[case_id(row["VolumeName"])] = calibration
    return calibrations


def _rows(path: str | Path, columns: tuple[str, ...]) -> list[dict[str, str]]:
    path = Path(path)
    files = sorted(path.glob("*.csv")) if path.is_dir() else [path]
    if not files or not files[0].is_file():
        raise FileNotFoundError(f"there is no CSV table at {path}; give a .csv file or a folder that holds some")
    rows = []
    for file in files:
        with file.open(newline="", encoding="utf-8-sig") as lines:
            table = csv.DictReader(lines)
            missing = [name for name in columns if name not in (table.fieldnames or ())]
            if missing:
                raise ValueError(f"{file} lacks the columns {', '.join(missing)}; CT-RATE's tables have "
                                 f"{', '.join(columns)}")
            rows += table
    return rows
