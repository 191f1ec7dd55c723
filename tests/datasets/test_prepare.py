"""Prepared CTs: what is kept of them, what they are read as, and which space they lie in."""

from __future__ import annotations

import json
import sys
import types

import nibabel
import numpy as np
import pytest
import torch
from ct_files import AFFINE, rejected, save_ct

from phydict.datasets.cts.ct_case import prepare_ct
from phydict.datasets.cts.ct_rate import CTCases, find_cts, load_case
from phydict.datasets.cts.preparation import prepare_folder
from phydict.datasets.cts.prepared import RECORD, read_prepared
from phydict.datasets.cts.reading import load_ct
from phydict.datasets.cts.resampling import to_grid
from phydict.datasets.cts.spaces import ATLAS_LUNGS_MM, ATLAS_MM, Settings, atlas_lungs
from phydict.grid import Cube, Grid
from phydict.training.data import PriorData
from phydict.training.settings import HoldOut
from phydict.units import AIR, HUWindow

SMALL = Settings(voxels=32)

WINDOW = HUWindow()


def test_bad_nifti_cts_are_rejected_with_their_reasons(tmp_path, thorax):
    save_ct(tmp_path / "in/a_slices.nii.gz", thorax[:, :, :3])
    save_ct(tmp_path / "in/b_lungless.nii.gz", np.where(thorax < -500, 30, thorax).astype(np.int16))
    save_ct(tmp_path / "in/c_cut.nii.gz", thorax)
    cut = tmp_path / "in/c_cut.nii.gz"
    cut.write_bytes(cut.read_bytes()[:-3000])
    three, lungless, damaged = rejected(tmp_path / "in", tmp_path / "out")
    assert "has 3 slices" in three and "no lungs were found" in lungless and "truncated or damaged" in damaged
    with pytest.raises(ValueError, match="has 3 slices .*, but a chest CT has at least 8; give the whole series"):
        CTCases(find_cts(tmp_path / "in/a_slices.nii.gz"), None, Grid.cube(32))[0]


def test_training_and_inference_read_prepared_cases_without_resampling(tmp_path, thorax):
    path = save_ct(tmp_path / "in/x/a.nii.gz", thorax)
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
        save_ct(tmp_path / f"in/{name}.nii.gz", (thorax + 1024).astype(np.int16))
    save_ct(tmp_path / "in/a_lungmask.nii.gz", (thorax == -850).astype(np.uint8))
    masked, lungless = prepare_folder(tmp_path / "in", tmp_path / "out", SMALL)
    assert (masked["status"], lungless["status"]) == ("prepared", "rejected")
    assert all("does not look like HU" in row["remark"] for row in (masked, lungless))
    (ct,) = find_cts(tmp_path / "out")
    with pytest.warns(UserWarning, match="a was prepared with the remark: .*does not look like HU"):
        load_case(ct, Grid.cube(32), WINDOW)


def test_a_coarser_case_is_the_same_whether_prepared_so_or_read_so(tmp_path, thorax):
    save_ct(tmp_path / "in/a.nii.gz", thorax)
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
    save_ct(tmp_path / "in/a.nii.gz", thorax)
    prepare_folder(tmp_path / "in", tmp_path / "out", SMALL)
    with pytest.raises(ValueError, match=sentence):
        read_prepared(tmp_path / "out/a/ct.nii.gz", grid, WINDOW)


def test_segmentations_beside_a_ct_are_used_and_are_no_cts(tmp_path, thorax):
    save_ct(tmp_path / "in/a.nii.gz", thorax)
    left, right = np.zeros((2, *thorax.shape), np.uint8)
    left[10:14, 16:22, 12:20], right[30:34, 16:22, 12:20] = 2, 1
    save_ct(tmp_path / "in/a_lungmask.nii.gz", left + right)
    vessel = np.zeros(thorax.shape, np.uint8)
    vessel[31, 18, 13:18] = 1
    save_ct(tmp_path / "in/a_totalsegmentator/lung_vessels.nii.gz", vessel)
    save_ct(tmp_path / "in/a_totalsegmentator/trachea.nii.gz", vessel)
    (row,) = prepare_folder(tmp_path / "in", tmp_path / "out", SMALL)
    assert row["lungs_by"] == "file" and row["lung_ml"] == pytest.approx(2 * 4 * 6 * 8 * 0.216, abs=1)
    case = load_case(*find_cts(tmp_path / "out"), Grid.cube(32), WINDOW)
    mass = case["masks"].sum((1, 2, 3)) * 1.728
    np.testing.assert_allclose(mass, [2 * 4 * 6 * 8 * 0.216, 5 * 0.216, 5 * 0.216], rtol=0.03)
    np.testing.assert_allclose(Grid((32,) * 3, affine=case["affine"].numpy()).centre,
                               AFFINE[:3, :3] @ [21.5, 18.5, 15.5] + AFFINE[:3, 3], atol=1.01)
    save_ct(tmp_path / "in/a_lungmask.nii.gz", (left + right)[:-1])
    assert "does not lie on its CT's voxels" in prepare_folder(tmp_path / "in", tmp_path / "o2", SMALL)[0]["reason"]
    (tmp_path / "in/a_lungmask.nii.gz").unlink()
    save_ct(tmp_path / "in/a_totalsegmentator/lung_upper_lobe_left.nii.gz", left)
    assert "holds 1 of the 5 lobes" in prepare_folder(tmp_path / "in", tmp_path / "o3", SMALL)[0]["reason"]


def test_segmentations_beside_a_ct_whose_header_is_not_trusted_are_placed_by_the_metadata_as_it_is(tmp_path, thorax):
    spacing = [float(side) for side in np.linalg.norm(AFFINE[:3, :3], axis=0)]
    table = tmp_path / "metadata.csv"
    table.write_text("VolumeName,RescaleSlope,RescaleIntercept,XYSpacing,ZSpacing\n"
                     f'valid_1_a_1.nii.gz,2,-500,"{spacing[:2]}",{spacing[2]}\n')
    (tmp_path / "in").mkdir()
    for name, stored in (("", (thorax + 500) // 2), ("_lungmask", (thorax == -850).astype(np.int16))):
        nibabel.save(nibabel.Nifti1Image(stored, np.eye(4)), tmp_path / f"in/valid_1_a_1{name}.nii.gz")
    (row,) = prepare_folder(tmp_path / "in", tmp_path / "out", SMALL, metadata=table, fixed=False)
    assert (row["status"], row["lungs_by"]) == ("prepared", "file"), row["reason"]
    assert row["lung_ml"] == pytest.approx((thorax == -850).sum() * np.prod(spacing) / 1000, abs=1)


def test_a_prepared_case_whose_masks_have_changed_is_cached_anew(tmp_path, thorax):
    save_ct(tmp_path / "in/a.nii.gz", thorax)
    prepare_folder(tmp_path / "in", tmp_path / "out", SMALL)
    cases = CTCases(find_cts(tmp_path / "out"), tmp_path / "cache", Grid.cube(32), WINDOW)
    assert cases[0]["has_masks"].tolist()[0] and len([*(tmp_path / "cache").iterdir()]) == 1
    (tmp_path / "out/a/lung.nii.gz").unlink()
    assert not cases[0]["has_masks"].tolist()[0]


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

    save_ct(tmp_path / "in/a.nii.gz", thorax)
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


def test_medsyns_space_scales_the_lungs_box_to_the_atlas_and_leads_back(tmp_path, thorax):
    save_ct(tmp_path / "in/a.nii.gz", np.where(thorax == -1000, -2000, thorax).astype(np.int16))
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
    measured = atlas_lungs(save_ct(tmp_path / "atlas.nii.gz", lungs, np.diag([-2.0, 2, 2, 1])))
    assert measured["atlas_lungs_mm"] == (240, 160, 240)
    np.testing.assert_allclose(measured["atlas_offset_mm"], [-2, 2, -6], atol=1e-4)
    with pytest.raises(ValueError, match="is not MedSyn's atlas"):
        atlas_lungs(save_ct(tmp_path / "small.nii.gz", lungs[:100]))
