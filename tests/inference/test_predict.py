"""`infer.py predict`: what it writes of X-rays."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import nibabel
import numpy as np
import pytest
import torch
from command_lines import refusal
from dicom_files import orbit_tags, write_dicom
from PIL import Image

from inference.runs import BEAM, FILES, ROOT, names, record, sirt, volume, with_prior, xrays
from phydict.baselines import SIRT
from phydict.cli.infer import main
from phydict.datasets import load_xrays, save_xrays
from phydict.grid import Grid
from phydict.inference import ReconstructionData, ReconstructionTask
from phydict.methods import CORRECTIONS, METHODS, reconstruct
from phydict.posterior import PriorOnly
from phydict.prior import load_correction, save_stage
from phydict.runtime.precision import instruction_set
from phydict.xray import ConeBeam, Projector
from phydict.xray.geometry_files import write_beam


def test_the_page_knows_the_aspect_of_the_detector_s_pixels(tmp_path):
    xrays(tmp_path / "anna", ConeBeam.orbit(3, 1020.0, 740.0, (12, 24), (48.0, 24.0)))
    main(sirt("predict", tmp_path / "out", f"--data.xrays={tmp_path / 'anna'}"))
    assert '"pixel": 2.0, ' in (tmp_path / "out" / "sirt" / "anna" / "view.js").read_text()


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


def test_one_folder_of_xrays_is_a_case(measured, tmp_path, monkeypatch):
    monkeypatch.chdir(measured / "bert")
    main(sirt("predict", tmp_path, "--data.xrays=../bert"))
    assert names(tmp_path / "sirt") == ["bert"]


def test_a_scene_far_smaller_than_a_chest_is_drawn_and_reconstructed_as_by_the_library(tmp_path, capsys):
    grid, beam = Grid.cube(8, 80.0), ConeBeam.orbit(3, 300.0, 150.0, (12, 12), 16.0)
    mu = torch.zeros(1, 1, *grid.shape)
    mu[..., 2:6, 2:6, 1:5] = 0.03
    save_xrays(tmp_path / "case", Projector(grid, beam, full_detector=True)(mu)[0], beam)
    arguments = sirt("predict", tmp_path / "out", f"--data.xrays={tmp_path / 'case'}", "--model.grid.voxels=8",
                     "--model.grid.side=80")
    main([*arguments, "--dry_run"])
    main(arguments)
    assert "thorax" not in capsys.readouterr().err
    case = load_xrays(tmp_path / "case")
    expected = reconstruct(case["xrays"], case["beam"], method=SIRT(3), grid=grid).volume.numpy()
    np.testing.assert_allclose(volume(tmp_path / "out" / "sirt" / "case"), expected, atol=1e-3)


def test_the_record_names_the_methods_publication(measured, tmp_path):
    main(sirt("predict", tmp_path, f"--data.xrays={measured / 'anna'}"))
    file = tmp_path / "sirt" / "anna" / "reconstruction.json"
    assert "10.1109/TMI.2008.923696" in json.loads(file.read_text())["citation"]


@pytest.mark.filterwarnings("default")
def test_inverted_line_integrals_are_warned_of_and_marked(measured, tmp_path, capsys):
    case = load_xrays(measured / "anna")
    save_xrays(tmp_path / "case", case["xrays"].max() - case["xrays"], case["beam"])
    for args in ((), ("--dry_run",)):
        main(sirt("predict", tmp_path / "out", f"--data.xrays={tmp_path / 'case'}", *args))
        assert capsys.readouterr().err.count("as inverted images are") == 1
    assert "inverted" in record(tmp_path / "out" / "sirt" / "case")["warnings"][0]


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


@pytest.mark.slow
@pytest.mark.filterwarnings("default")
def test_x_rays_or_cts_alone_are_enough(tmp_path, monkeypatch):
    example = ROOT / "data" / "example"
    monkeypatch.chdir(tmp_path)
    main(["predict", f"--data.xrays={example / 'xrays'}"])
    main(["test", f"--data.cts={example / 'truth.nii.gz'}"])
    assert volume(Path("runs/reconstructions/phydict_learned/xrays")).shape == (128, 128, 128)
    assert list(tmp_path.glob("runs/*/phydict_learned/results.csv"))


def test_more_processes_than_cases_that_are_left_are_refused(measured):
    data = ReconstructionData(str(measured))
    data.trainer = SimpleNamespace(
        world_size=2, strategy=SimpleNamespace(barrier=lambda: None),
        lightning_module=SimpleNamespace(unfinished=lambda sources: [name for name in sources if name == "bert"]))
    with pytest.raises(ValueError, match="2 processes .* there is 1 to reconstruct: give --trainer.devices 1"):
        data.predict_dataloader()
    data.trainer.world_size = 1
    assert [case["id"] for case in data.predict_dataloader()] == ["bert"]


@pytest.mark.slow
def test_two_processes_predict_every_case_once(measured, tmp_path):
    args = sirt("predict", tmp_path, f"--data.xrays={measured}", "--trainer.devices=2")
    run = subprocess.run([sys.executable, str(ROOT / "infer.py"), *args], capture_output=True, text=True, timeout=150)
    assert run.returncode == 0, run.stderr[-2000:]
    assert names(tmp_path / "sirt") == ["anna", "bert"]
    assert sorted(line.split(":")[0] for line in run.stderr.splitlines() if "misfit" in line) == ["anna", "bert"]


@pytest.mark.filterwarnings("default")
def test_a_prior_without_text_says_that_it_reads_no_report(prior, measured, tmp_path, capsys):
    main(with_prior("predict", tmp_path / "out", prior, f"--data.xrays={measured}"))
    said = capsys.readouterr().err
    assert said.count("trained without text") == 1
    assert record(tmp_path / "out" / "prior_only" / "anna")["report"] == ""


def test_a_config_file_names_its_method_and_is_told_of_one_that_is_none(measured, tmp_path, capsys):
    (tmp_path / "mine.yaml").write_text("model: {method: sirt, seed: 4}")
    args = ["predict", "-c", str(tmp_path / "mine.yaml"), "--model.method.init_args.iterations=2",
            f"--data.xrays={measured / 'anna'}", f"--model.out={tmp_path / 'out'}", "--trainer.accelerator=cpu"]
    main(args)
    settings = record(tmp_path / "out" / "sirt" / "anna")["settings"]
    assert settings["method"]["class"] == "SIRT" and settings["method"]["iterations"] == 2 and settings["seed"] == 4
    (tmp_path / "mine.yaml").write_text("model: {method: srit}")
    assert "no method 'srit'" in refusal(capsys, main, args)


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


def test_cases_refined_by_another_network_are_others(tmp_path, monkeypatch):
    def settings() -> dict:
        return ReconstructionTask(METHODS["phydict_learned"], grid=128, out=str(tmp_path / "out")).settings

    shipped_one = settings()
    save_stage(load_correction(), tmp_path / "other.safetensors", {"steps": 1})
    monkeypatch.setitem(CORRECTIONS, 3.0, tmp_path / "other.safetensors")
    other = settings()
    assert shipped_one.pop("correction_crc32") != other.pop("correction_crc32") and shipped_one == other
