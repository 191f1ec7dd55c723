"""Preparing CTs: DICOM equals NIfTI, a stopped run resumes, bad CTs are rejected with reasons, nothing is half done."""

from __future__ import annotations

import csv
import errno
import json
import os
import runpy
import shutil
import signal
import subprocess
import sys
import types
from pathlib import Path

import nibabel
import numpy as np
import pydicom
import pytest
import torch
from dicom_files import write_ct_series, write_dicom

from phydict.datasets.cts import cache, preparation
from phydict.datasets.cts.ct_rate import CTCases, find_cts, load_case, patient_of
from phydict.datasets.cts.ct_rate_tables import read_calibrations, read_reports
from phydict.datasets.cts.ct_series import find_series, load_series
from phydict.datasets.cts.preparation import SUMMARY, prepare_folder
from phydict.datasets.cts.prepared import RECORD, read_prepared
from phydict.datasets.cts.spaces import ATLAS_LUNGS_MM, ATLAS_MM, Settings, atlas_lungs
from phydict.datasets.cts.transforms import AIR, load_ct, prepare_ct, to_grid
from phydict.grid import Cube, Grid
from phydict.training.data import PriorData
from phydict.training.settings import HoldOut
from phydict.units import HUWindow

ROOT = Path(__file__).parents[2]
AFFINE = np.array([[6.0, 0, 0, 40], [0, 6, 0, -300], [0, 0, 6, 900], [0, 0, 0, 1]])
SMALL = Settings(voxels=32)
WINDOW = HUWindow()


@pytest.fixture(scope="module")
def thorax():
    """HU (44, 36, 34) of 6 mm RAS+ voxels: a body with two unequal lungs, and a bright ball at the patient's right."""
    x, y, z = np.meshgrid(*[np.arange(n) - (n - 1) / 2 for n in (44, 36, 34)], indexing="ij")
    hu = np.where((x / 20) ** 2 + (y / 15) ** 2 < 1, 40, -1000)
    hu[((x - 9) / 7) ** 2 + ((y - 1) / 9) ** 2 + ((z - 2) / 12) ** 2 < 1] = -850
    hu[((x + 9) / 6) ** 2 + ((y - 1) / 9) ** 2 + ((z - 2) / 11) ** 2 < 1] = -840
    hu[(x - 14) ** 2 + (y + 8) ** 2 + (z + 9) ** 2 < 6] = 900
    return hu.astype(np.int16)


def save(path, data, affine=AFFINE):
    path.parent.mkdir(parents=True, exist_ok=True)
    nibabel.save(nibabel.Nifti1Image(data, affine), path)
    return path


def contents(folder):
    """Every file below a folder with its bytes, gzip's own time stamps left out."""
    return {str(p.relative_to(folder)): nibabel.load(p).get_fdata().tobytes() if p.name.endswith(".gz")
            else p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file() and p.name != SUMMARY}


def rejected(folder, out, **settings):
    """The reasons of all CTs of a folder, which must all be rejected, leaving nothing but the summary."""
    rows = prepare_folder(folder, out, Settings(voxels=32, **settings))
    assert {row["status"] for row in rows} == {"rejected"} and [p.name for p in out.iterdir()] == [SUMMARY]
    assert [row["reason"] for row in csv.DictReader((out / SUMMARY).open())] == [row["reason"] for row in rows]
    return [row["reason"] for row in rows]


# DICOM

@pytest.mark.parametrize("shuffle", [False, True])
def test_a_dicom_series_is_its_nifti_twin_voxel_for_voxel(tmp_path, thorax, shuffle):
    paths = write_ct_series(tmp_path / "s", thorax, AFFINE)
    if shuffle:
        for path, k in zip(paths, np.random.default_rng(0).permutation(len(paths))):
            path.rename(path.with_name(f"IM{k}"))
    (series,) = find_series(tmp_path)
    hu, affine = load_series(series)
    twin, twin_affine = load_ct(save(tmp_path / "twin.nii.gz", thorax))
    assert np.array_equal(hu, twin)
    np.testing.assert_allclose(affine, twin_affine, atol=1e-4)


def test_the_prepared_dicom_is_the_prepared_nifti(tmp_path, thorax):
    write_ct_series(tmp_path / "in/anna/s", thorax, AFFINE)
    save(tmp_path / "in/berta/s.nii.gz", thorax)
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
    (lacking, "slice005.dcm lacks RescaleIntercept"),
    (lambda p: edit(p[9:10], PixelSpacing=[6.0]), "slice009.dcm: PixelSpacing must be 2 finite numbers"),
    (lambda p: p[7].write_bytes(p[7].read_bytes()[:1500]), "slice007.dcm cannot be read"),
    (lambda p: edit(p, ImageType=[["ORIGINAL", "PRIMARY", "LOCALIZER"]] * len(p)), "only localizer"),
    (lambda p: edit(p, NumberOfFrames=[2] * len(p)), "multi-frame")],
    ids=["3 slices", "gap", "gaps", "twice", "uneven", "tilt", "pixels", "no rescale", "one spacing",
         "cut", "localizer", "frames"])
def test_a_bad_series_is_rejected_with_its_reason(tmp_path, thorax, spoil, reason):
    spoil(write_ct_series(tmp_path / "in/s", thorax, AFFINE))
    (found,) = rejected(tmp_path / "in", tmp_path / "out")
    assert reason in found


# NIfTI

def test_bad_nifti_cts_are_rejected_with_their_reasons(tmp_path, thorax):
    save(tmp_path / "in/a_slices.nii.gz", thorax[:, :, :3])
    save(tmp_path / "in/b_lungless.nii.gz", np.where(thorax < -500, 30, thorax).astype(np.int16))
    save(tmp_path / "in/c_cut.nii.gz", thorax)
    cut = tmp_path / "in/c_cut.nii.gz"
    cut.write_bytes(cut.read_bytes()[:-3000])
    three, lungless, damaged = rejected(tmp_path / "in", tmp_path / "out")
    assert "has 3 slices" in three and "no lungs were found" in lungless and "truncated or damaged" in damaged
    with pytest.raises(ValueError, match="has 3 slices .*, but a chest CT has at least 8; give the whole series"):
        CTCases(find_cts(tmp_path / "in/a_slices.nii.gz"), None, Grid.cube(32))[0]


def test_training_and_inference_read_prepared_cases_without_resampling(tmp_path, thorax):
    path = save(tmp_path / "in/x/a.nii.gz", thorax)
    reports = tmp_path / "r.csv"
    reports.write_text("VolumeName,Findings_EN,Impressions_EN\nx__a.nii.gz,Two lungs.,\n")
    (row,) = prepare_folder(tmp_path / "in", tmp_path / "out", SMALL, reports=reports)
    (ct,) = find_cts(tmp_path / "out")
    assert (ct.id, ct.report) == ("x__a", "Findings: Two lungs.") and row["lungs_inside"] == pytest.approx(1, abs=1e-3)
    case, direct = load_case(ct, Grid.cube(32), WINDOW), prepare_ct(path, Grid.cube(32), WINDOW)
    torch.testing.assert_close(case["volume"], direct["volume"], atol=0.51 / WINDOW.half_width, rtol=0)
    torch.testing.assert_close(case["masks"], direct["masks"], atol=1 / 255, rtol=0)
    for key in ("has_masks", "affine"):
        torch.testing.assert_close(case[key], direct[key], atol=1e-4, rtol=0)
    assert {key: value.dtype for key, value in case.items() if torch.is_tensor(value)} == {
        key: value.dtype for key, value in direct.items() if torch.is_tensor(value)}
    coarse = load_case(ct, Grid.cube(16), HUWindow(-1000, 3000))["volume"]
    fine = load_case(ct, Grid.cube(32), HUWindow(-1000, 3000))["volume"]
    torch.testing.assert_close(coarse, torch.nn.functional.avg_pool3d(fine, 2), atol=1e-5, rtol=0)
    data = PriorData(cts=str(tmp_path / "out"), phantoms=0, cache=str(tmp_path / "cache"), cube=Cube(32),
                     holdout=HoldOut(phantoms=1))
    assert len(data.cts) == 1 and data.cts[0]["volume"].shape == (1, 32, 32, 32) and data.reports == [ct.report]


def test_what_was_remarkable_when_a_ct_was_prepared_is_said_wherever_it_is_read(tmp_path, thorax):
    for name in ("a", "b"):
        save(tmp_path / f"in/{name}.nii.gz", (thorax + 1024).astype(np.int16))
    save(tmp_path / "in/a_lungmask.nii.gz", (thorax == -850).astype(np.uint8))
    masked, lungless = prepare_folder(tmp_path / "in", tmp_path / "out", SMALL)
    assert (masked["status"], lungless["status"]) == ("prepared", "rejected")
    assert all("does not look like HU" in row["remark"] for row in (masked, lungless))
    (ct,) = find_cts(tmp_path / "out")
    with pytest.warns(UserWarning, match="a was prepared with the remark: .*does not look like HU"):
        load_case(ct, Grid.cube(32), WINDOW)


def test_a_coarser_case_is_the_same_whether_prepared_so_or_read_so(tmp_path, thorax):
    save(tmp_path / "in/a.nii.gz", thorax)
    prepare_folder(tmp_path / "in", tmp_path / "fine", Settings(voxels=64))
    prepare_folder(tmp_path / "in", tmp_path / "coarse", SMALL)
    wide = HUWindow(-1000, 3000)
    for grid in (Grid.cube(32), Grid.cube(16)):
        fine, coarse = (load_case(*find_cts(tmp_path / name), grid, wide) for name in ("fine", "coarse"))
        assert (fine["volume"] - coarse["volume"]).abs().max() * wide.half_width < 1.1
        torch.testing.assert_close(fine["affine"], coarse["affine"], atol=1e-5, rtol=0)
    part = load_case(*find_cts(tmp_path / "fine"), Grid.cube(24, 288), wide)
    np.testing.assert_allclose(Grid((24,) * 3, affine=part["affine"].numpy()).centre,
                               Grid((16,) * 3, affine=fine["affine"].numpy()).centre, atol=1e-4)
    inner = load_case(*find_cts(tmp_path / "coarse"), Grid.cube(32), wide)["volume"][:, 4:28, 4:28, 4:28]
    assert (part["volume"] - inner).abs().mean() * wide.half_width < 15, "a part of the box is resampled in its place"


@pytest.mark.parametrize("grid, sentence", [
    (Grid.cube(32, 400), "as a box of 384 x 384 x 384 mm, but 400 x 400 x 400 mm are needed; .* --side 400"),
    (Grid.cube(64), "with voxels of 12 mm, but 6 mm are needed; .* --voxels 64")])
def test_more_than_was_prepared_is_refused(tmp_path, thorax, grid, sentence):
    save(tmp_path / "in/a.nii.gz", thorax)
    prepare_folder(tmp_path / "in", tmp_path / "out", SMALL)
    with pytest.raises(ValueError, match=sentence):
        read_prepared(tmp_path / "out/a/ct.nii.gz", grid, WINDOW)


# segmentations

def test_segmentations_beside_a_ct_are_used_and_are_no_cts(tmp_path, thorax):
    save(tmp_path / "in/a.nii.gz", thorax)
    left, right = np.zeros((2, *thorax.shape), np.uint8)
    left[10:14, 16:22, 12:20], right[30:34, 16:22, 12:20] = 2, 1
    save(tmp_path / "in/a_lungmask.nii.gz", left + right)
    vessel = np.zeros(thorax.shape, np.uint8)
    vessel[31, 18, 13:18] = 1
    save(tmp_path / "in/a_totalsegmentator/lung_vessels.nii.gz", vessel)
    save(tmp_path / "in/a_totalsegmentator/trachea.nii.gz", vessel)
    (row,) = prepare_folder(tmp_path / "in", tmp_path / "out", SMALL)
    assert row["lungs_by"] == "file" and row["lung_ml"] == pytest.approx(2 * 4 * 6 * 8 * 0.216, abs=1)
    case = load_case(*find_cts(tmp_path / "out"), Grid.cube(32), WINDOW)
    mass = case["masks"].sum((1, 2, 3)) * 1.728
    np.testing.assert_allclose(mass, [2 * 4 * 6 * 8 * 0.216, 5 * 0.216, 5 * 0.216], rtol=0.03)
    np.testing.assert_allclose(Grid((32,) * 3, affine=case["affine"].numpy()).centre,
                               AFFINE[:3, :3] @ [21.5, 18.5, 15.5] + AFFINE[:3, 3], atol=1.01)
    save(tmp_path / "in/a_lungmask.nii.gz", (left + right)[:-1])
    assert "does not lie on its CT's voxels" in prepare_folder(tmp_path / "in", tmp_path / "o2", SMALL)[0]["reason"]
    (tmp_path / "in/a_lungmask.nii.gz").unlink()
    save(tmp_path / "in/a_totalsegmentator/lung_upper_lobe_left.nii.gz", left)
    assert "holds 1 of the 5 lobes" in prepare_folder(tmp_path / "in", tmp_path / "o3", SMALL)[0]["reason"]


def test_lungmask_sees_slices_as_it_was_trained(tmp_path, thorax, monkeypatch):
    class LMInferer:
        """Air in the first columns, which are the patient's right in LPS order, from slice 20 upwards."""

        def __init__(self, **_):
            pass

        def apply(self, image):
            assert image.shape == thorax.shape[::-1]
            labels = np.zeros(image.shape, np.uint8)
            labels[20:, :, :20] = image[20:, :, :20] < -500
            return labels

    save(tmp_path / "in/a.nii.gz", thorax)
    monkeypatch.setitem(sys.modules, "lungmask", None)
    (reason,) = rejected(tmp_path / "in", tmp_path / "out", segmenter="lungmask")
    assert "pip install 'phydict[lungmask]'" in reason
    monkeypatch.setitem(sys.modules, "lungmask", types.SimpleNamespace(LMInferer=LMInferer))
    (row,) = prepare_folder(tmp_path / "in", tmp_path / "out", Settings(voxels=32, segmenter="lungmask"))
    assert row["lungs_by"] == "lungmask"
    lung = nibabel.load(tmp_path / "out/a/lung.nii.gz")
    world = np.argwhere(lung.get_fdata() > 0.5) @ lung.affine[:3, :3].T + lung.affine[:3, 3]
    middle = AFFINE[:3, :3] @ [21.5, 0, 19.5] + AFFINE[:3, 3]
    inside = thorax[24:, :, 20:] < -500
    assert len(world) * 1.728 == pytest.approx(inside.sum() * 0.216, rel=0.25)
    assert (world[:, 0] > middle[0]).all() and (world[:, 2] > middle[2] - 7).all()


# MedSyn's space

def test_medsyns_space_scales_the_lungs_box_to_the_atlas_and_leads_back(tmp_path, thorax):
    save(tmp_path / "in/a.nii.gz", np.where(thorax == -1000, -2000, thorax).astype(np.int16))
    settings = Settings(voxels=64, space="medsyn", window=(-1024.0, 600.0))
    (_row,) = prepare_folder(tmp_path / "in", tmp_path / "out", settings)
    lung, ct = (nibabel.load(tmp_path / f"out/a/{name}.nii.gz") for name in ("lung", "ct"))
    assert nibabel.aff2axcodes(ct.affine) == ("S", "A", "L")
    voxel = np.array(ATLAS_MM)[::-1] / 64
    atlas = np.array(json.loads((tmp_path / "out/a" / RECORD).read_text())["atlas_affine"])
    np.testing.assert_allclose(nibabel.affines.voxel_sizes(atlas), voxel)
    assert nibabel.aff2axcodes(atlas) == ("S", "A", "L")
    np.testing.assert_allclose(atlas[:3, :3] @ np.full(3, 31.5) + atlas[:3, 3], 0, atol=1e-9)
    box = np.argwhere(lung.get_fdata() > 0.5)
    size = (box.max(0) - box.min(0) + 1) * voxel
    np.testing.assert_allclose(size, ATLAS_LUNGS_MM[::-1], atol=1.6 * voxel.max())
    np.testing.assert_allclose((box.max(0) + box.min(0)) / 2, 31.5, atol=0.6)
    ball = np.argwhere(ct.get_fdata() > 500).mean(0)
    true = AFFINE[:3, :3] @ np.argwhere(thorax > 500).mean(0) + AFFINE[:3, 3]
    np.testing.assert_allclose(ct.affine[:3, :3] @ ball + ct.affine[:3, 3], true, atol=3)
    assert ct.get_fdata().min() == -1024
    assert (ct.header["cal_min"], ct.header["cal_max"]) == (-1024, 600)
    np.testing.assert_allclose(ct.get_qform(), ct.affine, atol=1e-3)
    grid = Grid((32,) * 3, np.array(ATLAS_MM) / 32)
    case = load_case(*find_cts(tmp_path / "out"), grid, HUWindow(-1024, 600))
    hu, affine = load_ct(tmp_path / "in/a.nii.gz")
    again = to_grid(hu.clip(-1024), affine, Grid((32,) * 3, affine=case["affine"].numpy()), AIR)
    inside = again > -900
    found = HUWindow(-1024, 600).to_hu(case["volume"][0].numpy())
    assert inside.mean() > 0.2 and abs(found - again.clip(max=600))[inside].max() < 2
    with pytest.raises(ValueError, match="prepared in MedSyn's space, a box of 316 x 316 x 292 mm.* --space patient"):
        load_case(*find_cts(tmp_path / "out"), Grid.cube(32), WINDOW)


def test_the_atlas_is_measured_from_a_copy_of_it(tmp_path):
    lungs = np.zeros((158, 158, 146), np.uint8)
    lungs[20:140, 40:120, 10:130] = 1
    measured = atlas_lungs(save(tmp_path / "atlas.nii.gz", lungs, np.diag([-2.0, 2, 2, 1])))
    assert measured["atlas_lungs_mm"] == (240, 160, 240)
    np.testing.assert_allclose(measured["atlas_offset_mm"], [-2, 2, -6], atol=1e-4)
    with pytest.raises(ValueError, match="is not MedSyn's atlas"):
        atlas_lungs(save(tmp_path / "small.nii.gz", lungs[:100]))


# runs

def test_two_workers_give_what_one_gives(tmp_path, thorax):
    for n in range(3):
        save(tmp_path / f"in/{n}.nii.gz", thorax + np.int16(10 * n))
    save(tmp_path / "in/short.nii.gz", thorax[:, :, :3])
    one, two = (prepare_folder(tmp_path / "in", tmp_path / str(workers), SMALL, workers) for workers in (1, 2))
    assert one == two and [row["status"] for row in one] == ["prepared"] * 3 + ["rejected"]
    assert contents(tmp_path / "1") == contents(tmp_path / "2")
    assert (tmp_path / "1" / SUMMARY).read_bytes() == (tmp_path / "2" / SUMMARY).read_bytes()


def test_a_killed_run_goes_on_where_it_was(tmp_path, thorax):
    for n in range(3):
        save(tmp_path / f"in/{n}.nii.gz", thorax + np.int16(10 * n))
    code = ("import os, signal\nfrom phydict.datasets.cts import preparation as p\nwrite = p.write_prepared\n"
            "def writes(folder, grid, images, record):\n"
            "    write(folder, grid, images, record)\n"
            "    if record['id'] == '1': os.kill(os.getpid(), signal.SIGKILL)\n"
            f"p.write_prepared = writes\np.prepare_folder({str(tmp_path / 'in')!r}, {str(tmp_path / 'out')!r}, "
            "p.Settings(voxels=32))")
    killed = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert killed.returncode == -signal.SIGKILL, killed.stderr
    assert (tmp_path / "out/0" / RECORD).is_file() and not (tmp_path / "out/1").exists()
    assert any(p.name.endswith(".partial") for p in (tmp_path / "out").iterdir())
    assert [ct.id for ct in find_cts(tmp_path / "out")] == ["0"], "what is half-written is no case"
    before = {p: p.stat().st_mtime_ns for p in (tmp_path / "out/0").iterdir()}
    rows = prepare_folder(tmp_path / "in", tmp_path / "out", SMALL)
    assert {p: p.stat().st_mtime_ns for p in (tmp_path / "out/0").iterdir()} == before
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["0", "1", "2", SUMMARY]
    assert rows == prepare_folder(tmp_path / "in", tmp_path / "whole", SMALL)
    assert contents(tmp_path / "out") == contents(tmp_path / "whole")


def test_a_changed_input_is_prepared_again_and_other_settings_are_refused(tmp_path, thorax):
    save(tmp_path / "in/a.nii", thorax)
    prepare_folder(tmp_path / "in", tmp_path / "out", SMALL)
    save(tmp_path / "in/a.nii", thorax[:, :, 1:] + np.int16(100))
    prepare_folder(tmp_path / "in", tmp_path / "out", SMALL)
    assert nibabel.load(tmp_path / "out/a/ct.nii.gz").get_fdata().max() > 900
    with pytest.raises(ValueError, match="was prepared with other settings"):
        prepare_folder(tmp_path / "in", tmp_path / "out", Settings(voxels=16))
    (tmp_path / "out/a" / RECORD).write_text("{")
    with pytest.raises(ValueError, match="case.json cannot be read .* prepare that CT again"):
        find_cts(tmp_path / "out")


def notes_inside(case):
    (case / "notes.txt").write_text("mine")


def strangers(case):
    shutil.rmtree(case)
    case.mkdir()
    notes_inside(case)


def linked(case):
    case.rename(case.with_name("elsewhere"))
    case.symlink_to(case.with_name("elsewhere"))


def dangling(case):
    shutil.rmtree(case)
    case.symlink_to(case.with_name("nowhere"))


@pytest.mark.parametrize("when", ["at the start", "when a case takes its place"])
@pytest.mark.parametrize("change", [notes_inside, strangers, linked, dangling])
def test_what_no_preparation_wrote_is_never_replaced(tmp_path, thorax, monkeypatch, change, when):
    save(tmp_path / "in/a.nii", thorax)
    prepare_folder(tmp_path / "in", tmp_path / "out", SMALL)
    save(tmp_path / "in/a.nii", thorax[:, :, 1:])  # so that it is prepared again
    case = tmp_path / "out/a"
    if when == "at the start":
        change(case)
    else:
        write = preparation.write_prepared
        monkeypatch.setattr(preparation, "write_prepared", lambda *given: (write(*given), change(case)))
    with pytest.raises(ValueError, match="out/a .* is not replaced: move .* away, or give another output folder"):
        prepare_folder(tmp_path / "in", tmp_path / "out", SMALL)
    assert case.is_symlink() == (change in (linked, dangling)) and case.exists() == (change is not dangling)
    assert change in (linked, dangling) or (case / "notes.txt").read_text() == "mine"
    assert change is not linked or (case / RECORD).is_file()
    assert not any(path.name.startswith(".") for path in (tmp_path / "out").iterdir())


def test_a_summary_of_someone_elses_is_never_replaced(tmp_path, thorax):
    save(tmp_path / "in/a.nii", thorax)
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / SUMMARY).write_text("patient,mine\n")
    with pytest.raises(ValueError, match="summary.csv is no summary of prepared cases, and is not replaced"):
        prepare_folder(tmp_path / "in", tmp_path / "out", SMALL)
    assert (tmp_path / "out" / SUMMARY).read_text() == "patient,mine\n" and len(list((tmp_path / "out").iterdir())) == 1


def full(*_, **__):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_a_full_disk_stops_the_preparation_with_one_sentence_and_nothing_half_written(tmp_path, thorax, monkeypatch):
    for n in range(2):
        save(tmp_path / f"in/{n}.nii.gz", thorax)
    whole = nibabel.save

    def later(image, path):
        return full() if "1" in path.parent.name.split(".")[1] and path.name == "lung.nii.gz" else whole(image, path)

    monkeypatch.setattr(nibabel, "save", later)
    with pytest.raises(OSError, match="the case .*1 could not be written \\(No space left on device\\): free some sp"):
        prepare_folder(tmp_path / "in", tmp_path / "out", SMALL)
    assert [p.name for p in (tmp_path / "out").iterdir()] == ["0"], "the finished case stays, alone"


def test_a_full_disk_while_caching_is_one_sentence_and_leaves_nothing(tmp_path, thorax, monkeypatch):
    save(tmp_path / "a.nii.gz", thorax)

    def half(stream, **_):
        stream.write(b"half")
        full()

    monkeypatch.setattr(cache.np, "savez_compressed", half)
    cases = CTCases(find_cts(tmp_path / "a.nii.gz"), tmp_path / "cache", Grid.cube(32))
    with pytest.raises(OSError, match="could not be written \\(No space left on device\\): free some space, or give"):
        cases[0]
    assert not [*(tmp_path / "cache").iterdir()]


def test_settings_and_places_that_cannot_be_are_refused(tmp_path, thorax):
    save(tmp_path / "in/a.nii.gz", thorax)
    for out in (tmp_path / "in/out", tmp_path):
        with pytest.raises(ValueError, match="lie inside each other"):
            prepare_folder(tmp_path / "in", out)
    (tmp_path / "empty").mkdir()
    with pytest.raises(FileNotFoundError, match="there is no CT in .*empty; give a NIfTI file, or a folder"):
        prepare_folder(tmp_path / "empty", tmp_path / "out")
    for wrong, sentence in (({"voxels": 4}, "at least 8 voxels"), ({"side": 0}, "a side above 0"),
                            ({"window": (5, 5)}, "low < high"), ({"space": "atlas"}, "space is patient or medsyn"),
                            ({"segmenter": "x"}, "segmenter is threshold or lungmask")):
        with pytest.raises(ValueError, match=sentence):
            Settings(**wrong)


def test_the_recipe_prints_counts_and_fails_in_one_sentence(tmp_path, thorax, capsys, monkeypatch):
    main = runpy.run_path(str(ROOT / "data/prepare_cts.py"))["main"]
    save(tmp_path / "in/a.nii.gz", thorax)
    save(tmp_path / "in/b.nii.gz", thorax[:, :, :3])
    main([str(tmp_path / "in"), str(tmp_path / "out"), "--voxels=32", "--space=medsyn"])
    out, err = capsys.readouterr()
    assert "1 prepared, 1 rejected" in out and "CTs: 2 cases to prepare" in err and "b: rejected: " in err
    record = json.loads((tmp_path / "out/a" / RECORD).read_text())
    assert record["window"] == [-1024, 600] and record["settings"]["space"] == "medsyn"
    for args in ([str(tmp_path / "in/b.nii.gz"), str(tmp_path / "o2")], [str(tmp_path / "in"), str(tmp_path / "in/x")],
                 [str(tmp_path / "none"), str(tmp_path / "o3")]):
        with pytest.raises(SystemExit) as stopped:
            main(args)
        err = capsys.readouterr().err.strip().splitlines()
        assert stopped.value.code == 2 and err[-1].startswith("error: ")


# tables

@pytest.mark.parametrize("text, sentence", [
    ("VolumeName,Findings_EN\na,b\n", "lacks the columns Impressions_EN"),
    ("", "lacks the columns VolumeName, Findings_EN, Impressions_EN"),
    ("VolumeName,Findings_EN,Impressions_EN\na.nii.gz,x,\nb,x,\na.nii.gz,y,\n", "a has two rows, the second in row 4"),
    ("VolumeName,Findings_EN,Impressions_EN\n,x,y\n", "row 2 of .* has no VolumeName"),
    ("VolumeName,Findings_EN,Impressions_EN\na,caf\xe9,\n", "cannot be read .* save it as CSV in UTF-8")])
def test_bad_report_tables_are_one_sentence(tmp_path, text, sentence):
    (tmp_path / "r.csv").write_bytes(text.encode("latin-1"))
    with pytest.raises(ValueError, match=sentence) as caught:
        read_reports(tmp_path / "r.csv")
    assert "\n" not in str(caught.value)


def test_a_volume_with_two_rows_of_metadata_is_refused(tmp_path):
    row = 'a.nii.gz,1,0,"[1, 1]",1\n'
    (tmp_path / "m.csv").write_text("VolumeName,RescaleSlope,RescaleIntercept,XYSpacing,ZSpacing\n" + 2 * row)
    with pytest.raises(ValueError, match="a has two rows"):
        read_calibrations(tmp_path / "m.csv")


@pytest.mark.parametrize("record", ["null", "3", "[]", '{"id": "a", "space": "patient", "extent": [1, 1, 1], '
                                    '"window": [0, 1], "report": "", "row": [1]}'])
def test_a_record_that_is_none_is_refused_by_name(tmp_path, thorax, record):
    save(tmp_path / "a" / "ct.nii.gz", thorax)
    (tmp_path / "a" / RECORD).write_text(record)
    with pytest.raises(ValueError, match=f"{RECORD} cannot be read .it is damaged"):
        find_cts(tmp_path)


@pytest.mark.parametrize("option", ["--side=nan", "--window=[nan,nan]", "--voxels=many", "--work=2"])
def test_an_option_that_cannot_be_is_one_sentence(tmp_path, capsys, option):
    main = runpy.run_path(str(ROOT / "data" / "prepare_cts.py"))["main"]
    with pytest.raises(SystemExit) as stopped:
        main([str(tmp_path), str(tmp_path / "out"), option])
    said = capsys.readouterr().err
    assert stopped.value.code == 2 and said.startswith("error: ") and said.count("\n") == 1
