"""The command line of reconstruction: what it writes, that it resumes after a stop, and how it refuses bad input."""

from __future__ import annotations

import csv
import json
import os
import resource
import shutil
import socket
import struct
import subprocess
import sys
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import nibabel
import numpy as np
import pydicom
import pytest
import torch
from command_lines import refusal
from dicom_files import orbit_tags, write_dicom
from PIL import Image
from prior.medsyn_files import entries, super_resolution_unet, text_unet, write
from safetensors import safe_open
from safetensors.torch import load_file, save_file

import phydict
from phydict.baselines import SIRT
from phydict.cli.infer import main
from phydict.datasets import body_mask, load_xrays, phantom_case, prepare_ct, save_xrays
from phydict.evaluation import volume_metrics
from phydict.grid import Grid
from phydict.methods import reconstruct, reconstructor
from phydict.posterior import PriorOnly
from phydict.prior import LocalUNet, Prior, SuperResolution, VolumeUNet, save_prior, save_super_resolution
from phydict.runtime.precision import instruction_set
from phydict.units import MU_WATER, HUWindow
from phydict.xray import ConeBeam, Ideal, Polychromatic, Projector
from phydict.xray.geometry_files import write_beam

ROOT = Path(__file__).parents[1]
BEAM = ConeBeam.orbit(3, 1020.0, 740.0, (24, 24), 24.0)
ORBIT = ["--data.orbit.views=3", "--data.orbit.detector=[24,24]", "--data.orbit.pixel=[24,24]"]
FILES = ["panel.png", "reconstruction.json", "thumbnail.png", "view.js", "volume.nii.gz"]


def sirt(command: str, out: Path, *more: str) -> list[str]:
    return [command, "--model.method=sirt", "--model.method.init_args.iterations=3",
            f"--model.out={out}", "--trainer.accelerator=cpu", *more]


def phantoms(out: Path, count: int, *more: str) -> list[str]:
    return sirt("test", out, "--data.cts=phantom", f"--data.phantoms={count}", *ORBIT, *more)


def with_prior(command: str, out: Path, prior: Path, *more: str) -> list[str]:
    return [command, "--model.method=prior_only", "--model.method.init_args.iterations=2",
            f"--model.prior={prior}", f"--model.out={out}", "--trainer.accelerator=cpu", *more]


def record(folder: Path) -> dict:
    return json.loads((folder / "reconstruction.json").read_text())


def volume(folder: Path) -> np.ndarray:
    return np.asarray(nibabel.load(folder / "volume.nii.gz").dataobj)


def stamp(folder: Path) -> dict[str, int]:
    return {name: (folder / name).stat().st_mtime_ns for name in FILES}


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def write_ct(path: Path, seed: int, code: int = 1, change=lambda hu: hu) -> Path:
    """A box of soft tissue in air, 20^3 voxels of 10 mm."""
    path.parent.mkdir(exist_ok=True)
    hu = np.full((20, 20, 20), -1000, np.float32)
    hu[4:16, 6:15] = 40 + 10 * np.random.default_rng(seed).standard_normal((12, 9, 20))
    image = nibabel.Nifti1Image(change(hu), None)
    image.header.set_zooms((10,) * image.ndim)
    image.set_sform(np.diag([10.0, 10.0, 10.0, 1.0]), code=code)
    image.set_qform(np.diag([10.0, 10.0, 10.0, 1.0]), code=code)
    nibabel.save(image, path)
    return path


@contextmanager
def largest_file(size: int) -> Iterator[None]:
    """No file may grow beyond `size` bytes."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


@pytest.fixture(scope="module")
def measured(tmp_path_factory) -> Path:
    """Two folders of X-rays."""
    root = tmp_path_factory.mktemp("measured")
    for name, seed in (("anna", 1), ("bert", 2)):
        truth = HUWindow().to_mu(phantom_case(seed, Grid.cube(64))["volume"])
        save_xrays(root / name, Projector(Grid.cube(64), BEAM)(truth[None])[0], BEAM, report="No effusion.")
    return root


@pytest.fixture(scope="module")
def prior(tmp_path_factory) -> Path:
    """An untrained prior on 16^3 voxels."""
    torch.manual_seed(0)
    file = tmp_path_factory.mktemp("prior") / "tiny.safetensors"
    save_prior(Prior(VolumeUNet(channels=(8, 8), attention=(False, True), head_channels=8), Grid.cube(16),
                     HUWindow()), file)
    return file


@pytest.fixture(scope="module")
def fine(tmp_path_factory) -> Path:
    """An untrained super-resolution stage from 16^3 to 32^3 voxels."""
    torch.manual_seed(0)
    file = tmp_path_factory.mktemp("fine") / "fine.safetensors"
    save_super_resolution(SuperResolution(LocalUNet(2, 1, 2, (8, 8)), Grid.cube(32), HUWindow(), 2), file)
    return file


@pytest.fixture(scope="module")
def cts(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("cts")
    for n, name in enumerate("ab"):
        write_ct(folder / f"{name}.nii.gz", n)
    return folder


@pytest.fixture(scope="module")
def scored(tmp_path_factory) -> Path:
    """The finished test of SIRT on two phantoms."""
    out = tmp_path_factory.mktemp("scored")
    main(phantoms(out, 2))
    return out / "sirt"


def test_predict_writes_what_the_library_reconstructs(measured, tmp_path, capsys):
    main(sirt("predict", tmp_path, f"--data.xrays={measured}", "--model.seed=7"))
    folder = tmp_path / "sirt" / "anna"
    assert names(tmp_path / "sirt") == ["anna", "bert"] and names(folder) == FILES
    case = load_xrays(measured / "anna")
    expected = reconstruct(case["xrays"], case["beam"], method=SIRT(iterations=3))
    image = nibabel.load(folder / "volume.nii.gz")
    np.testing.assert_array_equal(image.affine, Grid.cube(64).affine)
    assert nibabel.aff2axcodes(image.affine) == ("R", "A", "S")
    np.testing.assert_array_equal(volume(folder), expected.volume.numpy())
    said = record(folder)
    assert said["misfit"] == pytest.approx(expected.misfit) and len(said["misfit_per_view"]) == said["views"] == 3
    assert set(said["seconds"]) == {"prepare", "sample", "score"} and said["process_peak_memory_mb"] > 100
    assert said["settings"]["seed"] == 7 and said["settings"]["method"]["iterations"] == 3
    assert said["settings"]["method"]["mu_water"] == 0.02  # also what the configuration left out
    assert said["precision"] == "float32" and said["instruction_set"] == instruction_set(torch.device("cpu"))
    assert {"phydict", "torch", "python"} <= set(said["versions"]) and said["report"] == "No effusion."
    assert isinstance(said["seed"], int) and said["scores"] is None
    with Image.open(folder / "panel.png") as page:
        assert min(page.size) > 300
    out, err = capsys.readouterr()
    assert out == f"results in {tmp_path / 'sirt'}\npage: {tmp_path / 'index.html'}\n"
    assert "anna" in (tmp_path / "index.html").read_text()
    assert [line.split(":")[0] for line in err.splitlines() if not line.startswith("Seed")] == ["sirt", "anna", "bert"]


@pytest.mark.parametrize("files", ["one run", "a series"])
def test_dicom_gives_the_volume_of_its_npy_twin(measured, tmp_path, files):
    xrays = load_xrays(measured / "anna")["xrays"].numpy().astype(np.float64)
    slope = 2.0**-12  # exact in DICOM's decimal strings and in float32
    stored = np.rint(xrays / slope).astype(np.uint16)
    save_xrays(tmp_path / "in" / "npy", stored * slope, BEAM)
    tags = orbit_tags(3, 1020.0, 740.0, (24.0, 24.0)) | {"RescaleSlope": slope, "RescaleIntercept": 0.0}
    if files == "one run":
        write_dicom(tmp_path / "in" / "dicom" / "run", stored, **tags)
    else:  # a file per view, each with its own angle
        angles = tags.pop("PositionerPrimaryAngleIncrement")
        del tags["PositionerSecondaryAngleIncrement"]
        for k, angle in enumerate(angles):
            write_dicom(tmp_path / "in" / "dicom" / f"IM{k}", stored[k], **tags | {"PositionerPrimaryAngle": angle})
    (tmp_path / "in" / "dicom" / "geometry.yaml").write_text("intensity: {kind: line_integrals}\n")
    main(sirt("predict", tmp_path / "out", f"--data.xrays={tmp_path / 'in'}"))
    dicom, npy = (volume(tmp_path / "out" / "sirt" / name) for name in ("dicom", "npy"))
    assert np.ptp(npy) > 500  # HU
    np.testing.assert_allclose(dicom, npy, atol=1e-2)


def test_rtks_geometry_gives_the_volume_of_our_own(measured, tmp_path):
    case = load_xrays(measured / "anna")
    folder = tmp_path / "rtk"
    save_xrays(folder, case["xrays"], case["beam"])
    write_beam(folder / "geometry.xml", case["beam"])
    (folder / "geometry.yaml").write_text("beam: {file: geometry.xml, pixel: [24, 24]}\n")
    main(sirt("predict", tmp_path / "out", f"--data.xrays={folder}"))
    expected = reconstruct(case["xrays"], case["beam"], method=SIRT(iterations=3))
    np.testing.assert_allclose(volume(tmp_path / "out" / "sirt" / "rtk"), expected.volume.numpy(), atol=1e-2)


def test_a_dry_run_draws_every_case_and_reconstructs_nothing(measured, tmp_path, capsys):
    main(sirt("predict", tmp_path, f"--data.xrays={measured}", "--dry_run"))
    assert names(tmp_path) == ["dry_run"] and names(tmp_path / "dry_run") == ["anna.png", "bert.png"]
    with Image.open(tmp_path / "dry_run" / "anna.png") as page:
        assert min(page.size) > 900
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 7 and lines[-1] == f"pages in {tmp_path / 'dry_run'}"
    pose, agreement = lines[0].rsplit(" ", 1)
    assert pose == "anna view 1: source posterior, columns to left, rows to inferior; agreement"
    assert float(agreement) > 0.7
    assert not any("better" in line for line in lines)


def test_a_dry_run_sees_images_that_lie_upside_down(measured, tmp_path, capsys):
    case = load_xrays(measured / "anna")
    save_xrays(tmp_path / "case", case["xrays"].flip(1), case["beam"])
    main(sirt("predict", tmp_path / "out", f"--data.xrays={tmp_path / 'case'}", "--dry_run"))
    lines = capsys.readouterr().out.splitlines()[:3]
    assert all("with flip_rows changed" in line for line in lines), lines


@pytest.mark.filterwarnings("default")
def test_a_dry_run_warns_of_images_unlike_a_thorax_in_their_geometry(measured, tmp_path, capsys):
    case = load_xrays(measured / "anna")
    height, width = case["xrays"].shape[1:]
    middle = case["xrays"][:, height // 3:height - height // 3, width // 3:width - width // 3]
    large = torch.nn.functional.interpolate(middle[None], (height, width), mode="bilinear")[0]
    for name, xrays in (("right", case["xrays"]), ("magnified", large)):
        save_xrays(tmp_path / name, xrays, case["beam"])
        main(sirt("predict", tmp_path / "out", f"--data.xrays={tmp_path / name}", "--dry_run"))
        assert ("agrees little with a standard thorax" in capsys.readouterr().err) == (name == "magnified")


def test_a_dry_run_goes_on_after_a_bad_case_and_names_it_at_the_end(measured, tmp_path, capsys):
    shutil.copytree(measured, tmp_path / "cases")
    (tmp_path / "cases" / "anna" / "view_1.npy").unlink()
    capsys.readouterr()
    with pytest.raises(SystemExit) as stopped:
        main(sirt("predict", tmp_path / "out", f"--data.xrays={tmp_path / 'cases'}", "--dry_run"))
    out, err = capsys.readouterr()
    said = [line for line in err.splitlines() if line.startswith("error: ")]
    assert stopped.value.code == 2 and names(tmp_path / "out" / "dry_run") == ["bert.png"] and "bert view 1" in out
    assert said[0].startswith("error: anna: ") and "1 of 2 cases cannot be reconstructed (anna)" in said[1]


@pytest.mark.filterwarnings("default")
def test_a_dry_run_warns_of_a_left_lateral_view_told_to_stand_at_90_degrees(tmp_path, capsys):
    lateral, told = (ConeBeam.orbit(1, 1020.0, 740.0, (48, 48), 12.0, start_degrees=angle) for angle in (270, 90))
    truth = HUWindow().to_mu(phantom_case(1, Grid.cube(64))["volume"])
    for name, beam in (("right", lateral), ("wrong", told)):
        save_xrays(tmp_path / name, Projector(Grid.cube(64), lateral)(truth[None])[0], beam)
        main(sirt("predict", tmp_path / "out", f"--data.xrays={tmp_path / name}", "--dry_run"))
        said = [line for line in capsys.readouterr().err.splitlines() if "mirrored" in line]
        assert len(said) == (name == "wrong"), name
    assert "wrong: view 1 " in said[0] and "(LL)" in said[0] and "270" in said[0]


def test_a_dry_run_belongs_to_predict(tmp_path, capsys):
    assert "dry_run" in refusal(capsys, main, phantoms(tmp_path / "out", 1, "--dry_run"))


def test_one_folder_of_xrays_is_a_case(measured, tmp_path, monkeypatch):
    monkeypatch.chdir(measured / "bert")
    main(sirt("predict", tmp_path, "--data.xrays=../bert"))
    assert names(tmp_path / "sirt") == ["bert"]


def test_a_finished_case_is_kept_until_asked_otherwise(measured, tmp_path, capsys):
    args = sirt("predict", tmp_path, f"--data.xrays={measured / 'anna'}")
    folder = tmp_path / "sirt" / "anna"
    main(args)
    before = stamp(folder)
    main(args)
    assert stamp(folder) == before and "1 of 1 cases are finished already" in capsys.readouterr().err
    main([*args, "--profile"])
    assert "not profiled: --model.overwrite true" in capsys.readouterr().err
    for change in ("--model.seed=1", "--model.method.init_args.iterations=4", "--data.geometry=arc_90"):
        said = refusal(capsys, main, [*args, change])
        assert "other settings" in said and "overwrite" in said
    assert stamp(folder) == before
    main([*args, "--model.overwrite=true", "--model.seed=1"])
    assert all(stamp(folder)[name] > before[name] for name in FILES) and record(folder)["settings"]["seed"] == 1


@pytest.mark.parametrize("stop", [KeyboardInterrupt, RuntimeError])
def test_a_stopped_run_goes_on_where_it_was(measured, tmp_path, monkeypatch, stop):
    args = sirt("predict", tmp_path, f"--data.xrays={measured}")
    calls, whole = [], SIRT.reconstruct

    def stopping(self, *given):
        calls.append(given)
        if len(calls) == 2:
            raise stop
        return whole(self, *given)

    monkeypatch.setattr(SIRT, "reconstruct", stopping)
    with pytest.raises(SystemExit if stop is KeyboardInterrupt else stop):
        main(args)
    assert names(tmp_path / "sirt") == ["anna"]
    before = stamp(tmp_path / "sirt" / "anna")
    main(args)
    assert stamp(tmp_path / "sirt" / "anna") == before and len(calls) == 3
    assert all(f'"folder": "sirt/{case}"' in (tmp_path / "index.html").read_text() for case in ("anna", "bert"))
    assert names(tmp_path / "sirt" / "bert") == FILES


def test_a_partial_folder_is_never_a_finished_case(measured, scored, tmp_path):
    gone = subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    for process in (gone.pid, os.getpid()):  # killed while it wrote, and writing now
        partial = tmp_path / "sirt" / f".anna.{socket.gethostname()}.{process}.partial"
        partial.mkdir(parents=True)
        (partial / "volume.nii.gz").write_bytes(b"half")
    main(sirt("predict", tmp_path, f"--data.xrays={measured / 'anna'}"))
    assert names(tmp_path / "sirt" / "anna") == FILES and volume(tmp_path / "sirt" / "anna").shape == (64, 64, 64)
    assert names(tmp_path / "sirt") == ["anna"]


@pytest.mark.parametrize("overwrite", ["false", "true"])
def test_a_folder_that_is_no_case_is_never_replaced(measured, tmp_path, capsys, overwrite):
    notes = tmp_path / "sirt" / "anna" / "notes.txt"
    notes.parent.mkdir(parents=True)
    notes.write_text("mine")
    said = refusal(capsys, main, sirt("predict", tmp_path, f"--data.xrays={measured / 'anna'}",
                                f"--model.overwrite={overwrite}"))
    assert str(notes.parent) in said and "model.out" in said and "overwrite" not in said
    assert names(tmp_path / "sirt") == ["anna"] and notes.read_text() == "mine"


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("place, name, how", [
    (".", "cases", "is the input"), (".", "linked", "is the input"), ("cases", "anna", "lies inside"),
    ("cases", "sirt", "lies inside"), ("cases/anna", "sirt", "lies inside"), ("..", "{parent}", "holds"),
    ("linked", "anna", "lies inside")])
def test_an_output_that_is_holds_or_lies_inside_the_input_is_refused(measured, tmp_path, capsys, place, name, how):
    shutil.copytree(measured, tmp_path / "cases")
    (tmp_path / "linked").symlink_to(tmp_path / "cases")
    before = contents(tmp_path)
    args = sirt("predict", tmp_path / place, f"--data.xrays={tmp_path / 'cases'}", "--model.overwrite=true",
                f"--model.name={name.format(parent=tmp_path.name)}")
    said = refusal(capsys, main, args)
    assert how in said and "give another model.out" in said and contents(tmp_path) == before


def test_results_are_never_written_among_the_cts(cts, tmp_path, capsys):
    before = contents(cts)
    said = refusal(capsys, main, sirt("test", cts, f"--data.cts={cts}", *ORBIT))
    assert "lies inside the input" in said and contents(cts) == before


def test_a_dry_run_writes_no_page_among_the_xrays(measured, tmp_path, capsys):
    shutil.copytree(measured, tmp_path / "dry_run")
    before = contents(tmp_path)
    said = refusal(capsys, main, sirt("predict", tmp_path, f"--data.xrays={tmp_path / 'dry_run'}", "--dry_run"))
    assert "is the input" in said and contents(tmp_path) == before


@pytest.mark.parametrize("name", ["../other", "/{out}/other", "a/b", "..", ".", ""])
def test_a_name_is_that_of_one_folder_inside_the_output(measured, tmp_path, capsys, name):
    name = name.format(out=str(tmp_path).strip("/"))
    said = refusal(capsys, main, sirt("predict", tmp_path / "out", f"--data.xrays={measured}", f"--model.name={name}"))
    assert f"one folder inside model.out, but '{name}' was given" in said and names(tmp_path) == []


@pytest.mark.parametrize("several", [False, True])
def test_a_result_stays_when_its_redo_fails(measured, tmp_path, capsys, several):
    shutil.copytree(measured if several else measured / "anna", tmp_path / "anna" if not several else tmp_path / "in")
    given = tmp_path / ("in" if several else "anna")
    args = sirt("predict", tmp_path / "out", f"--data.xrays={given}")
    main(args)
    folder = tmp_path / "out" / "sirt" / "anna"
    before = stamp(folder)
    image = (given / "anna" if several else given) / "view_1.npy"
    image.write_bytes(image.read_bytes()[:200])
    capsys.readouterr()
    with pytest.raises(SystemExit) as stopped:
        main([*args, "--model.overwrite=true"])
    said = capsys.readouterr().err
    assert stopped.value.code == 2 and "view_1.npy" in said and stamp(folder) == before
    assert ("1 of 2 cases were not reconstructed (anna)" in said) == several


@pytest.mark.parametrize("seed, code", [(0, None), (1, 2)], ids=["same settings", "other settings"])
def test_a_run_that_another_one_overtakes_keeps_its_result(measured, tmp_path, capsys, monkeypatch, seed, code):
    args = sirt("predict", tmp_path, f"--data.xrays={measured / 'anna'}")
    folder, whole = tmp_path / "sirt" / "anna", SIRT.reconstruct
    overtaken = []

    def slow(self, *given):
        found = whole(self, *given)
        if not overtaken:
            overtaken.append(True)
            main([*args, f"--model.seed={seed}"])
            overtaken.append(stamp(folder))
        return found

    monkeypatch.setattr(SIRT, "reconstruct", slow)
    if code is None:
        main(args)
    else:
        assert "another process has finished" in refusal(capsys, main, args)
    assert stamp(folder) == overtaken[1] and record(folder)["settings"]["seed"] == seed


def test_a_result_that_cannot_be_written_leaves_nothing_beside(measured, tmp_path):
    case = load_xrays(measured / "anna")
    found = reconstruct(case["xrays"], case["beam"], method=SIRT(iterations=1))
    found.save_nifti(tmp_path / "volume.nii.gz")
    before = contents(tmp_path)
    with largest_file(1000), pytest.raises(OSError):
        found.save_nifti(tmp_path / "volume.nii.gz")
    assert contents(tmp_path) == before


def test_a_damaged_record_is_named(measured, tmp_path, capsys):
    args = sirt("predict", tmp_path, f"--data.xrays={measured / 'anna'}")
    main(args)
    file = tmp_path / "sirt" / "anna" / "reconstruction.json"
    for content in (file.read_text()[:50], "{}"):
        file.write_text(content)
        said = refusal(capsys, main, args)
        assert str(file.parent) in said and "damaged" in said


def test_the_record_names_the_methods_publication(measured, tmp_path):
    main(sirt("predict", tmp_path, f"--data.xrays={measured / 'anna'}"))
    file = tmp_path / "sirt" / "anna" / "reconstruction.json"
    assert "10.1109/TMI.2008.923696" in json.loads(file.read_text())["citation"]


def test_a_finished_case_is_never_taken_for_that_of_other_data(measured, cts, tmp_path, capsys):
    shutil.copytree(measured / "anna", tmp_path / "case")
    xrays, ct = (sirt("predict", tmp_path / "out", f"--data.xrays={tmp_path / 'case'}"),
                 sirt("test", tmp_path / "out", f"--data.cts={tmp_path / 'ct.nii.gz'}", *ORBIT))
    main(xrays)
    for file in sorted((tmp_path / "case").iterdir()):
        whole = file.read_bytes()
        file.write_bytes(whole + b"\n")
        assert "other data" in refusal(capsys, main, xrays), file
        file.write_bytes(whole)
    main(xrays)
    for name in ("a", "b"):
        shutil.copyfile(cts / f"{name}.nii.gz", tmp_path / "ct.nii.gz")
        if name == "a":
            main(ct)
            shutil.copyfile(cts / "a.nii.gz", tmp_path / "ct.nii.gz")  # later, but the same
            main(ct)
    assert "other data" in refusal(capsys, main, ct)


def test_one_bad_case_spoils_no_other(measured, tmp_path, capsys):
    shutil.copytree(measured, tmp_path / "cases")
    next(path for path in (tmp_path / "cases" / "anna").iterdir() if path.suffix not in (".yaml", ".txt")).unlink()
    capsys.readouterr()
    with pytest.raises(SystemExit) as stopped:
        main(sirt("predict", tmp_path / "out", f"--data.xrays={tmp_path / 'cases'}"))
    said = [line for line in capsys.readouterr().err.splitlines() if line.startswith("error: ")]
    assert stopped.value.code == 2 and len(said) == 2
    assert said[0].startswith("error: anna: ") and "1 of 2 cases were not reconstructed (anna)" in said[1]
    assert names(tmp_path / "out" / "sirt") == ["bert"] and names(tmp_path / "out" / "sirt" / "bert") == FILES


def test_a_table_holds_the_cases_of_its_run_alone(cts, tmp_path):
    main(sirt("test", tmp_path, f"--data.cts={cts}", *ORBIT))
    (tmp_path / "only.txt").write_text("b\n")
    main(sirt("test", tmp_path, f"--data.cts={cts}", *ORBIT, f"--data.only={tmp_path / 'only.txt'}"))
    with (tmp_path / "sirt" / "results.csv").open() as file:
        assert [row["case"] for row in csv.DictReader(file)] == ["b"]


def test_a_list_of_cases_must_fit_the_folder(cts, tmp_path, capsys):
    (tmp_path / "only.txt").write_text("b\nnobody\n")
    args = sirt("test", tmp_path, f"--data.cts={cts}", *ORBIT, f"--data.only={tmp_path / 'only.txt'}")
    said = refusal(capsys, main, args)
    assert "nobody" in said and "data.only" in said


def test_a_signal_ends_the_run_between_cases_and_is_no_success(tmp_path):
    args = phantoms(tmp_path, 200)
    run = subprocess.Popen([sys.executable, str(ROOT / "infer.py"), *args], stderr=subprocess.PIPE, text=True)
    for line in run.stderr:
        if "misfit" in line:
            break
    run.terminate()
    said = run.stderr.read()
    assert run.wait(60) == 143 and "run the same command again" in said
    done = names(tmp_path / "sirt")
    assert 1 <= len(done) < 200 and all(names(tmp_path / "sirt" / case) == FILES for case in done)


def test_scores_are_those_of_the_written_volumes(scored):
    with (scored / "results.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["case"] for row in rows] == ["phantom-1000000", "phantom-1000001"]
    for row in rows:
        truth = phantom_case(int(row["case"].split("-")[1]), Grid.cube(64))
        written = torch.from_numpy(volume(scored / row["case"]))[None, None]
        hu = HUWindow().to_hu(truth["volume"])[None]
        body = torch.from_numpy(body_mask(hu[0, 0].numpy(), 6.0))[None, None]
        expected = volume_metrics(written, hu, truth["masks"][None, :1], body | (truth["masks"][None, :1] > 0.5))
        assert {"psnr_body", "psnr_lung"} < expected.keys()
        for name, value in expected.items():
            assert float(row[name]) == pytest.approx(value, rel=1e-6), name
        assert float(row["misfit"]) == record(scored / row["case"])["misfit"]
        assert row["precision"] == "float32" and row["instruction_set"] == instruction_set(torch.device("cpu"))
    table = (scored / "results.md").read_text()
    psnr = [float(row["psnr"]) for row in rows]
    assert f"{np.mean(psnr):.2f} ± {np.std(psnr, ddof=1):.2f}" in table and "n = 2 cases" in table


DOUBTFUL = {
    "plus1024": lambda hu: hu + 1024, "wrapped": lambda hu: (hu.round().astype(np.int32) % 65536).astype(np.uint16),
    "attenuation": lambda hu: (0.02 * (1 + hu / 1000)).astype(np.float32), "air": lambda hu: 0 * hu - 1000}


@pytest.mark.filterwarnings("default")
def test_a_doubtful_ct_marks_its_row_its_record_and_the_table(tmp_path, capsys):
    for name, change in DOUBTFUL.items():
        write_ct(tmp_path / "cts" / f"{name}.nii.gz", 0, change=change)
    image = nibabel.load(write_ct(tmp_path / "cts" / "cm.nii.gz", 0))
    nibabel.save(nibabel.Nifti1Image(np.asarray(image.dataobj), np.diag([1.0, 1.0, 1.0, 1.0])), image.get_filename())
    main(sirt("test", tmp_path / "out", f"--data.cts={tmp_path / 'cts'}", *ORBIT))
    out, err = capsys.readouterr()
    with (tmp_path / "out" / "sirt" / "results.csv").open() as file:
        rows = {row["case"]: row["warning"] for row in csv.DictReader(file)}
    assert rows.keys() == {*DOUBTFUL, "cm"}
    for case, warning in rows.items():
        assert ("20 x 20 x 20 mm" if case == "cm" else f"{case} does not look like HU") in warning
        assert warning == "; ".join(record(tmp_path / "out" / "sirt" / case)["warnings"])
        assert all(sentence in err for sentence in record(tmp_path / "out" / "sirt" / case)["warnings"])
    for text in ((tmp_path / "out" / "sirt" / "results.md").read_text(), " ".join(out.split())):
        assert "Doubtful" in text and "air, attenuation, cm, plus1024, wrapped" in text and "warned" in text


def test_a_good_case_has_no_mark(tmp_path):
    main([*phantoms(tmp_path, 1), "--model.method.init_args.iterations=60"])
    assert record(tmp_path / "sirt" / "phantom-1000000")["warnings"] == []
    assert "warned" not in (tmp_path / "sirt" / "results.md").read_text()


@pytest.mark.filterwarnings("default")
def test_inverted_line_integrals_are_warned_of_and_marked(measured, tmp_path, capsys):
    case = load_xrays(measured / "anna")
    save_xrays(tmp_path / "case", case["xrays"].max() - case["xrays"], case["beam"])
    for args in ((), ("--dry_run",)):
        main(sirt("predict", tmp_path / "out", f"--data.xrays={tmp_path / 'case'}", *args))
        assert capsys.readouterr().err.count("as inverted images are") == 1
    assert "inverted" in record(tmp_path / "out" / "sirt" / "case")["warnings"][0]


def test_a_second_test_scores_nothing_twice_and_shows_one_table(scored, capsys):
    before = stamp(scored / "phantom-1000000"), (scored / "results.csv").read_text()
    main(phantoms(scored.parent, 2))
    assert (stamp(scored / "phantom-1000000"), (scored / "results.csv").read_text()) == before
    out = capsys.readouterr().out
    assert "n = 2 cases" in out and "Test metric" not in out and "Warning" not in out


def test_a_case_depends_on_its_id_and_the_seed_alone(cts, tmp_path):
    main(sirt("test", tmp_path / "both", f"--data.cts={cts}", *ORBIT))
    main(sirt("test", tmp_path / "one", f"--data.cts={cts / 'b.nii.gz'}", *ORBIT))
    main(sirt("test", tmp_path / "seed", f"--data.cts={cts / 'b.nii.gz'}", *ORBIT, "--model.seed=1"))
    both, one, seed = (volume(tmp_path / name / "sirt" / "b") for name in ("both", "one", "seed"))
    np.testing.assert_array_equal(both, one)
    assert not np.array_equal(one, seed)  # other noise in the X-rays
    assert "ssim_lung" not in record(tmp_path / "one" / "sirt" / "b")["scores"]  # no lungs, no score of them


def test_a_sample_of_the_prior_depends_on_the_seed_alone_and_is_that_of_python(prior, measured, tmp_path):
    given = ["--model.sampling.with_report=false", "--model.sampling.precision=float32"]
    main(with_prior("predict", tmp_path / "both", prior, f"--data.xrays={measured}", *given))
    main(with_prior("predict", tmp_path / "other", prior, f"--data.xrays={measured / 'bert'}", "--model.seed=5",
                    *given))
    case = load_xrays(measured / "bert")
    for name, seed in (("both", 0), ("other", 5)):
        expected = reconstruct(case["xrays"], case["beam"], prior, PriorOnly(2), seed=seed, precision="float32")
        found = volume(tmp_path / name / "prior_only" / "bert")
        np.testing.assert_array_equal(found, expected.volume.numpy())
    assert found.shape == (16, 16, 16)
    assert not np.array_equal(found, volume(tmp_path / "both" / "prior_only" / "bert"))


def test_python_gives_the_volume_of_a_test_by_the_cases_seed(prior, cts, tmp_path):
    main(with_prior("test", tmp_path, prior, f"--data.cts={cts / 'a.nii.gz'}", *ORBIT, "--model.seed=3",
                    "--model.sampling.precision=float32"))
    seed = phydict.case_seed(3, "a")
    truth = HUWindow().to_mu(prepare_ct(cts / "a.nii.gz", Grid.cube(16))["volume"])
    views = Ideal()(Projector(Grid.cube(16), BEAM, full_detector=True), truth[None], seed)[0]
    expected = reconstruct(views, BEAM, prior, PriorOnly(2), seed=seed, precision="float32")
    np.testing.assert_array_equal(volume(tmp_path / "prior_only" / "a"), expected.volume.numpy())
    assert record(tmp_path / "prior_only" / "a")["misfit"] == pytest.approx(expected.misfit)
    assert record(tmp_path / "prior_only" / "a")["seed"] == seed


def test_the_default_method_reconstructs_with_a_prior(prior, measured, tmp_path):
    main(["test", *ORBIT, f"--model.prior={prior}", f"--model.out={tmp_path}", "--data.cts=phantom",
          "--data.phantoms=1", "--model.sampling.with_report=false", "--trainer.accelerator=cpu"])
    said = record(tmp_path / "phydict_fast" / "phantom-1000000")
    assert said["network_calls"] == 10 and said["grid"]["shape"] == [16, 16, 16] and said["report"] == ""
    assert said["settings"]["prior"] == "tiny.safetensors" and said["settings"]["prior_crc32"]
    assert said["misfit"] < 0.5


def test_the_simulated_orbit_is_the_one_asked_for(scored, tmp_path, capsys):
    case = "phantom-1000000"
    main(phantoms(tmp_path / "five", 1, "--data.orbit.views=5"))
    assert len(record(tmp_path / "five" / "sirt" / case)["misfit_per_view"]) == 5
    main(phantoms(tmp_path / "same", 1, "--data.simulation_voxels=64"))
    np.testing.assert_array_equal(volume(tmp_path / "same" / "sirt" / case), volume(scored / case))
    main(phantoms(tmp_path / "finer", 1, "--data.simulation_voxels=128"))
    assert not np.array_equal(volume(tmp_path / "finer" / "sirt" / case), volume(scored / case))
    assert "multiple" in refusal(capsys, main, phantoms(tmp_path / "coarser", 1, "--data.simulation_voxels=96"))


def test_simulated_xrays_are_taken_where_a_geometry_file_says(scored, tmp_path, capsys):
    other = ["test", "--data.cts=phantom", "--data.phantoms=1", f"--model.out={tmp_path}", "--model.method=sirt",
             "--data.geometry=biplanar"]
    main(other)
    assert len(record(tmp_path / "sirt" / "phantom-1000000")["misfit_per_view"]) == 2
    assert "leave one out" in refusal(capsys, main, [*other, "--data.orbit.views=4"])
    assert "biplanar" in refusal(capsys, main, [*other[:-1], "--data.geometry=nowhere"])


def test_other_xrays_into_a_finished_folder_are_refused(scored, capsys):
    for change in ("--data.orbit.views=4", "--data.simulation_voxels=128", "--data.simulator.noise=0.1"):
        assert "other settings" in refusal(capsys, main, phantoms(scored.parent, 2, change))


def test_realistic_xrays_are_made_and_come_out_in_hu(scored, tmp_path):
    realistic = f"--config={ROOT / 'configs' / 'simulate' / 'polychromatic.yaml'}"
    main(phantoms(tmp_path, 1, realistic, "--data.simulator.kvp=70"))
    folder = "sirt/phantom-1000000"
    said, density = record(tmp_path / folder), volume(tmp_path / folder) + 1000
    assert said["settings"]["data"]["simulator"]["kvp"] == 70
    assert said["mu_water"] == Polychromatic(kvp=70).effective_mu_water > 1.2 * MU_WATER
    assert record(scored / "phantom-1000000")["mu_water"] == MU_WATER
    ideal = volume(scored / "phantom-1000000") + 1000
    assert density.mean() == pytest.approx(ideal.mean(), rel=0.05) and not np.allclose(density, ideal, rtol=1e-3)


def test_two_processes_split_the_cases_and_agree_with_one(scored, tmp_path):
    run = subprocess.run([sys.executable, str(ROOT / "infer.py"), *phantoms(tmp_path, 3, "--trainer.devices=2")],
                         capture_output=True, text=True, env=os.environ | {"OMP_NUM_THREADS": "1"}, timeout=150)
    assert run.returncode == 0, run.stderr[-2000:]
    with (tmp_path / "sirt" / "results.csv").open() as file:
        assert [row["case"][-1] for row in csv.DictReader(file)] == ["0", "1", "2"]
    assert [name for name in names(tmp_path / "sirt") if name.startswith(".")] == []
    for case in ("phantom-1000000", "phantom-1000001"):
        np.testing.assert_array_equal(volume(tmp_path / "sirt" / case), volume(scored / case))
    assert [run.stdout.count(once) for once in ("results in", "n = 3 cases", "page: ")] == [1, 1, 1]


@pytest.mark.slow
def test_two_processes_predict_every_case_once(measured, tmp_path):
    args = sirt("predict", tmp_path, f"--data.xrays={measured}", "--trainer.devices=2")
    run = subprocess.run([sys.executable, str(ROOT / "infer.py"), *args], capture_output=True, text=True, timeout=150)
    assert run.returncode == 0, run.stderr[-2000:]
    assert names(tmp_path / "sirt") == ["anna", "bert"]
    assert sorted(line.split(":")[0] for line in run.stderr.splitlines() if "misfit" in line) == ["anna", "bert"]


def xrays(folder: Path, beam: ConeBeam = BEAM) -> Path:
    """A folder of X-rays of noise."""
    save_xrays(folder, np.random.default_rng(0).random((beam.views, *beam.shape), np.float32), beam)
    return folder


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
    "a text for a CT": (lambda at: sirt("test", at, f"--data.cts={Path(__file__)}", *ORBIT), ["test_inference.py"]),
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
LAUGHS = "".join(f"{b}: &{b} [{', '.join([f'*{a}'] * 9)}]\n" for a, b in zip("abcdefgh", "bcdefghi"))


def geometry(old: str = "", new: str = "") -> Callable[[Path], object]:
    """Writes X-rays of noise whose geometry.yaml says `new` in place of `old`."""
    assert old in GEOMETRY
    return lambda at: (xrays(at) / "geometry.yaml").write_text(GEOMETRY.replace(old, new) if old else new)


def image(write: Callable[[Path], object], ending: str = "npy") -> Callable[[Path], None]:
    """Writes X-rays of noise, the second of them by `write`."""
    def make(at: Path) -> None:
        (xrays(at) / "view_1.npy").unlink()
        write(at / f"view_1.{ending}")
    return make


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


def dicom(**tags: object) -> Callable[[Path], Path]:
    """Writes a DICOM run of three views with other tags, without those that are None."""
    tags = {name: value for name, value in (orbit_tags(3, 1020.0, 740.0, (24.0, 24.0)) | tags).items()
            if value is not None}
    return lambda at: write_dicom(at / "run.dcm", np.ones((3, 24, 24), np.uint16), **tags)


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


@pytest.mark.parametrize("change, words", [
    (["--model.grid=0"], "a whole number of voxels"), (["--model.grid=100000"], "GiB of memory"),
    (["--model.seed=-1"], "a seed is a whole number"), ([f"--model.seed={2**70}"], "a seed is a whole number"),
    (["--model.method.init_args.mu_water=0"], "mu_water"), (["--model.method.init_args.mu_water=-1"], "mu_water"),
    (["--model.ou={tmp}/out"], "model.ou"), (["--data.xray={tmp}"], "data.xray"), (["--data.xray", "3"], "data.xray"),
    (["--config={tmp}/twice.yaml"], "twice.yaml: `model.seed` is given twice"),
    (["--config={tmp}/laughs.yaml"], "by aliases"), (["--config={tmp}/latin.yaml"], "latin.yaml is not UTF-8"),
    (["--config={tmp}/deep.yaml"], "nested more than 32 levels"),
], ids=lambda value: value[0].strip("-") if isinstance(value, list) else "")
def test_an_option_that_cannot_be_meant_is_one_sentence(change, words, measured, tmp_path, capsys):
    for name, text in (("twice", "model: {seed: 1, seed: 2}"), ("deep", "[" * 20_000),
                       ("laughs", "a: &a [1, 2, 3, 4, 5, 6, 7, 8, 9]\n" + LAUGHS), ("latin", "# \xe9")):
        (tmp_path / f"{name}.yaml").write_text(text, encoding="latin-1")
    change = [text.format(tmp=tmp_path) for text in change]
    said = refusal(capsys, main, sirt("predict", tmp_path / "out", f"--data.xrays={measured}", *change))
    assert words in said and not (tmp_path / "out").exists()


@pytest.mark.parametrize("change, words", [
    ("--model.sampling.samples=1000000000", "samples=1000000000 states of"),
    ("--model.sampling.guidance=nan", "model.sampling.guidance"),
    ("--model.sampling.guidance=.nan", "the guidance scale lies between 0 and 1,000,000")])
def test_an_option_of_a_prior_that_cannot_be_meant_is_one_sentence(change, words, prior, measured, tmp_path, capsys):
    said = refusal(capsys, main, with_prior("predict", tmp_path / "out", prior, f"--data.xrays={measured}", change))
    assert words in said and not (tmp_path / "out").exists()


def test_a_fault_of_the_projects_own_shows_its_trace_and_on_request_every_refusal_does(measured, tmp_path, monkeypatch):
    args = sirt("predict", tmp_path, f"--data.xrays={measured}")
    with monkeypatch.context() as patch, pytest.raises(TypeError, match="a fault"):
        patch.setattr(SIRT, "solve", lambda *_: exec("raise TypeError('a fault')"))
        main(args)
    monkeypatch.setenv("PHYDICT_TRACEBACK", "1")
    with pytest.raises(ValueError, match="a seed is a whole number"):
        main([*args, "--model.seed=-1"])


@pytest.mark.parametrize("guided", [True, False])
def test_a_second_stage_is_scored_on_the_fine_grid(guided, prior, fine, cts, tmp_path):
    main(with_prior("test", tmp_path, prior, f"--data.cts={cts / 'a.nii.gz'}", *ORBIT,
                    f"--model.super_resolution.file={fine}", f"--model.super_resolution.guided={guided}",
                    "--model.super_resolution.memory=1"))
    folder = tmp_path / "prior_only" / "a"
    found, said = nibabel.load(folder / "volume.nii.gz"), record(folder)
    assert found.shape == (32, 32, 32) and found.header.get_zooms() == (12.0, 12.0, 12.0)
    truth = prepare_ct(cts / "a.nii.gz", Grid.cube(32))
    scores = volume_metrics(torch.from_numpy(volume(folder).copy())[None, None],
                            HUWindow().to_hu(truth["volume"])[None])
    assert said["scores"]["psnr"] == pytest.approx(float(scores["psnr"]), rel=1e-3)
    assert said["settings"]["super_resolution"] == "fine.safetensors"
    assert said["settings"]["second"]["class"] == ("SplitGibbs" if guided else "PriorOnly")


def test_medsyns_second_stage_is_refused_before_anything_is_done_where_it_takes_too_much_memory(
        measured, tmp_path, capsys):
    base = write(tmp_path / "base" / "model_1.safetensors", entries(text_unet()))
    second = write(tmp_path / "second" / "model.safetensors", entries(super_resolution_unet())).parent
    said = refusal(capsys, main, with_prior("predict", tmp_path / "out", base, f"--data.xrays={measured}",
                                      f"--model.super_resolution.file={second}", "--model.super_resolution.memory=1"))
    assert "(256, 256, 256)" in said and "1 GiB are allowed" in said and "--model.super_resolution.memory " in said
    assert not (tmp_path / "out").exists()


def test_stages_in_each_others_place_are_one_sentence(prior, fine, measured, tmp_path, capsys):
    data = f"--data.xrays={measured}"
    said = refusal(capsys, main, with_prior("predict", tmp_path / "out", fine, data))
    assert "fine.safetensors' is a super-resolution stage, but a base prior" in said
    said = refusal(capsys, main, with_prior("predict", tmp_path / "out", prior, data,
                                      f"--model.super_resolution.file={prior}"))
    assert "is a base prior, but a super-resolution stage" in said
    said = refusal(capsys, main, sirt("predict", tmp_path / "out", data, f"--model.super_resolution.file={fine}"))
    assert "SIRT has none" in said


@pytest.mark.filterwarnings("default")
def test_a_prior_without_text_says_that_it_reads_no_report(prior, measured, tmp_path, capsys):
    main(with_prior("predict", tmp_path / "out", prior, f"--data.xrays={measured}"))
    said = capsys.readouterr().err
    assert said.count("trained without text") == 1
    assert record(tmp_path / "out" / "prior_only" / "anna")["report"] == ""


def test_a_prior_refuses_xrays_of_another_grid(prior):
    posterior = reconstructor(PriorOnly(iterations=1), prior)
    with pytest.raises(ValueError, match="16.*64.*use the prior's grid"):
        posterior.reconstruct(torch.ones(3, 24, 24), Projector(Grid.cube(64), BEAM))


@pytest.mark.parametrize("args, words", [
    ([], ["predict", "test", "ablate", "such as: predict --data.xrays"]),
    (["reconstruct"], ["'reconstruct'", "ablate"]),
    (["--data.xrays", "somewhere"], ["predict", "test", "ablate"]), (["predict"], ["needs data.xrays"]),
    (["test"], ["needs data.cts"]), (["ablate"], ["-c configs/ablate/"]),
    (["ablate", "--phantoms", "3"], ["-c configs/ablate/"])], ids=lambda value: " ".join(value)[:20])
def test_a_missing_command_or_input_says_what_to_give(args, words, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    said = refusal(capsys, main, args)
    assert all(word in said for word in words), said


@pytest.mark.parametrize("change, words", [
    (["--data.viewz=3"], ["data.viewz"]),
    (["--data.orbit.views=0"], ["one view"]),
    (["--data.orbit.views=some"], ["data.orbit.views", "some"]),
    (["--model.method.init_args.iteration=3"], ["iteration"]),
    (["--data.orbit.source_to_isocentre=2000"], ["isocentre"]),
    (["--config=nowhere.yaml"], ["nowhere.yaml"]),
    (["--model.method=srit"], ["no method 'srit'", "sirt", "phydict_fast", "phydict.posterior.DDS"]),
    (["--config={model: {method: 3}}"], ["model.method"]),
    (["--model.sampling.precision=half"], ["precision is auto, float32 or bfloat16, but 'half' was given"]),
], ids=lambda value: value[0] if value[0].startswith("--") else "")
def test_a_bad_argument_is_one_sentence(change, words, tmp_path, capsys):
    said = refusal(capsys, main, phantoms(tmp_path / "out", 1, *change))
    assert all(word in said for word in words), said
    assert not (tmp_path / "out").exists()


def test_a_config_file_names_its_method_and_is_told_of_one_that_is_none(measured, tmp_path, capsys):
    (tmp_path / "mine.yaml").write_text("model: {method: sirt, seed: 4}")
    args = ["predict", "-c", str(tmp_path / "mine.yaml"), "--model.method.init_args.iterations=2",
            f"--data.xrays={measured / 'anna'}", f"--model.out={tmp_path / 'out'}", "--trainer.accelerator=cpu"]
    main(args)
    settings = record(tmp_path / "out" / "sirt" / "anna")["settings"]
    assert settings["method"]["class"] == "SIRT" and settings["method"]["iterations"] == 2 and settings["seed"] == 4
    (tmp_path / "mine.yaml").write_text("model: {method: srit}")
    assert "no method 'srit'" in refusal(capsys, main, args)


def test_an_unknown_key_of_a_config_file_is_named(tmp_path, capsys):
    (tmp_path / "mine.yaml").write_text("model:\n  guidence: 2.0\n")
    args = phantoms(tmp_path / "out", 1, f"--config={tmp_path / 'mine.yaml'}")
    assert "model.guidence" in refusal(capsys, main, args)


def test_an_impossible_setting_is_named_without_the_parsers_noise(prior, tmp_path, capsys):
    said = refusal(capsys, main, ["test", "--model.method=phydict_fast", f"--model.prior={prior}",
                                  "--model.method.init_args.iterations=0"])
    assert "at least one iteration, but 0" in said and "Union" not in said


def test_an_output_folder_that_cannot_be_is_one_sentence(measured, tmp_path, capsys):
    (tmp_path / "file").write_text("mine")
    for out in (tmp_path / "file", tmp_path / "file" / "deeper", Path("/proc/phydict")):
        said = refusal(capsys, main, sirt("predict", out, f"--data.xrays={measured}"))
        assert str(out) in said and "model.out" in said
    assert (tmp_path / "file").read_text() == "mine"


def test_a_read_only_disk_is_one_sentence(measured, tmp_path, capsys, monkeypatch):
    def refuse(**_):
        raise OSError(30, "Read-only file system")

    monkeypatch.setattr("phydict.runtime.console.tempfile.TemporaryFile", refuse)
    said = refusal(capsys, main, sirt("predict", tmp_path / "out", f"--data.xrays={measured}"))
    assert "Read-only file system" in said and not (tmp_path / "out").exists()


def test_a_disk_that_fills_up_leaves_no_case_that_looks_finished(measured, tmp_path, capsys):
    args = sirt("predict", tmp_path, f"--data.xrays={measured}")
    with largest_file(50_000):
        said = refusal(capsys, main, args)
    assert "anna" in said and "could not be written" in said and "free some space" not in said  # the disk is not full
    assert names(tmp_path / "sirt") == []
    main(args)
    assert names(tmp_path / "sirt") == ["anna", "bert"]


@pytest.mark.filterwarnings("default")
def test_several_samples_leave_a_deviation_map_in_the_volumes_place(measured, prior, tmp_path):
    args = with_prior("predict", tmp_path, prior, f"--data.xrays={measured / 'anna'}", "--model.name=several")
    main([*args, "--model.sampling.samples=2"])
    folder = tmp_path / "several" / "anna"
    assert names(folder) == sorted([*FILES, "deviation.nii.gz"])
    image, ct = (nibabel.load(folder / name) for name in ("deviation.nii.gz", "volume.nii.gz"))
    assert image.shape == ct.shape and np.array_equal(image.affine, ct.affine)
    deviation = np.asarray(image.dataobj)
    assert deviation.min() >= 0 and deviation.max() > 1
    assert record(folder)["settings"]["samples"] == 2 and record(folder)["network_calls"] == 4


def test_samples_of_a_method_without_a_prior_are_refused(capsys, measured, tmp_path):
    assert "leave samples at 1" in refusal(capsys, main, sirt("predict", tmp_path, f"--data.xrays={measured}",
                                                        "--model.sampling.samples=3"))


def test_a_profile_shows_the_stages_of_every_case_and_changes_no_volume(measured, tmp_path, capsys):
    shown = []
    for out, more in (("plain", []), ("profiled", ["--profile"])):
        capsys.readouterr()
        main(sirt("predict", tmp_path / out, f"--data.xrays={measured}", *more))
        shown.append(capsys.readouterr().out)
    plain, profiled = shown
    assert "peak MiB" not in plain and profiled.count("peak MiB") == 2
    for words in ("anna: sirt", "bert: sirt", "fit to grid", "sample / projector", "write"):
        assert words in profiled
    for case in ("anna", "bert"):
        np.testing.assert_array_equal(*(volume(tmp_path / out / "sirt" / case) for out in ("plain", "profiled")))


def test_a_run_that_is_not_finite_ends_in_one_sentence_and_leaves_no_case(measured, tmp_path, capsys, monkeypatch):
    solve = SIRT.solve
    monkeypatch.setattr(SIRT, "solve", lambda self, *given: solve(self, *given) * float("nan"))
    said = refusal(capsys, main, sirt("predict", tmp_path, f"--data.xrays={measured / 'anna'}"))
    assert "not finite from step 3 of 3 on" in said and not (tmp_path / "sirt" / "anna").exists()


def test_the_record_says_whether_the_misfit_rose(measured, tmp_path, monkeypatch):
    solve = SIRT.solve

    def worse(self, A, y, on_step):
        density = solve(self, A, y, on_step)
        A.last_projection = 9 * y
        on_step()
        return 9 * density

    for name, change, expected in (("good", solve, None), ("bad", worse, 4)):
        monkeypatch.setattr(SIRT, "solve", change)
        main(sirt("predict", tmp_path / name, f"--data.xrays={measured / 'anna'}"))
        assert record(tmp_path / name / "sirt" / "anna")["diverged_at"] == expected


def test_a_projector_is_chosen_and_recorded_and_another_result_is_not_taken_for_its(measured, tmp_path, capsys):
    args = sirt("predict", tmp_path / "out", f"--data.xrays={measured / 'anna'}")
    main([*args, "--model.projector=siddon"])
    assert record(tmp_path / "out" / "sirt" / "anna")["settings"]["projector"] == "siddon"
    other = volume(tmp_path / "out" / "sirt" / "anna").copy()
    assert "other settings" in refusal(capsys, main, args)
    main([*args, "--model.overwrite=true"])
    assert "projector" not in record(tmp_path / "out" / "sirt" / "anna")["settings"]
    assert not np.array_equal(volume(tmp_path / "out" / "sirt" / "anna"), other)
    assert "model.projector is one of" in refusal(capsys, main, [*args, "--model.projector=lines"])
