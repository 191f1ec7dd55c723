"""X-rays written as DICOM, for tests: one XA run of all views, or one DX file per view."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pydicom
from pydicom.dataset import FileDataset, FileMetaDataset
from pydicom.uid import ExplicitVRLittleEndian, generate_uid

STORAGE = {"XA": "1.2.840.10008.5.1.4.1.1.12.1", "RF": "1.2.840.10008.5.1.4.1.1.12.2",
           "DX": "1.2.840.10008.5.1.4.1.1.1.1", "CR": "1.2.840.10008.5.1.4.1.1.1"}


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
