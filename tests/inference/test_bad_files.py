"""Bad files: a sentence each, and the good ones beside them are reconstructed."""

from __future__ import annotations

import json
import shutil
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pydicom
import pytest
from command_lines import refusal
from PIL import Image
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from inference.runs import FILES, LAUGHS, ORBIT, dicom, image, names, sirt, with_prior, write_ct, xrays
from phydict.cli.infer import main
from phydict.grid import Grid
from phydict.prior import VolumeUNet
from phydict.xray import ConeBeam


def headed(good: Path, target: Path, header: object) -> Path:
    """A prior's file with this header, as JSON where it is no text, and changed by it where it is a function."""
    with safe_open(good, "pt") as file:
        known = json.loads(file.metadata()["phydict"])
    header = header(known) if callable(header) else header
    save_file(load_file(good), target, {"phydict": header if isinstance(header, str) else json.dumps(header)})
    return target


def with_nan(source: Path, target: Path) -> Path:
    """A prior's file of which one weight is NaN."""
    weights = load_file(source)
    weights["null"].view(-1)[3] = np.nan
    with safe_open(source, "pt") as file:
        save_file(weights, target, file.metadata())
    return target


def no_air(hu: np.ndarray) -> np.ndarray:
    hu[3, 4, 5] = np.nan
    return hu


BAD_INPUT = {
    "no folder of X-rays": (lambda at: sirt("predict", at, f"--data.xrays={at / 'nowhere'}"), ["nowhere"]),
    "an empty folder": (lambda at: sirt("predict", at, f"--data.xrays={at}"), ["geometry.yaml"]),
    "a view is missing": (lambda at: sirt("predict", at, f"--data.xrays={one_missing(at / 'in')}"),
                          ["3 views", "2 images"]),
    "no CT": (lambda at: sirt("test", at, f"--data.cts={at / 'nowhere.nii.gz'}", *ORBIT), ["nowhere.nii.gz"]),
    "a text for a CT": (lambda at: sirt("test", at, f"--data.cts={Path(__file__)}", *ORBIT), [Path(__file__).name]),
    "a cut CT": (lambda at: sirt("test", at, f"--data.cts={cut(at / 'a.nii.gz')}", *ORBIT), ["a.nii.gz"]),
}
BAD_PRIORS = {
    "no file": (lambda good, file: None, "p.safetensors"),
    "truncated": (lambda good, file: file.write_bytes(good.read_bytes()[:5000]), "truncated"),
    "not finite": (with_nan, "weights that are not finite (null has 1 NaN"),
} | {name: (lambda good, file, header=header: headed(good, file, header), words) for name, header, words in (
    ("list", [], "no phydict prior of format"), ("null", None, "no phydict prior of format"),
    ("deep", "[" * 100_000, "nested too deeply"), ("format", lambda known: known | {"format": 99}, "format"),
    ("stage", lambda known: known | {"stage": ["base"]}, "of stage ['base']"),
    ("text", lambda known: {key: value for key, value in known.items() if key != "text"}, "text is 'missing'"),
    ("number", lambda known: known | {"sigma_data": "half"}, "sigma_data is 'half'"),
    ("channels", lambda known: known | {"network": known["network"] | {"channels": "many"}},
     "network.channels is 'many'"),
    ("no grid", lambda known: known | {"grid": 3}, "the network that the header describes"),
    ("grid", lambda known: known | {"grid": Grid.cube(15).to_dict()}, "(15, 15, 15)"),
    ("network", lambda known: known | {"network": VolumeUNet(
        channels=(8, 16), attention=(False, True), head_channels=8).settings}, "network"))}


@pytest.mark.parametrize("case", BAD_INPUT)
def test_bad_input_is_one_sentence(case, tmp_path, capsys):
    make, words = BAD_INPUT[case]
    (tmp_path / "in").mkdir()
    said = refusal(capsys, main, [*make(tmp_path), f"--model.out={tmp_path / 'out'}"])
    assert all(word in said for word in words), said
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("case", BAD_PRIORS)
def test_a_bad_prior_is_one_sentence(case, prior, measured, tmp_path, capsys):
    make, words = BAD_PRIORS[case]
    file = tmp_path / "p.safetensors"
    make(prior, file)
    said = refusal(capsys, main, with_prior("predict", tmp_path / "out", file, f"--data.xrays={measured}"))
    assert "p.safetensors" in said and words in said and not (tmp_path / "out").exists()


GEOMETRY = """beam:
  orbit: {views: 3, source_to_detector: 1020, source_to_isocentre: 740, shape: [24, 24], pixel: [24, 24]}
"""


def geometry(old: str = "", new: str = "") -> Callable[[Path], object]:
    """Writes X-rays of noise whose geometry.yaml says `new` in place of `old`."""
    assert old in GEOMETRY
    return lambda at: (xrays(at) / "geometry.yaml").write_text(GEOMETRY.replace(old, new) if old else new)


def bomb(file: Path) -> None:
    """A PNG of 50000 x 50000 pixels in less than a hundred bytes."""
    parts = [(b"IHDR", struct.pack(">IIBBBBB", 50_000, 50_000, 8, 0, 0, 0, 0)), (b"IDAT", zlib.compress(b"")),
             (b"IEND", b"")]
    file.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        for kind, data in parts))


def terabytes(file: Path) -> None:
    """A .npy file whose header promises 4 TB."""
    with file.open("wb") as stream:
        np.lib.format.write_array_header_1_0(stream, {"descr": "<f4", "fortran_order": False, "shape": (10**6, 10**6)})


def one_missing(at: Path) -> Path:
    (xrays(at) / "view_1.npy").unlink()
    return at


def one_pixel(value: float) -> Callable[[Path], None]:
    """Writes counts below an air of 1; the second image holds 1, but for one pixel."""
    pixels = np.ones((24, 24), np.float32)
    pixels[3, 4] = value

    def make(at: Path) -> None:
        geometry(new=GEOMETRY + "intensity: {kind: counts, air: 1}\n")(at)
        np.save(at / "view_1.npy", pixels)
    return make


def constant(at: Path) -> None:
    for file in xrays(at).glob("*.npy"):
        np.save(file, np.full((24, 24), 3, np.float32))


def saturated(at: Path) -> None:
    """16-bit images at their maximum, but for a mark in a corner."""
    pixels = np.full((24, 24), 65535, np.uint16)
    pixels[0, :3] = 0
    geometry(new=GEOMETRY + "intensity: {kind: line_integrals, scale: 1.0e-4}\n")(at)
    for file in at.glob("*.npy"):
        file.unlink()
        Image.fromarray(pixels).save(file.with_suffix(".png"))


def table_without_descriptor() -> pydicom.Dataset:
    table = pydicom.Dataset()
    table.add_new("LUTData", "US", [0, 1, 2])
    return table


SPOILT_XRAYS = {
    "wrong size": (image(lambda file: np.save(file, np.ones((24, 20), np.float32))),
                   ["view_1.npy", "24 x 20", "24 x 24"]),
    "detector in the patient": (lambda at: xrays(at, ConeBeam.orbit(3, 800.0, 740.0, (24, 24), 24.0)), ["detector"]),
    "unknown key": (geometry("beam:", "betm: 1\nbeam:"), ["betm"]),
    "zero distance": (geometry("1020", "0.0"), ["source_to_detector=0.0"]),
    "pixels in cm": (geometry("pixel: [24, 24]", "pixel: [2.4, 2.4]"), ["times larger than the detector", "in mm"]),
    "pixels in um": (geometry("pixel: [24, 24]", "pixel: [240, 240]"), ["times smaller", "in mm"]),
    "NaN": (one_pixel(np.nan), ["view_1.npy", "1 NaN"]),
    "infinite pixel": (one_pixel(np.inf), ["view_1.npy", "1 NaN or infinite"]),
    "negative counts": (one_pixel(-1), ["1 pixels hold negative counts"]),
    "counts above air": (one_pixel(7), ["1 pixels hold counts above air, up to 7 times"]),
    "constant": (constant, ["view_0.npy", "shows nothing"]),
    "saturated": (saturated, ["view_0.png", "saturated"]),
    "no distance": (dicom(DistanceSourceToDetector=None), ["run.dcm", "DistanceSourceToDetector (0018,1110)"]),
    "bomb": (image(bomb, "png"), ["view_1.png cannot be read", "decompression bomb"]),
    "terabytes": (image(terabytes), ["view_1.npy cannot be read", "promises 4,000,000,000,000 bytes"]),
    "zipped": (image(lambda file: np.savez(file.open("wb"), np.ones((24, 24)))), ["view_1.npy cannot be read"]),
    "complex": (image(lambda file: np.save(file, np.ones((24, 24), complex))), ["view_1.npy", "type complex128"]),
    "infinite": (geometry("1020", ".inf"), ["geometry.yaml", "source_to_detector must be finite"]),
    "400 digits": (geometry("1020", "9" * 400), ["geometry.yaml", "source_to_detector"]),
    "brackets": (geometry(new="beam: " + "[" * 20_000), ["geometry.yaml", "nested more than 32 levels"]),
    "anchors": (geometry(new="a: &a [1, 2, 3, 4, 5, 6, 7, 8, 9]\n" + LAUGHS), ["geometry.yaml", "by aliases"]),
    "many views": (geometry("views: 3", "views: 1000000000"), ["geometry.yaml", "1000000000 views", "3 images"]),
    "quoted": (geometry("1020", "'1020'"), ["geometry.yaml", "source_to_detector", "without units and quotes"]),
    "three sizes": (geometry("[24, 24]}", "[24, 24, 24]}"), ["geometry.yaml", "pixel must be"]),
    "a month of 13": (geometry("1020", "2024-13-01"), ["geometry.yaml", "source_to_detector", "'2024-13-01'"]),
    "part of a pixel": (geometry("shape: [24, 24]", "shape: [24.9, 24]"), ["geometry.yaml", "whole numbers", "24.9"]),
    "twice": (geometry("views: 3", "views: 3, views: 4"), ["geometry.yaml", "`beam.orbit.views` is given twice"]),
    "latin-1": (lambda at: (xrays(at) / "geometry.yaml").write_bytes(b"# \xe9\n"), ["geometry.yaml is not UTF-8"]),
    "latin-1 report": (lambda at: (xrays(at) / "report.txt").write_bytes(b"\xe9"), ["report.txt is not UTF-8"]),
    "one spacing": (dicom(ImagerPixelSpacing=24.0), ["run.dcm", "ImagerPixelSpacing"]),
    "no descriptor": (dicom(ModalityLUTSequence=[table_without_descriptor()]), ["modality LUT of", "run.dcm"]),
}


def voxels_of(kind: object) -> Callable[[Path], object]:
    return lambda file: write_ct(file, 0, change=lambda hu: np.zeros(hu.shape, kind))


def endless(file: Path) -> None:
    """A NIfTI file whose header promises 32000^3 voxels."""
    content = bytearray(write_ct(file, 0).read_bytes())
    content[40:48] = struct.pack("<4h", 3, 32_000, 32_000, 32_000)
    file.write_bytes(content)


def cut(file: Path) -> Path:
    """A compressed NIfTI file that ends too early."""
    file.write_bytes(write_ct(file, 0).read_bytes()[:3000])
    return file


SPOILT_CTS = {
    "directionless": (lambda file: write_ct(file, 0, code=0), ["directionless.nii", "sform"]),
    "flat": (lambda file: write_ct(file, 0, change=lambda hu: hu[:, :, 0]), ["flat.nii", "2D"]),
    "nan": (lambda file: write_ct(file, 0, change=no_air), ["nan.nii", "1 NaN"]),
    "endless": (endless, ["endless.nii", "promises 131,072,000,000,000 bytes"]),
    "colours": (voxels_of([("R", "u1"), ("G", "u1"), ("B", "u1")]), ["colours.nii", "one real number each"]),
    "complex": (voxels_of(np.complex64), ["complex.nii", "one real number each"]),
}


def assert_told(capsys, args: list[str], spoilt: dict, good: Path) -> None:
    """A run over `spoilt` cases and a good one says a sentence of each spoilt one, and writes the good one alone."""
    capsys.readouterr()
    with pytest.raises(SystemExit) as stopped:
        main(args)
    said = capsys.readouterr().err
    lines = [line.removeprefix("error: ") for line in said.splitlines() if line.startswith("error: ")]
    assert stopped.value.code == 2 and "Traceback" not in said
    assert f"{len(spoilt)} of {len(spoilt) + 1} cases were not reconstructed" in lines[-1]
    found = dict(line.split(": ", 1) for line in lines[:-1])
    assert sorted(found) == sorted(spoilt) and len(lines) == len(spoilt) + 1
    wrong = {name: found[name] for name, (_, words) in spoilt.items() if any(word not in found[name] for word in words)}
    assert not wrong
    assert [path for path in good.parent.iterdir() if path.is_dir()] == [good] and names(good) == FILES


def test_each_spoilt_folder_of_xrays_is_one_sentence_and_the_good_one_is_reconstructed(measured, tmp_path, capsys):
    shutil.copytree(measured / "bert", tmp_path / "in" / "bert")
    for name, (make, _) in SPOILT_XRAYS.items():
        (tmp_path / "in" / name).mkdir()
        make(tmp_path / "in" / name)
    args = sirt("predict", tmp_path / "out", f"--data.xrays={tmp_path / 'in'}")
    assert_told(capsys, args, SPOILT_XRAYS, tmp_path / "out" / "sirt" / "bert")


def test_each_spoilt_ct_is_one_sentence_and_the_good_one_is_reconstructed(cts, tmp_path, capsys):
    (tmp_path / "in").mkdir()
    shutil.copyfile(cts / "a.nii.gz", tmp_path / "in" / "a.nii.gz")
    for name, (make, _) in SPOILT_CTS.items():
        make(tmp_path / "in" / f"{name}.nii")
    args = sirt("test", tmp_path / "out", f"--data.cts={tmp_path / 'in'}", *ORBIT)
    assert_told(capsys, args, SPOILT_CTS, tmp_path / "out" / "sirt" / "a")
