"""Files to Cases: procedural thoraxes, chest CTs with reports, and measured X-rays."""

from phydict.datasets.anatomy import MASKS, segment
from phydict.datasets.ct_rate import CTCases, CTFile, find_cts, patient_of, split_by_patient
from phydict.datasets.phantom import Thorax, phantom_case
from phydict.datasets.radiographs import Intensity, find_xrays, load_xrays, save_xrays
from phydict.datasets.report import join_report, read_calibrations, read_reports
from phydict.datasets.transforms import Calibration, Deformation, augment, load_ct, prepare_ct

__all__ = ["CTCases", "CTFile", "Calibration", "Deformation", "Intensity", "MASKS", "Thorax", "augment", "find_cts",
           "find_xrays", "join_report", "load_ct", "load_xrays", "patient_of", "phantom_case", "prepare_ct",
           "read_calibrations", "read_reports", "save_xrays", "segment", "split_by_patient"]
