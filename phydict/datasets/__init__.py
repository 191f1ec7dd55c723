"""Files to Cases: procedural thoraxes, chest CTs with reports, and measured X-rays."""

from phydict.datasets.case import Case
from phydict.datasets.cts.anatomy import MASKS, body_mask, segment
from phydict.datasets.cts.augment import Augmentation, Deformation, augment
from phydict.datasets.cts.ct_case import prepare_ct
from phydict.datasets.cts.ct_rate import (
    CTCases,
    CTFile,
    CTSource,
    as_one_patient,
    find_cts,
    load_case,
    patient_of,
    split_by_patient,
)
from phydict.datasets.cts.ct_rate_tables import read_calibrations, read_reports
from phydict.datasets.cts.reading import Calibration, load_ct
from phydict.datasets.intensity import Intensity
from phydict.datasets.phantoms.findings import Finding
from phydict.datasets.phantoms.phantom import build, pathology_region, phantom_case
from phydict.datasets.phantoms.thorax import Thorax, report, without, wrong_side
from phydict.datasets.radiographs.radiographs import find_xrays, load_xrays, save_xrays
from phydict.datasets.reports import format_report, join_report
from phydict.datasets.surroundings.surroundings import Surroundings, surround

__all__ = [
    "MASKS",
    "Augmentation",
    "CTCases",
    "CTFile",
    "CTSource",
    "Calibration",
    "Case",
    "Deformation",
    "Finding",
    "Intensity",
    "Surroundings",
    "Thorax",
    "as_one_patient",
    "augment",
    "body_mask",
    "build",
    "find_cts",
    "find_xrays",
    "format_report",
    "join_report",
    "load_case",
    "load_ct",
    "load_xrays",
    "pathology_region",
    "patient_of",
    "phantom_case",
    "prepare_ct",
    "read_calibrations",
    "read_reports",
    "report",
    "save_xrays",
    "segment",
    "split_by_patient",
    "surround",
    "without",
    "wrong_side",
]
