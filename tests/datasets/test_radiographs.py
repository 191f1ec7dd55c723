"""Laws of measured X-rays: what is written is read back, intensities mean what the YAML says, and misfits are named."""

from __future__ import annotations

import errno
import os
import re
import struct

import nibabel
import numpy as np
import pytest
import torch
import yaml
from PIL import Image

from phydict.datasets.intensity import Intensity
from phydict.datasets.radiographs import xray_description
from phydict.datasets.radiographs.radiographs import find_xrays, load_xrays, save_xrays
from phydict.datasets.radiographs.xray_description import Orientation, read_description, save_geometry
from phydict.datasets.radiographs.xray_images import image_files, read_image
from phydict.xray.geometry import ConeBeam
from phydict.xray.geometry_files import write_beam
from phydict.xray.poses.uncertain import Uncertain

SHAPE = (6, 5)
ORBIT = {"views": 2, "source_to_detector": 1020.0, "source_to_isocentre": 740.0, "shape": list(SHAPE),
         "pixel": [70.0, 80.0]}


def images(views=2, seed=0):
    return np.random.default_rng(seed).uniform(0, 6, (views, *SHAPE)).astype(np.float32)


def write(folder, arrays, ending="npy", name="view_{}", **blocks):
    folder.mkdir(parents=True, exist_ok=True)
    for k, array in enumerate(arrays):
        file = folder / f"{name.format(k)}.{ending}"
        if ending == "npy":
            np.save(file, array)
        elif ending in ("png", "tif"):
            Image.fromarray(array).save(file)
        else:
            nibabel.save(nibabel.Nifti1Image(array.T, np.eye(4)), file)
    (folder / "geometry.yaml").write_text(yaml.safe_dump(blocks or {"orbit": ORBIT}))
    return folder


def fails(sentence, folder, error=ValueError, **arguments):
    with pytest.raises(error, match=sentence) as caught:
        load_xrays(folder, **arguments)
    assert "\n" not in str(caught.value)


def test_the_example_of_a_geometry_file_is_one_with_each_of_its_beams(tmp_path):
    lines = [line[4:] for line in xray_description.__doc__.splitlines() if line.startswith("    ")]
    file = tmp_path / "geometry.yaml"
    file.write_text("\n".join(lines))
    found = read_description(file)
    assert found.views == 8 and found.beam_of((448, 448), []).shape == (448, 448)
    assert (found.intensity, found.orientation) == (Intensity("counts", air=50000), Orientation())
    assert found.uncertain == Uncertain(detector_shift_mm=5, rotation_degrees=2)
    others = [line.removeprefix("# ") for line in lines if line.startswith("# beam:")]
    assert len(others) == 2
    for other, key in zip(others, ("file", "dicom"), strict=True):
        file.write_text(other)
        assert key in read_description(file).beam


def test_saved_npy_is_read_back_exactly(tmp_path):
    beam = ConeBeam.orbit(2, 1020, 740, SHAPE, 70)
    save_xrays(tmp_path / "case", torch.from_numpy(images()), beam, "Findings: none.")
    case = load_xrays(tmp_path / "case")
    assert (case["xrays"].numpy() == images()).all() and case["beam"].same_as(beam)
    assert (case["id"], case["report"], case["display"]) == ("case", "Findings: none.", False)


def test_saved_png_is_read_back_to_half_a_step(tmp_path):
    save_xrays(tmp_path, images() - 1, ConeBeam.orbit(2, 1020, 740, SHAPE, 70), png=True)
    step = np.ptp(images()) / 65535
    assert np.abs(load_xrays(tmp_path)["xrays"].numpy() - (images() - 1)).max() <= 0.51 * step


def test_saving_again_leaves_no_old_report_and_refuses_to_mix_with_other_images(tmp_path):
    beam = ConeBeam.orbit(2, 1020, 740, SHAPE, 70)
    save_xrays(tmp_path, images(), beam, "old")
    save_xrays(tmp_path, images(), beam, overwrite=True)
    assert load_xrays(tmp_path)["report"] == ""
    with pytest.raises(FileExistsError, match="view_0.npy, view_1.npy"):
        save_xrays(tmp_path, images(), beam, png=True, overwrite=True)


@pytest.mark.parametrize("png", [False, True])
def test_saving_that_fails_leaves_the_old_case_whole(tmp_path, monkeypatch, png):
    beam, written = ConeBeam.orbit(2, 1020, 740, SHAPE, 70), []

    def full(*_, **__) -> None:
        written.append(1)
        if len(written) == 2:
            raise OSError(errno.ENOSPC, "No space left on device")

    save_xrays(tmp_path, images(), beam, "old", png)
    before = {file.name: file.read_bytes() for file in tmp_path.iterdir()}
    monkeypatch.setattr(Image.Image if png else np, "save", full)
    with pytest.raises(OSError, match="No space"):
        save_xrays(tmp_path, images() + 1, beam, "new", png, overwrite=True)
    assert {file.name: file.read_bytes() for file in tmp_path.iterdir()} == before


@pytest.mark.parametrize("xrays, sentence", [
    (images(3), r"\(3, 6, 5\) were given for a beam .* \(2, 6, 5\)"),
    (images() * 1000, r"reach 5.\d+e\+03, but line integrals behind a patient .* in 1/mm along mm"),
    (images() - 7, "have a median of -3.* but line integrals behind a patient lie between 0 and about 10"),
    (np.concatenate([images(1), np.ones((1, *SHAPE))]), "view 1 shows nothing")])
def test_what_would_not_be_read_back_is_not_written(tmp_path, xrays, sentence):
    with pytest.raises(ValueError, match=sentence):
        save_xrays(tmp_path / "case", xrays, ConeBeam.orbit(2, 1020, 740, SHAPE, 70))
    assert not (tmp_path / "case").exists()


@pytest.mark.parametrize("beam", [None, "case", torch.zeros(2, *SHAPE)])
def test_saving_names_the_order_of_what_it_takes(tmp_path, beam):
    with pytest.raises(ValueError, match="takes a folder, X-rays and a ConeBeam, in that order, but") as caught:
        save_xrays(tmp_path / "case", images(), beam)
    assert "\n" not in str(caught.value) and not (tmp_path / "case").exists()


@pytest.mark.parametrize("kind", [torch.bfloat16, torch.float16, torch.float64])
def test_tensors_of_any_precision_are_saved_with_or_without_a_gradient(tmp_path, kind):
    xrays = torch.from_numpy(images()).to(kind).requires_grad_()
    save_xrays(tmp_path, xrays, ConeBeam.orbit(2, 1020, 740, SHAPE, 70))
    assert load_xrays(tmp_path)["xrays"].equal(xrays.detach().float())


@pytest.mark.parametrize("blocks", [{"orbit": ORBIT}, {"beam": {"orbit": ORBIT}},
                                    {"beam": ConeBeam.orbit(2, 1020, 740, SHAPE, (70, 80)).to_dict()}],
                         ids=["plain", "beam: orbit", "beam: vectors"])
def test_every_form_of_geometry_gives_the_same_beam(tmp_path, blocks):
    case = load_xrays(write(tmp_path, images(), **blocks))
    assert case["beam"].same_as(ConeBeam.orbit(2, 1020, 740, SHAPE, (70, 80)))


def test_view_10_comes_after_view_9(tmp_path):
    stack = np.arange(11, dtype=np.float32)[:, None, None] + images(11) / 100
    stack[:, 0, 0] = np.arange(11)
    case = load_xrays(write(tmp_path, stack, name="img_800.0_{}", orbit=ORBIT | {"views": 11}))
    assert case["xrays"][:, 0, 0].tolist() == list(range(11))


@pytest.mark.parametrize("names", [
    ["angle_-30", "angle_-15", "angle_0", "angle_15", "angle_030"], ["-90", "-10", "0", "100"],
    ["scan-1", "scan-2", "scan-10"], ["scan -1", "scan -2", "scan -10"], ["2026-11-02", "2026-11-10"]])
def test_hyphens_are_signs_of_numbers_where_some_names_have_them_and_others_none(tmp_path, names):
    for name in names:
        Image.new("L", (1, 1)).save(tmp_path / f"{name}.png")
    assert [path.stem for path in image_files(tmp_path)] == names


def test_npy_nifti_png_and_tiff_of_the_same_counts_agree(tmp_path):
    counts = np.random.default_rng(1).integers(1, 60000, (2, *SHAPE)).astype(np.uint16)
    block = {"orbit": ORBIT, "intensity": {"kind": "counts", "air": 60000}}
    a, *others = (load_xrays(write(tmp_path / e, counts, e, **block))["xrays"] for e in ("npy", "png", "nii.gz", "tif"))
    np.testing.assert_allclose(a, np.log(60000 / counts), rtol=1e-5)
    assert all(a.equal(other) for other in others)


def test_a_tiff_whose_least_value_is_white_is_turned_over(tmp_path):
    pixels = np.arange(30, dtype=np.uint16).reshape(SHAPE)
    for k in range(2):
        Image.fromarray(pixels).save(tmp_path / f"{k}.tif", tiffinfo={262: 0})
    scaled = {"kind": "line_integrals", "scale": 1e-4}
    (tmp_path / "geometry.yaml").write_text(yaml.safe_dump({"orbit": ORBIT, "intensity": scaled}))
    np.testing.assert_allclose(load_xrays(tmp_path)["xrays"][1].numpy(), 1e-4 * (65535.0 - pixels), rtol=1e-5)


def colour_tiff(grey):
    """A TIFF of three equal channels of 16 bits, which Pillow reads and does not write."""
    size, bits = 3 * grey.nbytes, 10 + 12 * 9 + 4
    tags = [(256, 3, 1, grey.shape[1]), (257, 3, 1, grey.shape[0]), (258, 3, 3, bits), (259, 3, 1, 1), (262, 3, 1, 2),
            (273, 4, 1, bits + 6), (277, 3, 1, 3), (278, 3, 1, grey.shape[0]), (279, 4, 1, size)]
    head = struct.pack("<2sHIH", b"II", 42, 8, len(tags)) + b"".join(struct.pack("<HHII", *tag) for tag in tags)
    return head + struct.pack("<I3H", 0, 16, 16, 16) + np.repeat(grey[..., None], 3, -1).astype("<u2").tobytes()


def test_colour_of_16_bits_is_refused_where_it_would_be_cut_to_8(tmp_path):
    folder = write(tmp_path, np.ones((2, *SHAPE), np.uint8), "tif")
    (folder / "view_1.tif").write_bytes(colour_tiff(np.full(SHAPE, 50_000, np.uint16)))
    assert Image.open(folder / "view_1.tif").getpixel((0, 0)) == (195,) * 3
    fails("view_1.tif cannot be read .16-bit colour would be cut to 8 bit; store it as 16-bit grey", folder)


def test_floating_point_tiffs_are_line_integrals(tmp_path):
    assert (load_xrays(write(tmp_path, images(), "tif"))["xrays"].numpy() == images()).all()


def test_a_tiff_of_several_pages_is_refused(tmp_path):
    folder = write(tmp_path, images(), "tif")
    pages = [Image.fromarray(image) for image in images(3)]
    pages[0].save(folder / "view_1.tif", save_all=True, append_images=pages[1:])
    fails("view_1.tif cannot be read .it holds 3 pages", folder)


def test_flat_and_dark_images_undo_gain_and_offset_of_every_pixel(tmp_path):
    rng = np.random.default_rng(2)
    y = rng.uniform(0, 5, (2, *SHAPE))
    gain, dark = rng.uniform(2e4, 5e4, SHAPE), rng.uniform(50, 150, SHAPE)
    folder = write(tmp_path, (gain * np.exp(-y) + dark).astype(np.float32), orbit=ORBIT,
                   intensity={"kind": "counts", "flat": ["before.npy", "after.npy"], "dark": "dark.npy"})
    for name, image in (("before", 0.9 * gain + dark), ("after", 1.1 * gain + dark), ("dark", dark)):
        np.save(folder / f"{name}.npy", image.astype(np.float32))
    np.testing.assert_allclose(load_xrays(folder)["xrays"], y, atol=1e-4)


def test_a_constant_dark_value_is_taken_off_pixels_and_air(tmp_path):
    y = np.random.default_rng(3).uniform(0, 5, (2, *SHAPE))
    block = {"orbit": ORBIT, "intensity": {"kind": "counts", "air": 50100, "dark": 100}}
    folder = write(tmp_path, (50000 * np.exp(-y) + 100).astype(np.float32), **block)
    np.testing.assert_allclose(load_xrays(folder)["xrays"], y, atol=1e-4)


def test_pixels_that_no_xray_reached_are_finite_and_densest(tmp_path):
    stored = np.full((2, *SHAPE), 40000, np.uint16)
    stored[0, 2, 3], stored[1, 1, 1] = 0, 100  # below and at the dark value
    xrays = load_xrays(write(tmp_path, stored, orbit=ORBIT, intensity={"kind": "counts", "air": 40100, "dark": 100}))
    assert xrays["xrays"].isfinite().all()
    assert xrays["xrays"][0, 2, 3] == xrays["xrays"][1, 1, 1] == xrays["xrays"].max() == pytest.approx(np.log(1e5))


def test_noise_above_air_is_kept_and_counts_far_above_it_are_refused(tmp_path):
    block = {"orbit": ORBIT, "intensity": {"kind": "counts", "air": 1000}}
    noisy = np.random.default_rng(4).poisson(1000, (2, *SHAPE)).astype(np.uint16)
    assert load_xrays(write(tmp_path / "noise", noisy, **block))["xrays"].min() < 0
    noisy[0, :2, 3] = 2000
    fails("2 pixels hold counts above air, up to 2 times; correct `air`", write(tmp_path / "hot", noisy, **block))


def test_bad_flats_are_named(tmp_path):
    block = {"orbit": ORBIT, "intensity": {"kind": "counts", "flat": "flat.npy", "dark": 10}}
    folder = write(tmp_path, np.full((2, *SHAPE), 20, np.uint16), **block)
    with pytest.raises(FileNotFoundError, match="no image .*flat.npy, which `intensity:` names"):
        load_xrays(folder)
    np.save(folder / "flat.npy", np.ones((3, 3)))
    fails("flat.npy has 3 x 3 pixels, but the views have 6 x 5", folder)
    np.save(folder / "flat.npy", np.full(SHAPE, 200, np.uint8))
    fails("flat.npy holds uint8 pixels, but the views uint16, whose counts are on another scale", folder)
    flat = np.full(SHAPE, 30.0)
    flat[1, 1] = 10
    np.save(folder / "flat.npy", flat)
    fails("air is not above dark in 1 of 30 pixels", folder)


def test_scale_and_offset_are_applied(tmp_path):
    pixels = np.arange(60, dtype=np.uint8).reshape(2, *SHAPE)
    block = {"orbit": ORBIT, "intensity": {"kind": "line_integrals", "scale": 0.1, "offset": -1.0}}
    xrays = load_xrays(write(tmp_path, pixels, "png", **block))["xrays"]
    np.testing.assert_allclose(xrays, 0.1 * pixels - 1, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("intensity, sentence", [
    ({"scale": 1.0}, "reach 6e.04, .* correct `scale`"),
    ({"scale": 1e-4, "offset": -9.0}, "median of -"),
    ({"scale": 0.0}, "scale of line integrals must not be 0"),
])
def test_line_integrals_of_no_patient_are_refused(tmp_path, intensity, sentence):
    pixels = np.arange(0, 60_000, 1000, dtype=np.uint16).reshape(2, *SHAPE) + 1000
    fails(sentence, write(tmp_path, pixels, orbit=ORBIT, intensity={"kind": "line_integrals"} | intensity))


@pytest.mark.parametrize("dense", [True, False])
def test_wide_integers_keep_every_grey_level(tmp_path, dense):
    pixels = np.arange(60).reshape(2, *SHAPE)
    intensity = {"kind": "display", "bright_is_dense": dense}
    narrow, wide = (load_xrays(write(tmp_path / str(kind), pixels.astype(kind), orbit=ORBIT, intensity=intensity))
                    for kind in (np.uint16, np.int64))
    assert len(wide["xrays"].unique()) == 60
    scaled = [(x - x.mean()) / x.std() for x in (narrow["xrays"].double(), wide["xrays"].double())]
    torch.testing.assert_close(*scaled, atol=1e-3, rtol=0)


def test_zero_counts_are_finite(tmp_path):
    block = {"orbit": ORBIT, "intensity": {"kind": "counts", "air": 1000, "floor": 0.5}}
    counts = np.zeros((2, *SHAPE), np.uint16)
    counts[:, 0] = 1000
    xrays = load_xrays(write(tmp_path, counts, **block))["xrays"]
    assert xrays[:, 1:].numpy() == pytest.approx(np.log(2000))


@pytest.mark.parametrize("intensity", [
    {"kind": "line_integrals", "scale": 1e-4}, {"kind": "counts", "air": 65535},
    {"kind": "display", "bright_is_dense": True}, {"kind": "display", "bright_is_dense": False}],
    ids=lambda block: " ".join(map(str, block.values())))
@pytest.mark.parametrize("level", [0, 30000, 65535])
def test_an_image_of_one_value_is_refused_by_its_name_whatever_it_means(tmp_path, intensity, level):
    stored = np.random.default_rng(0).integers(1, 60000, (2, *SHAPE)).astype(np.uint16)
    stored[1] = level
    fails("view_1.png shows nothing.*saturated", write(tmp_path, stored, "png", orbit=ORBIT, intensity=intensity))


def test_little_in_much_air_is_no_saturated_image(tmp_path):
    thin = np.zeros((2, *SHAPE), np.float32)
    thin[:, 3, 2] = 5
    assert load_xrays(write(tmp_path, thin, orbit=ORBIT))["xrays"].max() == 5


def test_display_images_grow_with_density_whatever_their_polarity(tmp_path):
    pixels = np.arange(60, dtype=np.uint8).reshape(2, *SHAPE) * 4
    bright, dark = (load_xrays(write(tmp_path / n, p, "png", orbit=ORBIT, intensity={
        "kind": "display", "bright_is_dense": n == "bright"})) for n, p in (("bright", pixels), ("dark", 255 - pixels)))
    assert bright["display"] and dark["display"]
    torch.testing.assert_close(bright["xrays"], dark["xrays"])
    assert bright["xrays"].min() >= 0 and bright["xrays"].max() <= 1
    assert bright["xrays"][1, 5, 4] > bright["xrays"][0, 0, 0]


def test_flips_turn_rows_and_columns(tmp_path):
    case = load_xrays(write(tmp_path, images(), orbit=ORBIT, orientation={"flip_rows": True, "flip_columns": True}))
    assert (case["xrays"].numpy() == images()[:, ::-1, ::-1]).all()
    case = load_xrays(write(tmp_path, images(), orbit=ORBIT, orientation={"flip_rows": True}))
    assert (case["xrays"].numpy() == images()[:, ::-1]).all()


@pytest.mark.parametrize("degrees", [90, 180, 270])
def test_images_stored_on_their_side_are_turned_clockwise(tmp_path, degrees):
    lying = np.rot90(images(), degrees // 90, axes=(1, 2))  # counter-clockwise
    for name, flip in (("turned", False), ("flipped too", True)):
        blocks = {"orbit": ORBIT, "orientation": {"rotate_degrees": degrees, "flip_columns": flip}}
        case = load_xrays(write(tmp_path / name, lying, **blocks))
        assert (case["xrays"].numpy() == images()[..., ::-1 if flip else 1]).all()


@pytest.mark.parametrize("ending", ["xml", "npy", "csv"])
def test_a_geometry_file_of_another_program_gives_the_same_beam(tmp_path, ending):
    beam = ConeBeam.orbit(2, 1020, 740, SHAPE, (70, 80))
    pixel = {"pixel": [70, 80]} if ending == "xml" else {}
    folder = write(tmp_path / "case", images(), beam={"file": f"../beam.{ending}"} | pixel)
    write_beam(tmp_path / f"beam.{ending}", beam)
    assert load_xrays(folder)["beam"].same_as(beam)
    if ending != "xml":  # whose pixel size only a YAML can state
        (folder / "geometry.yaml").unlink()
        assert load_xrays(folder, geometry=tmp_path / f"beam.{ending}")["beam"].same_as(beam)


@pytest.mark.parametrize("place", [(0,), (1,), (2,), (0, 1), (2, 3)])
def test_a_nifti_image_is_the_same_wherever_it_has_axes_of_length_1(tmp_path, place):
    folder = write(tmp_path, images())
    for k, image in enumerate(images()):
        (folder / f"view_{k}.npy").unlink()
        nibabel.save(nibabel.Nifti1Image(np.expand_dims(image.T, place), np.eye(4)), folder / f"view_{k}.nii.gz")
    assert (load_xrays(folder)["xrays"].numpy() == images()).all()


def test_a_nifti_image_may_be_one_pixel_wide(tmp_path):
    for side in ((1, 6), (6, 1)):
        stored = np.arange(6.0).reshape(*side)
        nibabel.save(nibabel.Nifti1Image(stored[..., None], np.eye(4)), tmp_path / "v.nii")
        assert (read_image(tmp_path / "v.nii") == stored.T).all()


def test_rgba_with_equal_channels_is_grey(tmp_path):
    grey = np.arange(60, dtype=np.uint8).reshape(2, *SHAPE)
    rgba = np.concatenate([np.repeat(grey[..., None], 3, -1), np.full((2, *SHAPE, 1), 255, np.uint8)], -1)
    block = {"orbit": ORBIT, "intensity": {"kind": "line_integrals"}}
    assert (load_xrays(write(tmp_path / "a", rgba, "png", **block))["xrays"].numpy() == grey).all()
    rgba[1, 2, 3, 0] += 1
    fails("colour channels differ", write(tmp_path / "b", rgba, "png", **block))


def test_a_shared_geometry_and_an_intensity_argument_replace_the_folders_own(tmp_path):
    stored = np.arange(60, dtype=np.uint8).reshape(2, *SHAPE)
    folder = write(tmp_path / "case", stored, "png", nonsense=1)
    shared = tmp_path / "shared.yaml"
    shared.write_text(yaml.safe_dump({"orbit": ORBIT}))
    case = load_xrays(folder, geometry=shared, intensity=Intensity("line_integrals", scale=0.5))
    assert (case["xrays"].numpy() == 0.5 * stored).all()


def test_what_water_attenuates_is_read_and_kept_beside_a_geometry_that_was_found(tmp_path):
    folder = write(tmp_path / "case", images(), orbit=ORBIT, mu_water=0.0222)
    case = load_xrays(folder)
    assert case["mu_water"] == 0.0222 and "mu_water" not in load_xrays(write(tmp_path / "other", images()))
    save_geometry(folder / "geometry.yaml", case["beam"], case["description"])
    assert load_xrays(folder)["mu_water"] == 0.0222
    for bad in (0.2, "water", True):
        fails("what water attenuates in 1/mm", write(tmp_path / "bad", images(), orbit=ORBIT, mu_water=bad))


def test_find_xrays_takes_a_case_or_a_folder_of_cases(tmp_path):
    for name in ("p10", "p9"):
        write(tmp_path / name, images())
    (tmp_path / "notes").mkdir()
    assert [p.name for p in find_xrays(tmp_path)] == ["p9", "p10"]
    assert find_xrays(tmp_path / "p9") == [tmp_path / "p9"]
    with pytest.raises(FileNotFoundError, match="nor its subfolders hold geometry.yaml"):
        find_xrays(tmp_path / "notes")
    with pytest.raises(FileNotFoundError, match="there is no folder"):
        find_xrays(tmp_path / "absent")


def test_seven_images_for_eight_views(tmp_path):
    fails("holds 7 images, but .* describes 8 views", write(tmp_path, images(7), orbit=ORBIT | {"views": 8}))


def test_wrong_image_size_names_both(tmp_path):
    fails("6 x 5 pixels .* detector of 5 x 6", write(tmp_path, images(), orbit=ORBIT | {"shape": [5, 6]}))


def test_missing_things_are_named(tmp_path):
    fails("there is no folder", tmp_path / "absent", FileNotFoundError)
    folder = write(tmp_path / "case", images())
    (folder / "geometry.yaml").unlink()
    fails("there is no geometry file", folder, FileNotFoundError)
    fails("holds no X-ray image", write(tmp_path / "empty", []), FileNotFoundError)


@pytest.mark.parametrize("blocks, sentence", [
    ({"beam": {"orbit": ORBIT}, "colour": 1}, "unknown key 'colour'"),
    ({"orbit": ORBIT, "colour": 1}, "unknown key 'colour'"),
    ({"orbit": ORBIT | {"distance": 3}}, "unknown key 'distance'"),
    ({"orbit": ORBIT, "intensity": {"kind": "counts", "aire": 5}}, "unknown 'aire' in `intensity:`"),
    ({"orbit": ORBIT, "intensity": {"scale": 5}}, "needs `kind`"),
    ({"orbit": ORBIT, "intensity": {"kind": "log"}}, "'log' is unknown; give one of"),
    ({"orbit": ORBIT, "intensity": {"kind": "counts"}}, "counts need `air`"),
    ({"orbit": ORBIT, "intensity": {"kind": "counts", "air": "many"}}, "a number for air, but 'many'"),
    ({"orbit": ORBIT, "intensity": {"kind": "display"}}, "need `bright_is_dense`"),
    ({"orbit": ORBIT, "orientation": {"flip": True}}, "unknown 'flip' in `orientation:`"),
    ({"orbit": ORBIT, "orientation": {"rotate_degrees": 45}}, "rotate_degrees is 0, 90, 180 or 270, but 45"),
    ({"orbit": ORBIT | {"source_to_detector": 0.0}}, "source_to_detector=0.0 mm were given"),
    ({"orbit": ORBIT, "intensity": {"kind": "counts", "air": 5, "flat": "a.png"}}, "both were given"),
    ({"orbit": ORBIT, "intensity": {"kind": "counts", "flat": 5}}, "`flat` is the name of an image"),
    ({"orbit": ORBIT, "intensity": {"kind": "display", "bright_is_dense": True, "air": 5}}, "`air` belongs to"),
    ({"orbit": ORBIT, "intensity": {"kind": "counts", "air": 5, "scale": 0.5}}, "`scale` belongs to .* line_integrals"),
    ({"orbit": ORBIT, "intensity": {"kind": "line_integrals", "bright_is_dense": True}}, "belongs to .* display"),
    ({"beam": {"file": "a.xml", "spacing": 1}}, "unknown key 'spacing' in `beam:`; the keys are file, pixel"),
    ({"beam": {"dicom": {"pixel": [1, 1]}}}, "the images are not DICOM"),
    ({"beam": 3}, "`beam:` must be a mapping"),
    ({"orbit": ORBIT, "orientation": {"flip_rows": "yes please"}}, "true or false"),
])
def test_a_wrong_geometry_file_is_explained(tmp_path, blocks, sentence):
    fails(f"geometry.yaml.*{sentence}", write(tmp_path, images(), **blocks))


def test_bad_pixels_are_counted(tmp_path):
    bad = images()
    bad[1, 2, 3] = np.nan
    fails("view_1.npy holds 1 NaN", write(tmp_path / "nan", bad))
    bad[1, 2, :3] = -1, -2, -0.5
    bad[1, 2, 3] = 1
    fails("3 pixels hold negative counts, down to -2; give", write(tmp_path / "negative", bad),
          intensity=Intensity("counts", air=100.0))


def test_integer_images_need_a_stated_intensity(tmp_path):
    fails("hold uint8 pixels and .* has no `intensity:`", write(tmp_path, np.ones((2, *SHAPE), np.uint8), "png"))


def test_a_geometry_of_another_program_that_can_state_no_intensity_is_told_to_go_into_a_yaml(tmp_path):
    folder, other = write(tmp_path / "case", images().astype(np.uint8), "png"), tmp_path / "beam.csv"
    write_beam(other, load_xrays(folder, intensity=Intensity("line_integrals"))["beam"])
    fails(r"in a YAML with `beam: \{file: beam.csv\}`", folder, geometry=other)


def test_a_report_in_another_encoding_is_named(tmp_path):
    (write(tmp_path, images()) / "report.txt").write_bytes("Röntgen".encode("latin-1"))
    fails("report.txt is not UTF-8 text", tmp_path)


def test_a_folder_in_the_place_of_a_report_is_named(tmp_path):
    (write(tmp_path, images()) / "report.txt").mkdir()
    fails("report.txt is a folder", tmp_path, IsADirectoryError)


@pytest.mark.parametrize("name", ["Report.txt", "report.md"])
def test_a_report_under_another_name_is_told_to_be_unread(tmp_path, name):
    (write(tmp_path, images()) / name).write_text("Findings: effusion.")
    with pytest.warns(UserWarning, match=f"no report is used: {name} is not read; rename it to report.txt"):
        assert load_xrays(tmp_path)["report"] == ""


def test_mixed_pixel_types_are_refused(tmp_path):
    folder = write(tmp_path, np.ones((2, *SHAPE), np.uint8), "png")
    np.save(folder / "view_1.npy", images()[1])
    (folder / "view_1.png").unlink()
    fails(re.escape("different pixel types (float32, uint8)"), folder)


def test_unreadable_images_are_named(tmp_path):
    for ending in ("png", "npy", "nii.gz"):
        folder = write(tmp_path / ending, images())
        (folder / "view_1.npy").unlink()
        (folder / f"view_1.{ending}").write_bytes(b"not an image")
        fails(f"view_1.{ending} cannot be read", folder)


def test_a_truncated_png_is_named(tmp_path):
    folder = write(tmp_path, np.random.default_rng(0).integers(0, 255, (2, *SHAPE)).astype(np.uint8), "png")
    data = (folder / "view_0.png").read_bytes()
    (folder / "view_0.png").write_bytes(data[: len(data) // 2])
    fails("view_0.png cannot be read", folder)


def test_a_stack_in_one_file_is_refused(tmp_path):
    fails(re.escape("has shape (2, 6, 5); give one 2D image per view"),
          write(tmp_path, [images()], orbit=ORBIT | {"views": 1}))


@pytest.mark.parametrize("name", [b"view_1\xc2\xb23.npy", b"view_\xe9.npy", b"view\n1.npy", b"9" * 250 + b".npy"],
                         ids=["a digit that is no number", "no UTF-8", "a line break", "250 digits"])
def test_a_view_may_have_any_name(tmp_path, name):
    write(tmp_path / "case", images())
    (tmp_path / "case" / "view_1.npy").rename(tmp_path / "case" / os.fsdecode(name))
    assert len(load_xrays(tmp_path / "case")["xrays"]) == 2


def test_a_folder_whose_name_is_no_text_has_an_id_that_is(tmp_path):
    case = load_xrays(write(tmp_path / os.fsdecode(b"caf\xe9"), images()))
    assert case["id"].encode() == b"caf?"


def test_a_report_of_a_library_is_refused(tmp_path):
    write(tmp_path, images())
    (tmp_path / "report.txt").write_text("Nodule. " * 100_000)
    fails("report.txt has 800,000 bytes", tmp_path)


@pytest.mark.parametrize("name", ["report.txt", "geometry.yaml", "view_0.npy"])
def test_what_lies_in_a_folder_is_not_replaced_unless_asked_for(tmp_path, name):
    (tmp_path / name).write_text("mine")
    with pytest.raises(FileExistsError, match=f"already holds {name}"):
        save_xrays(tmp_path, images(), ConeBeam.orbit(2, 1020, 740, SHAPE, 70))
    assert (tmp_path / name).read_text() == "mine" and len(list(tmp_path.iterdir())) == 1
