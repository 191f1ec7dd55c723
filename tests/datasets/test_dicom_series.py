"""DICOM series of CTs: the same patient as in NIfTI, and bad series are rejected with their reasons."""

from __future__ import annotations

import nibabel
import numpy as np
import pydicom
import pytest
from ct_files import AFFINE, rejected, save_ct
from dicom_files import write_ct_series, write_dicom

from phydict.datasets.cts.ct_rate import patient_of
from phydict.datasets.cts.ct_series import find_series, load_series
from phydict.datasets.cts.preparation import prepare_folder
from phydict.datasets.cts.reading import load_ct
from phydict.datasets.cts.spaces import Settings

SMALL = Settings(voxels=32)


@pytest.mark.parametrize("shuffle", [False, True])
def test_a_dicom_series_is_its_nifti_twin_voxel_for_voxel(tmp_path, thorax, shuffle):
    paths = write_ct_series(tmp_path / "s", thorax, AFFINE)
    if shuffle:
        for path, k in zip(paths, np.random.default_rng(0).permutation(len(paths))):
            path.rename(path.with_name(f"IM{k}"))
    (series,) = find_series(tmp_path)
    hu, affine = load_series(series)
    twin, twin_affine = load_ct(save_ct(tmp_path / "twin.nii.gz", thorax))
    assert np.array_equal(hu, twin)
    np.testing.assert_allclose(affine, twin_affine, atol=1e-4)


def test_the_prepared_dicom_is_the_prepared_nifti(tmp_path, thorax):
    write_ct_series(tmp_path / "in/anna/s", thorax, AFFINE)
    save_ct(tmp_path / "in/berta/s.nii.gz", thorax)
    dicom, nifti = sorted(prepare_folder(tmp_path / "in", tmp_path / "out", SMALL), key=lambda row: row["id"])
    assert (dicom["id"], nifti["id"]) == ("anna__s", "berta__s") and patient_of(dicom["id"]) == "anna"
    same = [column for column in dicom if column not in ("id", "source", "kind")]
    assert [dicom[column] for column in same] == [nifti[column] for column in same]
    for name in ("ct", "lung", "vessel", "body"):
        a, b = (nibabel.load(tmp_path / f"out/{row['id']}/{name}.nii.gz") for row in (dicom, nifti))
        assert np.array_equal(a.get_fdata(), b.get_fdata())
        np.testing.assert_allclose(a.affine, b.affine, atol=1e-4)


def test_slope_and_intercept_give_hu(tmp_path, thorax):
    stored = (thorax.astype(int) + 1000) // 2
    write_ct_series(tmp_path, stored - 1024, AFFINE, RescaleSlope=2, RescaleIntercept=-1000)
    assert np.array_equal(load_series(*find_series(tmp_path))[0], 2 * stored - 1000)


@pytest.mark.parametrize("kind, unsigned", [("SS", 0), ("US", 2**16)])
@pytest.mark.parametrize("value, reads", [(2000, -1000), (-2000, -2000)])
def test_padding_about_the_scan_is_no_denser_than_air(tmp_path, thorax, value, reads, kind, unsigned):
    hu = thorax.copy()
    hu[:3, :, 4:], hu[20, 20, 9] = value, value
    for path in write_ct_series(tmp_path, hu - 1024, AFFINE, RescaleIntercept=0, PixelRepresentation=1):
        dataset = pydicom.dcmread(path)
        dataset.add_new("PixelPaddingValue", kind, value % unsigned if unsigned else value)
        dataset.save_as(path)
    expected = hu.copy()
    expected[:3, :, 4:] = reads
    assert np.array_equal(load_series(*find_series(tmp_path))[0], expected)


def test_a_sagittal_series_is_the_same_patient(tmp_path, thorax):
    for k in range(thorax.shape[0]):
        corner = np.diag([-1.0, -1, 1, 1]) @ AFFINE @ [k, thorax.shape[1] - 1, thorax.shape[2] - 1, 1]
        write_dicom(tmp_path / f"{k}.dcm", (thorax[k, ::-1, ::-1].T + 1024).astype(np.uint16), "CT", RescaleSlope=1,
                    RescaleIntercept=-1024, PixelSpacing=[6, 6], ImagePositionPatient=list(corner[:3]),
                    ImageOrientationPatient=[0, 1, 0, 0, 0, -1])  # columns towards posterior, rows towards the feet
    hu, affine = load_series(*find_series(tmp_path))
    assert np.array_equal(hu, thorax)
    np.testing.assert_allclose(affine, AFFINE, atol=1e-4)


def test_two_series_in_one_folder_are_two_cases_of_one_patient(tmp_path, thorax):
    write_ct_series(tmp_path / "in/anna", thorax, AFFINE)
    for path in (tmp_path / "in/anna").glob("*.dcm"):
        path.rename(path.with_name("a" + path.name))
    write_ct_series(tmp_path / "in/anna", thorax + 60, AFFINE, SeriesNumber=4)
    write_dicom(tmp_path / "in/anna/scout", np.zeros((8, 8), np.uint16), "DX", SeriesInstanceUID="1.2.3")
    (tmp_path / "in/notes.txt").write_text("no DICOM")
    rows = {row["id"]: row for row in prepare_folder(tmp_path / "in", tmp_path / "out", SMALL)}
    assert [rows[f"anna__{n}"]["status"] for n in (3, 4)] == ["prepared"] * 2
    assert len(rows) == 3 and {patient_of(id) for id in rows} == {"anna"}
    (other,) = (row for row in rows.values() if row["status"] == "rejected")
    assert "its modality is DX, not CT" in other["reason"]
    a, b = (nibabel.load(tmp_path / f"out/anna__{n}/ct.nii.gz").get_fdata() for n in (3, 4))
    assert np.median((b - a)[a > 0]) == 60


def edit(paths, **tags):
    for path, values in zip(paths, zip(*tags.values())):
        dataset = pydicom.dcmread(path)
        for keyword, value in zip(tags, values):
            setattr(dataset, keyword, value)
        dataset.save_as(path)


def lacking(paths):
    dataset = pydicom.dcmread(paths[5])
    del dataset.RescaleIntercept
    dataset.save_as(paths[5])


def position(paths, shift):
    """ImagePositionPatient moved by shift(k) for slice k."""
    first = np.array(pydicom.dcmread(paths[0]).ImagePositionPatient, float)
    edit(paths, ImagePositionPatient=[list(first + [0, 0, 6 * k] + np.array(shift(k)))
                                      for k in range(len(paths))])


@pytest.mark.parametrize("spoil, reason", [
    (lambda p: [path.unlink() for path in p[3:]], "it has 3 slices, but a chest CT has at least 8"),
    (lambda p: p[7].unlink(), "1 of its slices is missing, the first between slice006.dcm and slice008.dcm"),
    (lambda p: [path.unlink() for path in (p[7], p[20], p[21])], "3 of its slices are missing"),
    (lambda p: (p[7].with_name("copy.dcm")).write_bytes(p[7].read_bytes()), "1 slices lie where another one does"),
    (lambda p: position(p, lambda k: [0, 0, 2.0 * max(0, k - 20)]), "unevenly spaced, from 6 to 8 mm"),
    (lambda p: position(p, lambda k: [0, 1.5 * k, 0]), "gantry was tilted by 14.0 degrees"),
    (lambda p: edit(p[9:10], PixelSpacing=[[5.0, 6.0]]), "PixelSpacing changes within the series"),
    (lambda p: edit(p, PixelSpacing=[[0.006] * 2] * len(p)), "it has voxels of 0.006 x 0.006 x 6 mm, or lies at"),
    (lambda p: edit(p, PixelSpacing=[[6000.0] * 2] * len(p)), "mm, which no CT does; correct PixelSpacing"),
    (lacking, "slice005.dcm lacks RescaleIntercept"),
    (lambda p: edit(p[9:10], PixelSpacing=[6.0]), "slice009.dcm: PixelSpacing must be 2 finite numbers"),
    (lambda p: p[7].write_bytes(p[7].read_bytes()[:1500]), "slice007.dcm cannot be read"),
    (lambda p: edit(p, ImageType=[["ORIGINAL", "PRIMARY", "LOCALIZER"]] * len(p)), "only localizer"),
    (lambda p: edit(p, NumberOfFrames=[2] * len(p)), "multi-frame")],
    ids=["3 slices", "gap", "gaps", "twice", "uneven", "tilt", "pixels", "metres", "micrometres", "no rescale",
         "one spacing", "cut", "localizer", "frames"])
def test_a_bad_series_is_rejected_with_its_reason(tmp_path, thorax, spoil, reason):
    spoil(write_ct_series(tmp_path / "in/s", thorax, AFFINE))
    (found,) = rejected(tmp_path / "in", tmp_path / "out")
    assert reason in found
