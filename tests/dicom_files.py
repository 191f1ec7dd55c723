"""X-rays and CTs written as DICOM, for tests: one XA run of all views, one DX file per view, one CT file per slice."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pydicom
from pydicom.dataset import FileDataset, FileMetaDataset
from pydicom.uid import ExplicitVRLittleEndian, generate_uid

STORAGE = {"XA": "1.2.840.10008.5.1.4.1.1.12.1", "RF": "1.2.840.10008.5.1.4.1.1.12.2",
           "DX": "1.2.840.10008.5.1.4.1.1.1.1", "CR": "1.2.840.10008.5.1.4.1.1.1",
           "CT": "1.2.840.10008.5.1.4.1.1.2"}


def write_dicom(path: Path, stored: np.ndarray, modality: str = "XA", **tags) -> Path:
    """Write stored values, (V, U) or (K, V, U) uint16, with `tags` by keyword; a tag of None is left out."""
    meta = FileMetaDataset()
    meta.MediaStorageSOPClassUID, meta.MediaStorageSOPInstanceUID = STORAGE[modality], generate_uid()
    meta.TransferSyntaxUID = ExplicitVRLittleEndian
    dataset = FileDataset(str(path), {}, file_meta=meta, preamble=bytes(128))
    dataset.SOPClassUID, dataset.SOPInstanceUID = meta.MediaStorageSOPClassUID, meta.MediaStorageSOPInstanceUID
    dataset.Modality = modality
    dataset.Rows, dataset.Columns = stored.shape[-2:]
    if stored.ndim == 3:
        dataset.NumberOfFrames = len(stored)
    dataset.SamplesPerPixel, dataset.PixelRepresentation = 1, 0
    dataset.BitsAllocated, dataset.BitsStored, dataset.HighBit = 16, 16, 15
    dataset.PhotometricInterpretation = "MONOCHROME2"
    dataset.PixelData = stored.astype("<u2").tobytes()
    dataset["PixelData"].VR = "OW"
    for keyword, value in tags.items():
        if value is None:
            delattr(dataset, keyword)
        else:
            setattr(dataset, keyword, value)
    path.parent.mkdir(parents=True, exist_ok=True)
    pydicom.dcmwrite(path, dataset, enforce_file_format=True)
    return path


def orbit_tags(views: int, source_to_detector: float, source_to_isocentre: float, pixel) -> dict:
    """The tags of an XA run that turns as `ConeBeam.orbit` does: from PA, the source towards the patient's left."""
    return {"DistanceSourceToDetector": source_to_detector, "DistanceSourceToPatient": source_to_isocentre,
            "ImagerPixelSpacing": list(pixel), "PositionerMotion": "DYNAMIC", "PositionerPrimaryAngle": 0.0,
            "PositionerSecondaryAngle": 0.0,
            "PositionerPrimaryAngleIncrement": [round(-360.0 * k / views, 9) for k in range(views)],
            "PositionerSecondaryAngleIncrement": [0.0] * views}


def write_ct_series(folder: Path, hu: np.ndarray, affine: np.ndarray, **tags) -> list[Path]:
    """Write HU (X, Y, Z) on the RAS+ voxels of `affine` as axial CT slices, one file each, from the feet to the head.

    tags: for every slice, instead of the usual ones; a tag of None is left out.
    """
    to_lps = np.diag([-1.0, -1, 1, 1]) @ affine
    series, frame, paths = generate_uid(), generate_uid(), []
    for k in range(hu.shape[2]):
        stored = (hu[::-1, ::-1, k].T + 1024).astype(np.uint16)  # rows towards posterior, columns towards the left
        corner = to_lps @ [hu.shape[0] - 1, hu.shape[1] - 1, k, 1]
        spacing = np.linalg.norm(affine[:3, :3], axis=0)
        usual = {"SeriesInstanceUID": series, "FrameOfReferenceUID": frame, "SeriesNumber": 3,
                 "ImageType": ["ORIGINAL", "PRIMARY", "AXIAL"], "RescaleSlope": 1, "RescaleIntercept": -1024,
                 "PixelSpacing": [float(spacing[1]), float(spacing[0])], "ImagePositionPatient": list(corner[:3]),
                 "ImageOrientationPatient": [1, 0, 0, 0, 1, 0]}
        paths.append(write_dicom(folder / f"slice{k:03d}.dcm", stored, "CT", **usual | tags))
    return paths
