"""Writes this folder's radiographs, PA and right lateral, of the example's X-rays.

    python data/example/two_radiographs/make.py
"""

from pathlib import Path

import numpy as np
import pydicom
from pydicom.dataset import FileDataset, FileMetaDataset
from pydicom.uid import ExplicitVRLittleEndian, generate_uid

from phydict import load_xrays

DIGITAL_XRAY = "1.2.840.10008.5.1.4.1.1.1.1"
VIEWS = {"1_pa": (0, "PA", ["L", "F"]), "2_lateral": (2, "RL", ["A", "F"])}
"""File -> the example's view, ViewPosition and PatientOrientation."""

if __name__ == "__main__":
    here = Path(__file__).parent
    lines = load_xrays(here.parent / "xrays")["xrays"].numpy()
    for name, (view, position, orientation) in VIEWS.items():
        image = lines[view].reshape(112, 2, 112, 2).mean((1, 3))
        stored = np.rint(4000 * (image - image.min()) / np.ptp(image)).astype("<u2")
        meta = FileMetaDataset()
        meta.MediaStorageSOPClassUID, meta.TransferSyntaxUID = DIGITAL_XRAY, ExplicitVRLittleEndian
        meta.MediaStorageSOPInstanceUID = generate_uid(entropy_srcs=[name])
        file = FileDataset(None, {}, file_meta=meta, preamble=bytes(128))
        file.SOPClassUID, file.SOPInstanceUID = DIGITAL_XRAY, meta.MediaStorageSOPInstanceUID
        file.PatientName, file.Modality, file.ViewPosition = "Phantom", "DX", position
        file.PatientOrientation, file.ImagerPixelSpacing = orientation, [5.0, 5.0]
        file.DistanceSourceToDetector, file.EstimatedRadiographicMagnificationFactor = 1020.0, round(1020 / 740, 6)
        file.PixelIntensityRelationship, file.PixelIntensityRelationshipSign = "LOG", -1  # bright is dense
        file.SamplesPerPixel, file.PixelRepresentation, file.PhotometricInterpretation = 1, 0, "MONOCHROME2"
        file.Rows, file.Columns = stored.shape
        file.BitsAllocated, file.BitsStored, file.HighBit = 16, 12, 11
        file.PixelData = stored.tobytes()
        file["PixelData"].VR = "OW"
        pydicom.dcmwrite(here / "xrays" / f"{name}.dcm", file, enforce_file_format=True)
