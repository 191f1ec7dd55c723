"""Laws of CT input: a patient gives the same Case however it is stored, and bad files are named in a sentence."""

from __future__ import annotations

import csv
import dataclasses
import gzip
import re
import struct
import warnings

import nibabel
import numpy as np
import pytest
import torch

from phydict.datasets.cts.augment import Augmentation, Deformation, augment
from phydict.datasets.surroundings.surroundings import Surroundings
from phydict.datasets.cts.ct_rate import CTCases, find_cts, patient_of, split_by_patient
from phydict.datasets.cts.ct_rate_tables import read_reports
from phydict.datasets.cts.transforms import AIR, Calibration, covering_grid, load_ct, prepare_ct, to_grid
from phydict.grid import Grid
from phydict.units import HUWindow

GRID = Grid.cube(32)
AFFINE = np.array([[6.0, 0, 0, 40], [0, 6, 0, -300], [0, 0, 6, 900], [0, 0, 0, 1]])
LIVER = np.array([250.0, -150.0, 980.0])
"""World position in mm of a bright ball at the patient's right, in the phantom below."""


@pytest.fixture(scope="module")
def thorax():
    """HU (54, 46, 50) of 6 mm RAS+ voxels: a body with two lungs, and a ball at LIVER below the right lung."""
    x, y, z = np.meshgrid(*[np.arange(n) - (n - 1) / 2 for n in (54, 46, 50)], indexing="ij")
    hu = np.where((x / 25) ** 2 + (y / 18) ** 2 < 1, 40.0, AIR)
    hu[((abs(x) - 11) / 8) ** 2 + ((y - 2) / 11) ** 2 + ((z - 6) / 14) ** 2 < 1] = -850
    world = np.stack([x + 26.5, y + 22.5, z + 24.5], -1) * 6 + AFFINE[:3, 3]
    hu[((world - LIVER) ** 2).sum(-1) < 20**2] = 900
    return hu.astype(np.int16)


@pytest.fixture(autouse=True)
def warnings_are_errors():
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        yield


def save(path, data, affine=AFFINE):
    path.parent.mkdir(parents=True, exist_ok=True)
    nibabel.save(nibabel.Nifti1Image(data, affine), path)
    return path


def stored_as(axcodes, data, path):
    image = nibabel.Nifti1Image(data, AFFINE)
    wanted = nibabel.orientations.axcodes2ornt(axcodes)
    turn = nibabel.orientations.ornt_transform(nibabel.io_orientation(AFFINE), wanted)
    path.parent.mkdir(parents=True, exist_ok=True)
    nibabel.save(image.as_reoriented(turn), path)
    return path


def write_csv(path, columns, *rows):
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="") as file:
        csv.writer(file).writerows([columns, *rows])
    return path


def fails(sentence, path, error=ValueError):
    with pytest.raises(error, match=sentence) as caught:
        load_ct(path)
    assert str(path) in str(caught.value)


# resampling

@pytest.mark.parametrize("spacing", [0.7, 2.3, 6.0, 13.0])
def test_resampling_preserves_the_integral(spacing):
    volume = np.random.default_rng(0).normal(size=(11, 9, 13)).astype(np.float32)
    affine = np.diag([1.5, 2.0, 0.7, 1.0])
    wider = affine.copy()
    wider[:3, 3] = -2 * np.diag(affine)[:3]
    grid = covering_grid((15, 13, 17), wider, spacing)
    new = to_grid(volume, affine, grid, 0.0)
    assert new.sum() * np.prod(grid.spacing) == pytest.approx(volume.sum() * 1.5 * 2.0 * 0.7, rel=1e-3)


def test_a_constant_stays_and_padding_lies_outside():
    grid = Grid((10,) * 3, affine=np.diag([7.0, 7, 7, 1]))
    new = to_grid(np.full((20, 20, 20), 7.0), np.diag([3.0, 3, 3, 1]), grid, AIR)
    assert new[1:7, 1:7, 1:7] == pytest.approx(7, abs=1e-3) and new[-1, -1, -1] == pytest.approx(AIR, abs=1e-3)


@pytest.mark.parametrize("spacing", [0.5, 1.7, 4.0])
def test_a_linear_ramp_is_reproduced(spacing):
    ramp = np.broadcast_to(np.arange(40.0)[:, None, None], (40, 8, 8))
    grid = Grid((5, 2, 2), affine=np.array([[spacing, 0, 0, 10], [0, 1, 0, 3], [0, 0, 1, 3], [0, 0, 0, 1]]))
    np.testing.assert_allclose(to_grid(ramp, np.eye(4), grid, 0)[:, 0, 0], 10 + spacing * np.arange(5), rtol=1e-5)


def test_detail_finer_than_a_voxel_is_averaged_not_sampled():
    board = (np.indices((64, 64, 64)).sum(0) % 2 * 2000.0 - 1000).astype(np.float32)
    grid = Grid((10,) * 3, affine=np.array([[5.3, 0, 0, 6], [0, 5.3, 0, 6], [0, 0, 5.3, 6], [0, 0, 0, 1]]))
    assert np.abs(to_grid(board, np.eye(4), grid, 0)).max() < 10


@pytest.mark.parametrize("degrees, tilt", [(0, 0), (20, 0), (0, 0.8)], ids=["straight", "turned", "tilted gantry"])
def test_a_ball_keeps_its_world_position_and_mass(degrees, tilt):
    turn, angle = np.eye(4), np.radians(degrees)
    turn[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    affine = turn @ np.diag([1.5, 1.5, 2.0, 1.0])
    affine[1, 2] = tilt  # mm from slice to slice: shear
    affine[:3, 3] = -45, -60, -50
    index = np.stack(np.indices((60, 60, 50)), -1)
    centre = np.array([12.0, -8.0, 5.0])
    if degrees or tilt:
        centre = affine[:3, :3] @ [32, 30, 28] + affine[:3, 3]
    ball = (((index @ affine[:3, :3].T + affine[:3, 3] - centre) ** 2).sum(-1) < 14**2).astype(np.float32)
    grid = Grid.cube(32, 192)
    new = to_grid(ball, affine, grid, 0.0)
    found = np.average(np.indices(new.shape).reshape(3, -1), axis=1, weights=new.ravel())
    np.testing.assert_allclose(grid.affine[:3, :3] @ found + grid.affine[:3, 3], centre, atol=0.3)
    assert new.sum() * 6**3 == pytest.approx(ball.sum() * 1.5 * 1.5 * 2, rel=0.01)


# orientation and place

@pytest.mark.parametrize("axcodes", ["LPS", "LAS", "SPL", "AIR"])
def test_the_same_patient_in_any_axis_order_gives_the_same_case(tmp_path, thorax, axcodes):
    case = prepare_ct(stored_as("RAS", thorax, tmp_path / "a.nii"), GRID)
    other = prepare_ct(stored_as(axcodes, thorax, tmp_path / "b.nii.gz"), GRID)
    for key in ("volume", "masks", "affine"):
        torch.testing.assert_close(case[key], other[key], atol=1e-3, rtol=0)
    assert (case["id"], other["id"]) == ("a", "b")


def test_a_case_keeps_its_place_in_the_world(thorax):
    case = prepare_ct((thorax.astype(np.float32), AFFINE), GRID)
    grid = Grid(GRID.shape, affine=case["affine"].numpy())
    index = np.rint(grid.index(LIVER)).astype(int)
    assert case["volume"][0][tuple(index)] > 0.5
    assert index[0] > 16, "the patient's right lies at high i"
    lungs = np.argwhere(case["masks"][0].numpy() > 0.5)
    np.testing.assert_allclose((lungs.min(0) + lungs.max(0)) / 2, 15.5, atol=0.6)
    assert case["centred_on"] == "lungs" and case["has_masks"].tolist() == [True, False, True]


def test_outside_the_scan_is_air_and_the_window_clips(thorax):
    dense = np.where(thorax > 0, 3.0 * thorax, np.where(thorax == AIR, -3024.0, thorax))
    case = prepare_ct((dense, AFFINE), Grid.cube(32, 600), HUWindow(-1000, 600))
    assert case["volume"][0, 0, 0, 0] == -1 and case["volume"].max() == 1 and case["volume"].min() == -1


def test_without_lungs_the_scan_is_centred_with_a_warning():
    ball = np.full((40, 40, 40), AIR, np.float32)
    ball[10:30, 10:30, 10:30] = 40
    with pytest.warns(UserWarning, match="no lungs were found in ball"):
        case = prepare_ct((ball, np.diag([4.0, 4, 4, 1])), GRID, id="ball")
    np.testing.assert_allclose(Grid(GRID.shape, affine=case["affine"].numpy()).centre, 78)
    assert case["centred_on"] == "volume" and not case["has_masks"].any() and not case["masks"].any()


@pytest.mark.parametrize("wrong, sentence", [(lambda hu: hu + 1024, "no value lies below -300"),
                                                 (lambda hu: hu / 2, "the most frequent value below -300 is -490"),
                                                 (lambda hu: hu - 1024, "only 0.* % of it lies above -200")])
def test_numbers_that_are_not_hu_are_warned_of(thorax, wrong, sentence):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        prepare_ct((wrong(thorax.astype(np.float32)), AFFINE), GRID, id="odd")
    assert re.search(f"odd does not look like HU: {sentence}", " ".join(str(w.message) for w in caught))


# bad files

def test_missing_and_unreadable_files(tmp_path, thorax):
    fails("there is no CT file", tmp_path / "absent.nii.gz", FileNotFoundError)
    path = tmp_path / "text.nii.gz"
    path.write_text("not a volume")
    fails("cannot be read .* convert it to NIfTI", path)
    for name in ("cut.nii", "cut.nii.gz"):
        path = save(tmp_path / name, thorax)
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
        fails("truncated or damaged", path)
    path = tmp_path / "broken.nii.gz"
    data = bytearray(gzip.compress(b"\0" * 400))
    path.write_bytes(bytes(data))
    fails("cannot be read .* convert it to NIfTI", path)


def test_2d_4d_and_slices_are_refused_but_one_frame_of_4d_is_read(tmp_path, thorax):
    fails("2D with shape", save(tmp_path / "a.nii", thorax[:, :, 0]))
    fails("single 2D slice", save(tmp_path / "b.nii", thorax[:, :, :1]))
    fails("4D with shape", save(tmp_path / "c.nii", np.stack([thorax] * 2, -1)))
    hu, _ = load_ct(save(tmp_path / "d.nii", thorax[..., None]))
    assert (hu == thorax).all()


def test_a_file_without_orientation_is_refused_unless_calibrated(tmp_path, thorax):
    image = nibabel.Nifti1Image(thorax, None)
    nibabel.save(image, tmp_path / "a.nii")
    fails("neither sform nor qform is set", tmp_path / "a.nii")
    hu, affine = load_ct(tmp_path / "a.nii", Calibration(2.0, -1000.0, (0.7, 0.8, 2.5)))
    np.testing.assert_allclose(np.diag(affine), [0.7, 0.8, 2.5, 1])
    assert (hu == 2 * thorax[::-1, ::-1].astype(np.float32) - 1000).all(), "v1 is stored as left, posterior, superior"


def test_nan_and_flat_voxels_are_refused(tmp_path, thorax):
    bad = thorax.astype(np.float32)
    bad[3, 4, 5:8] = np.nan, np.inf, -np.inf
    fails("holds 3 NaN or infinite voxels", save(tmp_path / "nan.nii", bad))
    image = nibabel.Nifti1Image(thorax, AFFINE)
    data = bytearray(image.to_bytes())
    data[312:328] = bytes(16)  # srow_z
    (tmp_path / "flat.nii").write_bytes(bytes(data))
    fails("voxels without volume", tmp_path / "flat.nii")


def test_scaled_integers_are_read_as_hu(tmp_path, thorax):
    image = nibabel.Nifti1Image(thorax, AFFINE)
    data = bytearray(image.to_bytes())
    data[112:120] = struct.pack("<ff", 2.0, -24.0)  # scl_slope, scl_inter
    (tmp_path / "scaled.nii").write_bytes(bytes(data))
    assert (load_ct(tmp_path / "scaled.nii")[0] == 2 * thorax.astype(np.float32) - 24).all()


# CT-RATE and plain folders

REPORT_COLUMNS = ("VolumeName", "ClinicalInformation_EN", "Technique_EN", "Findings_EN", "Impressions_EN")
METADATA_COLUMNS = ("VolumeName", "RescaleIntercept", "RescaleSlope", "XYSpacing", "ZSpacing")


def ct_rate(root, thorax, version="_fixed"):
    for name in ("1_a_1", "1_a_2", "1_b_1", "2_a_1", "10_a_1"):
        patient, scan, _ = name.split("_")
        save(root / f"train{version}/train_{patient}/train_{patient}_{scan}/train_{name}.nii.gz", thorax[:4, :4, :4])
    write_csv(root / "radiology_text_reports/train_reports.csv", REPORT_COLUMNS,
              ("train_1_a_1.nii.gz", "Not given.", "", "Nodule, 4 mm.", "Nodule."),
              ("train_2_a_1.nii.gz", "", "", "Not given.", ""))
    return root


def test_ct_rate_is_found_with_its_reports(tmp_path, thorax):
    root = ct_rate(tmp_path, thorax)
    cts = find_cts(root)
    assert [ct.id for ct in cts] == ["train_1_a_1", "train_1_a_2", "train_1_b_1", "train_2_a_1", "train_10_a_1"]
    nodule = "Findings: Nodule, 4 mm. Impression: Nodule."
    assert [ct.report for ct in cts] == [nodule, nodule, "", "", ""], "one report per scan"
    assert find_cts(root / "train_fixed" / "train_1")[0].report == nodule
    firsts = find_cts(root, first_reconstruction=True)
    assert [ct.id for ct in firsts] == ["train_1_a_1", "train_1_b_1", "train_2_a_1", "train_10_a_1"]
    (tmp_path / "no_chest.txt").write_text("train/train_2/train_2_a_1.nii.gz\n\n train_10_a_1.nii.gz\n")
    assert len(find_cts(root, exclude=tmp_path / "no_chest.txt")) == 3


def test_v1_takes_hu_and_spacing_from_the_metadata(tmp_path, thorax):
    root = tmp_path / "dataset"
    stored = (thorax[::-1, ::-1] + 8192).astype(np.int16)
    save(root / "valid/valid_1/valid_1_a/valid_1_a_1.nii.gz", stored, np.eye(4))
    with pytest.raises(ValueError, match="need CT-RATE's metadata table"):
        find_cts(root, fixed=False)
    table = write_csv(root / "metadata/validation_metadata.csv", METADATA_COLUMNS,
                      ("valid_1_a_1.nii.gz", "-8192", "1", "[6.0, 6.0]", "6.0"))
    case = CTCases(find_cts(root, fixed=False), None, GRID)[0]
    true = prepare_ct((thorax.astype(np.float32), AFFINE), GRID)
    torch.testing.assert_close(case["volume"], true["volume"], atol=1e-3, rtol=0)
    write_csv(table, METADATA_COLUMNS, ("valid_2_a_1.nii.gz", "-8192", "1", "[6.0, 6.0]", "6.0"))
    with pytest.raises(ValueError, match="1 of 1 volumes are not in the metadata .* valid_1_a_1"):
        find_cts(root, fixed=False)
    write_csv(table, METADATA_COLUMNS, ("valid_1_a_1.nii.gz", "-8192", "1", "6", "6.0"))
    with pytest.raises(ValueError, match="metadata of valid_1_a_1.nii.gz .* cannot be read"):
        find_cts(root, fixed=False)


def test_where_both_versions_lie_side_by_side_fixed_chooses(tmp_path, thorax):
    ct_rate(ct_rate(tmp_path, thorax, ""), thorax, "_fixed")
    assert all("train_fixed" in str(ct.path) for ct in find_cts(tmp_path))
    ids = [ct.id for ct in find_cts(tmp_path)]
    write_csv(tmp_path / "metadata/m.csv", METADATA_COLUMNS, *[(f"{i}.nii.gz", "0", "1", "[1, 1]", "1") for i in ids])
    assert not any("train_fixed" in str(ct.path) for ct in find_cts(tmp_path, fixed=False))


def test_a_flat_folder_and_a_single_file_need_no_reports(tmp_path, thorax):
    for name in ("b.nii.gz", "a.NII.GZ".lower(), "p10.nii", "p9.nii", ".hidden.nii"):
        save(tmp_path / name, thorax[:4, :4, :4])
    (tmp_path / "notes.txt").write_text("x")
    assert [(ct.id, ct.report) for ct in find_cts(tmp_path)] == [("a", ""), ("b", ""), ("p9", ""), ("p10", "")]
    assert [ct.id for ct in find_cts(tmp_path / "p9.nii")] == ["p9"]


def test_files_of_the_same_name_in_patient_folders_are_told_apart(tmp_path, thorax):
    for folder in ("x", "y"):
        save(tmp_path / folder / "ct.nii", thorax[:4, :4, :4])
    assert [ct.id for ct in find_cts(tmp_path)] == ["x__ct", "y__ct"] and patient_of("x__ct") == "x"
    save(tmp_path / "x" / "again" / "ct.nii", thorax[:4, :4, :4])
    with pytest.raises(ValueError, match="would both become case x__ct"):
        find_cts(tmp_path)


def test_folders_without_cts_are_explained(tmp_path):
    with pytest.raises(FileNotFoundError, match="it is empty"):
        find_cts(tmp_path)
    (tmp_path / "slice.dcm").write_text("x")
    with pytest.raises(FileNotFoundError, match="its 1 files are of other kinds.*DICOM series with data/prepare_cts"):
        find_cts(tmp_path)
    with pytest.raises(FileNotFoundError, match="is not a NIfTI file"):
        find_cts(tmp_path / "slice.dcm")
    with pytest.raises(FileNotFoundError, match="there is no folder or file"):
        find_cts(tmp_path / "absent")


def test_report_tables_are_checked(tmp_path):
    with pytest.raises(FileNotFoundError, match="there is no CSV table"):
        read_reports(tmp_path / "absent.csv")
    with pytest.raises(ValueError, match="lacks the columns Findings_EN, Impressions_EN"):
        read_reports(write_csv(tmp_path / "a.csv", ("VolumeName",)))


def test_a_table_of_reports_of_other_cts_is_refused_and_one_found_by_itself_warned_of(tmp_path, thorax):
    save(tmp_path / "cts" / "mine.nii.gz", thorax[:4, :4, :4])
    table = write_csv(tmp_path / "others" / "train_reports.csv", REPORT_COLUMNS,
                      ("train_1_a_1.nii.gz", "", "", "Nodule, 4 mm.", "Nodule."))
    said = "none of the 1 reports in .* is of one of the 1 CTs in .*train_1_a_1, the first CT is mine"
    with pytest.raises(ValueError, match=said):
        find_cts(tmp_path / "cts", reports=table)
    table.parent.rename(tmp_path / "radiology_text_reports")
    with pytest.warns(UserWarning, match=said):
        assert find_cts(tmp_path / "cts")[0].report == ""


def test_a_patient_never_straddles_the_split():
    ids = [f"train_{p}_{s}_{r}" for p in range(20) for s in "ab" for r in (1, 2)] + ["x__1", "x__2", "LIDC-IDRI-0002"]
    for seed in range(20):
        train, held = split_by_patient(ids, 0.25, seed)
        assert sorted(train + held) == sorted(ids) and train and held
        assert not {patient_of(i) for i in train} & {patient_of(i) for i in held}
    assert split_by_patient(ids, 0.25, 3) == split_by_patient(ids, 0.25, 3) != split_by_patient(ids, 0.25, 4)
    assert split_by_patient(["a", "b"], 0.01)[1] and not split_by_patient(ids, 0)[1]
    with pytest.raises(ValueError, match="must lie in"):
        split_by_patient(ids, 1.5)


def test_cached_cases_equal_fresh_ones_and_follow_their_file(tmp_path, thorax):
    path = save(tmp_path / "data/a.nii.gz", thorax)
    cases = CTCases(find_cts(tmp_path / "data"), tmp_path / "cache", GRID)
    first, stored = cases[0], [*(tmp_path / "cache").iterdir()]
    second = cases[0]
    exact = prepare_ct(path, GRID)
    for key in ("volume", "masks", "has_masks", "affine"):
        assert first[key].equal(second[key]) and first[key].dtype == exact[key].dtype
    assert (first["volume"] - exact["volume"]).abs().max() <= 2**-12 + 1e-7
    assert [p.name for p in path.parent.iterdir()] == ["a.nii.gz"] and len(stored) == 1
    save(path, thorax + 50)
    assert cases[0]["volume"].mean() > first["volume"].mean() + 0.01
    stored[0].write_bytes(b"broken")
    save(path, thorax)
    CTCases(find_cts(tmp_path / "data"), tmp_path / "cache", Grid.cube(24))[0]
    assert len([*(tmp_path / "cache").iterdir()]) >= 3


def test_a_broken_cache_file_is_made_again(tmp_path, thorax):
    save(tmp_path / "a.nii.gz", thorax)
    cases = CTCases(find_cts(tmp_path / "a.nii.gz"), tmp_path / "cache", GRID)
    first = cases[0]
    next((tmp_path / "cache").iterdir()).write_bytes(b"broken")
    with pytest.warns(UserWarning, match="it is prepared again"):
        assert cases[0]["volume"].equal(first["volume"])
    assert cases[0]["volume"].equal(first["volume"])


# augmentation

@pytest.fixture(scope="module")
def case(thorax):
    return prepare_ct((thorax.astype(np.float32), AFFINE), GRID)


def test_augmentation_is_replayed_by_its_seed(case):
    a, b, c = (augment(case, seed, GRID) for seed in (5, 5, 6))
    assert a["volume"].equal(b["volume"]) and a["masks"].equal(b["masks"]) and not a["volume"].equal(c["volume"])
    d = augment(case, torch.Generator().manual_seed(5), GRID)
    assert a["volume"].equal(d["volume"])


def test_augmentation_moves_volume_and_masks_together(case):
    copies = case | {"masks": ((case["volume"] + 1) / 2).expand(3, -1, -1, -1)}
    for seed in range(5):
        move = dataclasses.replace(Deformation.draw(seed), hu_scale=1.0, hu_offset=0.0)
        new = move.apply(copies, GRID, HUWindow())
        torch.testing.assert_close(new["masks"], ((new["volume"] + 1) / 2).expand(3, -1, -1, -1), atol=1e-5, rtol=0)


def test_augmentation_stays_small_and_never_mirrors(case):
    start = np.argwhere(case["volume"][0].numpy() > 0.4).mean(0)
    lung = float(case["masks"][0].sum())
    whole = dataclasses.replace(Augmentation(), surroundings=dataclasses.replace(Surroundings(), ends=0.0, field=0.0))
    moves = []
    for seed in range(10):
        new = augment(case, seed, GRID, strength=whole)
        assert new["volume"].min() >= -1 and new["volume"].max() <= 1
        assert new["masks"].min() >= 0 and new["masks"].max() <= 1
        assert new["volume"][0, 0, 0, 0] == -1, "air stays air"
        assert 0.65 < float(new["masks"][0].sum()) / lung < 1.5
        moves.append(np.argwhere(new["volume"][0].numpy() > 0.4).mean(0) - start)
    millimetres = 12 * np.linalg.norm(moves, axis=1)
    assert millimetres.mean() > 3 and millimetres.max() < 60


def test_a_deformation_of_nothing_changes_nothing(case):
    still = Deformation(torch.zeros(3), torch.ones(3), torch.zeros(3), torch.zeros(3, 4, 4, 4), 1.0, 0.0)
    new = still.apply(case, GRID, HUWindow())
    torch.testing.assert_close(new["volume"], case["volume"], atol=1e-4, rtol=0)
    torch.testing.assert_close(new["masks"], case["masks"], atol=1e-4, rtol=0)


def test_augmentation_of_no_strength_changes_nothing_and_each_strength_is_its_own_bound(case):
    new = augment(case, 3, GRID, strength=Augmentation.none())
    torch.testing.assert_close(new["volume"], case["volume"], atol=1e-4, rtol=0)
    for name in ("rotation", "scale", "shift", "elastic_mm", "hu_scale", "hu_offset"):
        weak = dataclasses.replace(Augmentation(), **{name: getattr(Augmentation(), name) / 100})
        for seed in range(10):
            usual, less = (vars(Deformation.draw(seed, strength)) for strength in (Augmentation(), weak))
            rest = 1 if name in ("scale", "hu_scale") else 0
            for part in ("rotation", "scale", "shift", "elastic_mm", "hu_scale", "hu_offset"):
                factor = 0.01 if part == name else 1
                torch.testing.assert_close(torch.as_tensor(less[part] - rest * (part == name)),
                                           factor * torch.as_tensor(usual[part] - rest * (part == name)),
                                           atol=1e-6, rtol=1e-3)


def test_hu_changes_spare_air_and_scale_tissue(case):
    strength = dataclasses.replace(Augmentation.none(), hu_scale=0.03, hu_offset=20.0)
    old = HUWindow().to_hu(case["volume"])
    for seed in range(5):
        move = Deformation.draw(seed, strength)
        new = HUWindow().to_hu(augment(case, seed, GRID, strength=strength)["volume"])
        air, tissue = old < -999.9, (old > -790) & (old < 900)
        assert air.any() and tissue.any()
        torch.testing.assert_close(new[air], old[air], atol=0.3, rtol=0)
        expected = move.hu_scale * (old[tissue] + 1000) - 1000 + move.hu_offset
        torch.testing.assert_close(new[tissue], expected, atol=0.5, rtol=0)


@pytest.mark.parametrize("report, may", [
    ("", True), ("No focal consolidation.", True), ("Bilateral pleural effusion.", True),
    ("Nodule, right lung.", False), ("LEFT-sided effusion", False),
    ("Consolidation of the middle lobe.", False), ("Opacity in the LLL.", False), ("Lingular atelectasis", False)])
def test_only_a_report_without_side_may_be_mirrored_and_only_on_demand(case, report, may):
    case = case | {"report": report}
    for strength, mirrored in ((0.0, False), (1.0, may)):
        new = augment(case, 0, GRID, strength=dataclasses.replace(Augmentation.none(), mirror=strength))
        for key in ("volume", "masks"):
            torch.testing.assert_close(new[key], case[key].flip(1) if mirrored else case[key], atol=1e-4, rtol=0)


@pytest.mark.parametrize("strength, words", [({"shift": -1.0}, "shift is -1"), ({"scale": 0.9}, "small changes"),
                                                 ({"mirror": 1.5}, "mirror lies between 0 and 1"),
                                                 ({"girth": 1.5}, "girth lies between 0 and 1"),
                                                 ({"girth": float("nan")}, "girth is nan")])
def test_augmentation_refuses_impossible_strengths(strength, words):
    with pytest.raises(ValueError, match=words):
        Augmentation(**strength)


def test_a_shift_moves_by_its_millimetres(case):
    shift = Deformation(torch.zeros(3), torch.ones(3), torch.tensor([24.0, 0, -12]), torch.zeros(3, 4, 4, 4), 1.0, 0.0)
    new = shift.apply(case, GRID, HUWindow())["volume"]
    torch.testing.assert_close(new[0, :28, :, 2:], case["volume"][0, 2:30, :, 1:31], atol=1e-3, rtol=0)


def test_augmentation_refuses_other_grids_and_cases_with_xrays(case):
    with pytest.raises(ValueError, match="give the grid the case was prepared on"):
        augment(case, 0)
    with pytest.raises(ValueError, match="deform it before projecting"):
        augment(case | {"xrays": torch.zeros(1, 2, 2)}, 0, GRID)


def test_metadata_of_voxels_that_no_ct_has_are_refused(tmp_path, thorax):
    file = save(tmp_path / "a.nii.gz", thorax)
    for spacing in (1e30, 500.0, 1e-5):
        with pytest.raises(ValueError, match="a.nii.gz has voxels .*; correct it in the metadata table"):
            load_ct(file, Calibration(1, 0, (spacing,) * 3))


def test_voxels_without_their_place_are_no_ct(thorax):
    for ct in ((thorax,), (thorax[0], AFFINE), (thorax, AFFINE, AFFINE)):
        with pytest.raises(ValueError, match="a CT is a file, or HU"):
            prepare_ct(ct, GRID)
