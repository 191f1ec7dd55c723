"""CTs as cases: resampling keeps mass, place and HU, and bad files are refused with reasons."""

from __future__ import annotations

import gzip
import re
import struct
import warnings

import nibabel
import numpy as np
import pytest
import torch
from ct_files import AFFINE, LIVER, save_ct
from scipy.ndimage import gaussian_filter
from torch.utils.data import DataLoader, Dataset

from phydict.datasets.cts.ct_case import prepare_ct
from phydict.datasets.cts.ct_rate import CTCases, find_cts
from phydict.datasets.cts.reading import Calibration, check_hu, load_ct
from phydict.datasets.cts.resampling import covering_grid, to_grid
from phydict.grid import Grid
from phydict.units import AIR, HUWindow

GRID = Grid.cube(32)


@pytest.fixture(autouse=True)
def warnings_are_errors():
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        yield


def stored_as(axcodes, data, path):
    image = nibabel.Nifti1Image(data, AFFINE)
    wanted = nibabel.orientations.axcodes2ornt(axcodes)
    turn = nibabel.orientations.ornt_transform(nibabel.io_orientation(AFFINE), wanted)
    path.parent.mkdir(parents=True, exist_ok=True)
    nibabel.save(image.as_reoriented(turn), path)
    return path


def fails(sentence, path, error=ValueError):
    with pytest.raises(error, match=sentence) as caught:
        load_ct(path)
    assert str(path) in str(caught.value)


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


@pytest.mark.parametrize("order, signs", [((1, 0, 2), (1, 1, 1)), ((2, 0, 1), (-1, 1, -1)), ((2, 1, 0), (1, -1, 1))])
def test_voxels_stacked_in_another_order_hold_the_same_averages(order, signs):
    volume = np.random.default_rng(0).random((13, 12, 11), np.float32)
    affine = np.array([[2.0, 0, 0, -12], [0, 2.5, 0, -15], [0, 0, 3, -14], [0, 0, 0, 1]])
    grid = Grid.box((9, 8, 7), (20.0, 25.0, 30.0), (1.0, -2.0, 3.0))
    moved = np.eye(4)[:, [*order, 3]] * [*signs, 1]  # from the new order's indices to the grid's
    moved[:3, 3] = [(sign < 0) * (grid.shape[axis] - 1) for axis, sign in sorted(zip(order, signs))]
    new = to_grid(volume, affine, Grid([grid.shape[axis] for axis in order], affine=grid.affine @ moved), -1.0)
    expected = np.flip(to_grid(volume, affine, grid, -1.0).transpose(order), np.flatnonzero(np.less(signs, 0)))
    np.testing.assert_allclose(new, expected, atol=1e-5)


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


@pytest.mark.parametrize("axcodes", ["LPS", "LAS", "SPL", "AIR"])
def test_the_same_patient_in_any_axis_order_gives_the_same_case(tmp_path, chest, axcodes):
    case = prepare_ct(stored_as("RAS", chest, tmp_path / "a.nii"), GRID)
    other = prepare_ct(stored_as(axcodes, chest, tmp_path / "b.nii.gz"), GRID)
    for key in ("volume", "masks", "affine"):
        torch.testing.assert_close(case[key], other[key], atol=1e-3, rtol=0)
    assert (case["id"], other["id"]) == ("a", "b")


def test_a_case_keeps_its_place_in_the_world(chest):
    case = prepare_ct((chest.astype(np.float32), AFFINE), GRID)
    grid = Grid(GRID.shape, affine=case["affine"].numpy())
    index = np.rint(grid.index(LIVER)).astype(int)
    assert case["volume"][0][tuple(index)] > 0.5
    assert index[0] > 16, "the patient's right lies at high i"
    lungs = np.argwhere(case["masks"][0].numpy() > 0.5)
    np.testing.assert_allclose((lungs.min(0) + lungs.max(0)) / 2, 15.5, atol=0.6)
    assert case["centred_on"] == "lungs" and case["has_masks"].tolist() == [True, False, True]


def test_outside_the_scan_is_air_and_the_window_clips(chest):
    dense = np.where(chest > 0, 3.0 * chest, np.where(chest == AIR, -3024.0, chest))
    case = prepare_ct((dense, AFFINE), Grid.cube(32, 600), HUWindow(-1000, 600))
    assert case["volume"][0, 0, 0, 0] == -1 and case["volume"].max() == 1 and case["volume"].min() == -1


def test_without_lungs_the_scan_is_centred_with_a_warning():
    ball = np.full((40, 40, 40), AIR, np.float32)
    ball[10:30, 10:30, 10:30] = 40
    with pytest.warns(UserWarning, match="no lungs were found in ball"):
        case = prepare_ct((ball, np.diag([4.0, 4, 4, 1])), GRID, id="ball")
    np.testing.assert_allclose(Grid(GRID.shape, affine=case["affine"].numpy()).centre, 78)
    assert case["centred_on"] == "volume" and not case["has_masks"].any() and not case["masks"].any()


@pytest.mark.parametrize("wrong, sentence", [(lambda hu: hu + 1024, "only 0.0 % of it lies between -1100 and -300"),
                                                 (lambda hu: hu / 2, "the most frequent value below -300 is -490"),
                                                 (lambda hu: hu - 1024, "only 0.* % of it lies above -200")])
def test_numbers_that_are_not_hu_are_warned_of(chest, wrong, sentence):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        prepare_ct((wrong(chest.astype(np.float32)), AFFINE), GRID, id="odd")
    assert re.search(f"odd does not look like HU: {sentence}", " ".join(str(w.message) for w in caught))


@pytest.mark.parametrize("offset", [0, 1024])
def test_padding_outside_the_field_of_view_is_no_air(chest, offset, recwarn):
    hu = chest + np.float32(offset)
    x, y = np.indices(hu.shape[:2])
    hu[np.hypot(x - hu.shape[0] / 2, y - hu.shape[1] / 2) > min(hu.shape[:2]) / 2] = -2000
    check_hu(hu, "padded")
    assert ["between -1100 and -300" in str(warning.message) for warning in recwarn] == [True] * bool(offset)


def test_missing_and_unreadable_files(tmp_path, chest):
    fails("there is no CT file", tmp_path / "absent.nii.gz", FileNotFoundError)
    path = tmp_path / "text.nii.gz"
    path.write_text("not a volume")
    fails("cannot be read .* convert it to NIfTI", path)
    for name in ("cut.nii", "cut.nii.gz"):
        path = save_ct(tmp_path / name, chest)
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
        fails("truncated or damaged", path)
    path = tmp_path / "broken.nii.gz"
    data = bytearray(gzip.compress(b"\0" * 400))
    path.write_bytes(bytes(data))
    fails("cannot be read .* convert it to NIfTI", path)


def test_2d_4d_and_slices_are_refused_but_one_frame_of_4d_is_read(tmp_path, chest):
    fails("2D with shape", save_ct(tmp_path / "a.nii", chest[:, :, 0]))
    fails("single 2D slice", save_ct(tmp_path / "b.nii", chest[:, :, :1]))
    fails("4D with shape", save_ct(tmp_path / "c.nii", np.stack([chest] * 2, -1)))
    hu, _ = load_ct(save_ct(tmp_path / "d.nii", chest[..., None]))
    assert (hu == chest).all()


def test_a_file_without_orientation_is_refused_unless_calibrated(tmp_path, chest):
    image = nibabel.Nifti1Image(chest, None)
    nibabel.save(image, tmp_path / "a.nii")
    fails("neither sform nor qform is set", tmp_path / "a.nii")
    hu, affine = load_ct(tmp_path / "a.nii", Calibration(2.0, -1000.0, (0.7, 0.8, 2.5)))
    np.testing.assert_allclose(np.diag(affine), [0.7, 0.8, 2.5, 1])
    assert (hu == 2 * chest[::-1, ::-1].astype(np.float32) - 1000).all(), "v1 is stored as left, posterior, superior"


def test_nan_and_flat_voxels_are_refused(tmp_path, chest):
    bad = chest.astype(np.float32)
    bad[3, 4, 5:8] = np.nan, np.inf, -np.inf
    fails("holds 3 NaN or infinite voxels", save_ct(tmp_path / "nan.nii", bad))
    image = nibabel.Nifti1Image(chest, AFFINE)
    data = bytearray(image.to_bytes())
    data[312:328] = bytes(16)  # srow_z
    (tmp_path / "flat.nii").write_bytes(bytes(data))
    fails("voxels without volume", tmp_path / "flat.nii")


@pytest.mark.parametrize("factor, words", [(1e-3, "0.006 x 0.006 x 0.006 mm"), (1e3, "6000 x 6000 x 6000 mm")])
def test_lengths_in_another_unit_are_no_flat_voxels(tmp_path, chest, factor, words):
    scaled = np.diag([factor, factor, factor, 1]) @ AFFINE
    fails(f"has voxels of {words}, .* which no CT does", save_ct(tmp_path / "a.nii", chest, scaled))
    with pytest.raises(ValueError, match=f"the CT has voxels of {words}, .* which no CT does; give an affine"):
        prepare_ct((chest, scaled), GRID)


def test_scaled_integers_are_read_as_hu(tmp_path, chest):
    image = nibabel.Nifti1Image(chest, AFFINE)
    data = bytearray(image.to_bytes())
    data[112:120] = struct.pack("<ff", 2.0, -24.0)  # scl_slope, scl_inter
    (tmp_path / "scaled.nii").write_bytes(bytes(data))
    assert (load_ct(tmp_path / "scaled.nii")[0] == 2 * chest.astype(np.float32) - 24).all()


def test_cached_cases_equal_fresh_ones_and_follow_their_file(tmp_path, chest):
    path = save_ct(tmp_path / "data/a.nii.gz", chest)
    cases = CTCases(find_cts(tmp_path / "data"), tmp_path / "cache", GRID)
    first, stored = cases[0], [*(tmp_path / "cache").iterdir()]
    second = cases[0]
    exact = prepare_ct(path, GRID)
    for key in ("volume", "masks", "has_masks", "affine"):
        assert first[key].equal(second[key]) and first[key].dtype == exact[key].dtype
    assert (first["volume"] - exact["volume"]).abs().max() <= 2**-12 + 1e-7
    assert [p.name for p in path.parent.iterdir()] == ["a.nii.gz"] and len(stored) == 1
    save_ct(path, chest + 50)
    assert cases[0]["volume"].mean() > first["volume"].mean() + 0.01
    stored[0].write_bytes(b"broken")
    save_ct(path, chest)
    CTCases(find_cts(tmp_path / "data"), tmp_path / "cache", Grid.cube(24))[0]
    assert len([*(tmp_path / "cache").iterdir()]) >= 3


def test_a_broken_cache_file_is_made_again(tmp_path, chest):
    save_ct(tmp_path / "a.nii.gz", chest)
    cases = CTCases(find_cts(tmp_path / "a.nii.gz"), tmp_path / "cache", GRID)
    first = cases[0]
    next((tmp_path / "cache").iterdir()).write_bytes(b"broken")
    with pytest.warns(UserWarning, match="it is prepared again"):
        assert cases[0]["volume"].equal(first["volume"])
    assert cases[0]["volume"].equal(first["volume"])


class Warned(Dataset):
    """What is warned of while the first case is loaded, twice."""

    def __init__(self, cases):
        self.cases = cases

    def __len__(self):
        return 2

    def __getitem__(self, _):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            assert "warnings" not in self.cases[0]
        return [str(warning.message) for warning in caught if "odd does not look like HU" in str(warning.message)]


@pytest.mark.parametrize("workers", [0, 1])
def test_a_doubtful_ct_is_warned_of_once_by_each_run_that_reads_it_from_the_cache(tmp_path, chest, workers):
    save_ct(tmp_path / "odd.nii.gz", (chest + 1024).astype(np.int16))
    for _ in range(3):
        cases = Warned(CTCases(find_cts(tmp_path / "odd.nii.gz"), tmp_path / "cache", GRID))
        epochs = [[*DataLoader(cases, None, num_workers=workers)] for _ in range(2)]
        assert [len(texts) for epoch in epochs for texts in epoch] == [1, 0, 0, 0]
    assert len([*(tmp_path / "cache").iterdir()]) == 1


def test_voxels_without_their_place_are_no_ct(chest):
    for ct in ((chest,), (chest[0], AFFINE), (chest, AFFINE, AFFINE)):
        with pytest.raises(ValueError, match="a CT is a file, or HU"):
            prepare_ct(ct, GRID)


@pytest.mark.parametrize("change, sentence", [
    (lambda hu, affine: (np.where(hu > 800, np.nan, hu), affine), r"the CT holds \d+ NaN or infinite voxels; replace"),
    (lambda hu, affine: (hu + 0j, affine), "the CT holds voxels of type complex128; give integers or"),
    (lambda hu, affine: (hu[:, :, :5], affine), "the CT has 5 slices .* give the whole series"),
    (lambda hu, affine: (hu, affine[:3]), "the affine of the CT is 4x4 finite numbers, but"),
    (lambda hu, affine: (hu, affine.T), "the affine of the CT has the last row 0 0 0 1, but .* transpose it where"),
    (lambda hu, affine: (hu, np.diag([0, 1, 1, 1])), "the CT has voxels without volume"),
    (lambda hu, affine: (hu, np.diag([np.nan, 1, 1, 1])), "the affine of the CT is 4x4 finite numbers, but")])
def test_a_ct_given_as_arrays_is_checked_as_a_file_is(chest, change, sentence):
    with pytest.raises(ValueError, match=sentence) as caught:
        prepare_ct(change(chest, AFFINE), GRID)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("kind", [lambda part: part.tolist(), torch.tensor,
                                  lambda part: torch.tensor(part, dtype=torch.float64, requires_grad=True)])
def test_lists_and_tensors_are_the_case_of_their_arrays(chest, kind):
    expected, found = prepare_ct((chest, AFFINE), GRID), prepare_ct((kind(chest), kind(AFFINE)), GRID)
    assert all(found[name].equal(expected[name]) for name in ("volume", "masks", "affine"))


def blurred(hu: np.ndarray, noise: float) -> np.ndarray:
    """A CT with partial volumes and noise, as scanners give."""
    draw = np.random.default_rng(0)
    return gaussian_filter(hu.astype(float), 0.8) + noise * draw.standard_normal(hu.shape)


def test_hu_twice_as_steep_are_warned_of_and_noise_and_padding_are_not(chest):
    check_hu(blurred(chest, 80.0).astype(np.float32), "noisy")
    padded = blurred(np.where(chest == AIR, -3024, chest), 0.0)  # resampled, which leaves a rim
    check_hu(padded.astype(np.float32), "padded")
    with pytest.warns(UserWarning, match="steep does not look like HU: .* below -1100, and not at one number"):
        check_hu((2 * blurred(chest, 20.0)).astype(np.float32), "steep")


def test_a_scan_without_lungs_may_be_one_of_other_numbers(tmp_path):
    said = "no lungs were found in odd, .*; it may be no chest, or its numbers no HU"
    with pytest.warns(UserWarning, match=said):
        prepare_ct((np.where(np.indices((20, 20, 20))[0] > 9, 40.0, AIR), np.diag([9.0, 9, 9, 1])), GRID, id="odd")


@pytest.mark.parametrize("codes, told", [((1, 1), True), ((1, 0), False), ((0, 1), False)])
def test_a_header_that_places_the_axes_twice_is_warned_of_where_they_differ(tmp_path, chest, codes, told):
    image = nibabel.Nifti1Image(chest, AFFINE)
    image.set_sform(AFFINE, codes[0])
    image.set_qform(AFFINE @ np.diag([-1, 1, 1, 1]), codes[1])
    nibabel.save(image, tmp_path / "a.nii")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        hu, _ = load_ct(tmp_path / "a.nii")
    said = f"{tmp_path / 'a.nii'} says by its sform that its axes are RAS, and by its qform LAS: the sform is used"
    assert [said in str(warning.message) for warning in caught] == [True] * told
    assert (hu == (chest if codes[0] else chest[::-1])).all()
    image.set_qform(AFFINE, 1)
    nibabel.save(image, tmp_path / "a.nii")
    load_ct(tmp_path / "a.nii")  # both say the same


@pytest.mark.parametrize("qform_code", [0, 1])
def test_a_header_whose_lengths_are_not_those_of_its_sform_is_read_by_this_and_warned_of(tmp_path, chest, qform_code):
    turned = AFFINE @ np.diag([-1, -1, 1, 1.0])
    image = nibabel.Nifti1Image(chest, turned)
    image.set_sform(turned, 1)
    image.set_qform(turned if qform_code else None, qform_code)
    image.header["pixdim"][1:4] = 1, 6, 6
    nibabel.save(image, tmp_path / "a.nii")
    with pytest.warns(UserWarning, match="6 x 6 x 6 mm by its sform, and of 1 x 6 x 6 mm by its pixdim: the sform is"):
        hu, affine = load_ct(tmp_path / "a.nii")
    assert (hu == chest[::-1, ::-1]).all() and np.allclose(affine[:3, :3], np.diag([6.0, 6, 6]))
    corner = turned @ [*(np.array(chest.shape[:2]) - 1), 0, 1]
    assert np.allclose(affine[:3, 3], corner[:3])
    image.header["pixdim"][1:4] = 6.0003, 6, 6  # as rounded
    nibabel.save(image, tmp_path / "a.nii")
    assert np.allclose(load_ct(tmp_path / "a.nii")[1], affine)
