"""`infer.py test`: X-rays simulated of CTs, and the scores of what is reconstructed."""

from __future__ import annotations

import csv
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import nibabel
import numpy as np
import pytest
import torch
from command_lines import refusal
from page import made

import phydict
from inference.runs import BEAM, ORBIT, ROOT, names, phantoms, record, sirt, stamp, volume, with_prior, write_ct
from phydict.cli.infer import main
from phydict.datasets import body_mask, phantom_case, prepare_ct
from phydict.evaluation import volume_metrics
from phydict.grid import Grid
from phydict.inference import ReconstructionData
from phydict.inference.protocols import PROTOCOLS
from phydict.inference.results import score_table
from phydict.inference.scoring import Scoring
from phydict.methods import reconstruct
from phydict.posterior import PriorOnly
from phydict.runtime.precision import instruction_set
from phydict.units import MU_WATER, HUWindow
from phydict.xray import Ideal, Polychromatic, Projector


def test_a_table_holds_the_cases_of_its_run_alone(cts, tmp_path):
    coarse = [*ORBIT, "--model.grid=32"]
    main(sirt("test", tmp_path, f"--data.cts={cts}", *coarse))
    (tmp_path / "only.txt").write_text("b\n")
    main(sirt("test", tmp_path, f"--data.cts={cts}", *coarse, f"--data.only={tmp_path / 'only.txt'}"))
    with (tmp_path / "sirt" / "results.csv").open() as file:
        assert [row["case"] for row in csv.DictReader(file)] == ["b"]


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
    main(sirt("test", tmp_path / "out", f"--data.cts={tmp_path / 'cts'}", *ORBIT, "--model.grid=32"))
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


@pytest.mark.filterwarnings("default::UserWarning")
def test_machines_read_warnings_and_failed_cases_as_json_too(tmp_path, capsys):
    write_ct(tmp_path / "cts" / "air.nii.gz", 0, change=DOUBTFUL["air"])
    (tmp_path / "cts" / "cut.nii.gz").write_bytes((tmp_path / "cts" / "air.nii.gz").read_bytes()[:200])
    with pytest.raises(SystemExit):
        main(sirt("test", tmp_path / "out", f"--data.cts={tmp_path / 'cts'}", *ORBIT, "--json_lines"))
    *events, last = map(json.loads, capsys.readouterr().err.splitlines())
    assert {"begin", "case", "warning", "error"} <= {event["event"] for event in events}
    assert all("cut" in event["text"] for event in events if event["event"] == "error")
    assert last["event"] == "error" and "1 of 2 cases were not reconstructed (cut)" in last["text"]
    assert "Not reconstructed, and so not in the means: cut." in (tmp_path / "out" / "sirt" / "results.md").read_text()


def test_a_good_case_has_no_mark(tmp_path):
    main([*phantoms(tmp_path, 1), "--model.method.init_args.iterations=60"])
    assert record(tmp_path / "sirt" / "phantom-1000000")["warnings"] == []
    assert "warned" not in (tmp_path / "sirt" / "results.md").read_text()


def test_a_second_test_scores_nothing_twice_and_shows_one_table(scored, capsys):
    before = stamp(scored / "phantom-1000000"), (scored / "results.csv").read_text()
    main(phantoms(scored.parent, 2))
    assert (stamp(scored / "phantom-1000000"), (scored / "results.csv").read_text()) == before
    out = " ".join(capsys.readouterr().out.split())
    assert "n = 2 cases" in out and "Test metric" not in out and "Warning" not in out


def test_a_test_of_fewer_cases_says_how_many_of_the_folder_its_table_leaves_out(scored, tmp_path, capsys):
    shutil.copytree(scored, tmp_path / "sirt")
    main(phantoms(tmp_path, 2))
    assert "left out" not in capsys.readouterr().err
    main(phantoms(tmp_path, 1))
    assert "hold this run's cases, and 1 more that are finished in" in capsys.readouterr().err
    main(phantoms(tmp_path, 2))
    assert (tmp_path / "sirt" / "results.csv").read_text() == (scored / "results.csv").read_text()


def test_a_case_depends_on_its_id_and_the_seed_alone(cts, tmp_path):
    coarse = [*ORBIT, "--model.grid=32"]
    main(sirt("test", tmp_path / "both", f"--data.cts={cts}", *coarse))
    main(sirt("test", tmp_path / "one", f"--data.cts={cts / 'b.nii.gz'}", *coarse))
    main(sirt("test", tmp_path / "seed", f"--data.cts={cts / 'b.nii.gz'}", *coarse, "--model.seed=1"))
    both, one, seed = (volume(tmp_path / name / "sirt" / "b") for name in ("both", "one", "seed"))
    np.testing.assert_array_equal(both, one)
    assert not np.array_equal(one, seed)  # other noise in the X-rays
    assert "ssim_lung" not in record(tmp_path / "one" / "sirt" / "b")["scores"]  # no lungs, no score of them


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
    named = f"Files: phydict_fast with {prior.name} (CRC-32 {said['settings']['prior_crc32']:08x})."
    assert named in (tmp_path / "phydict_fast" / "results.md").read_text()
    assert said["network_calls"] == 10 and said["grid"]["shape"] == [16, 16, 16] and said["report"] == ""
    assert said["settings"]["prior"] == "tiny.safetensors" and said["settings"]["prior_crc32"]
    assert said["misfit"] < 0.5


def test_the_simulated_orbit_is_the_one_asked_for(tmp_path, capsys):
    def arguments(name: str, *more: str) -> list[str]:
        return phantoms(tmp_path / name, 1, "--model.grid=32", *more)

    def found(name: str, *more: str) -> Path:
        main(arguments(name, *more))
        return tmp_path / name / "sirt" / "phantom-1000000"

    own = volume(found("own"))
    assert len(record(found("five", "--data.orbit.views=5"))["misfit_per_view"]) == 5
    np.testing.assert_array_equal(volume(found("same", "--data.simulation_voxels=32")), own)
    assert not np.array_equal(volume(found("finer", "--data.simulation_voxels=64")), own)
    assert "multiple" in refusal(capsys, main, arguments("coarser", "--data.simulation_voxels=48"))


OPTIMISTIC = "the voxels that are reconstructed, which is optimistic"


@pytest.mark.parametrize("given, grid, places", [
    ({}, None, OPTIMISTIC), ({"protocol": "phydict"}, None, OPTIMISTIC), ({"protocol": "x2ct"}, None, "the protocol's"),
    ({}, Grid.cube(128), OPTIMISTIC), ({}, Grid.box(32, 96.0, (60.0, 0.0, 0.0)), "128^3 voxels of 3 mm"),
    ({"protocol": "phydict"}, Grid.box(16, 96.0), "64^3 voxels of 6 mm"),
    ({"simulation_voxels": 192}, Grid.box(16, 96.0), "192^3 voxels"),
    ({"protocol": "x2ct", "simulation_voxels": 256}, None, "256^3 voxels")])
def test_a_table_names_the_voxels_that_its_x_rays_were_made_of(given, grid, places):
    settings = {"seed": 0, "data": ReconstructionData(cts="phantom", **given).settings("test")} | (
        {"grid": grid.to_dict()} if grid else {})
    finished = made.record("anna", "sirt", settings=settings)
    table = score_table([finished], PROTOCOLS.get(given.get("protocol")), {})
    (said,) = (note for note in table.notes if note.startswith("X-rays: "))
    assert f"; made on {places}" in said and said.endswith("; seed 0.")


def test_a_score_that_is_not_finite_leaves_strict_json_and_the_same_table_again(tmp_path, monkeypatch):
    whole = Scoring.scores
    monkeypatch.setattr(Scoring, "scores", lambda *given: whole(*given) | {"psnr": float("inf"), "ssim": float("nan")})
    tables = []
    for _ in range(2):
        main(phantoms(tmp_path, 1))
        tables.append([(tmp_path / "sirt" / name).read_text() for name in ("results.md", "results.csv")])
    text = (tmp_path / "sirt" / "phantom-1000000" / "reconstruction.json").read_text()
    scores = json.loads(text, parse_constant=lambda name: pytest.fail(f"{name} is not JSON"))["scores"]
    assert (scores["psnr"], scores["ssim"]) == (None, None) and scores["mae_hu"] > 0 and tables[0] == tables[1]


def test_simulated_xrays_are_taken_where_a_geometry_file_says(scored, tmp_path, capsys):
    other = ["test", "--data.cts=phantom", "--data.phantoms=1", f"--model.out={tmp_path}", "--model.method=sirt",
             "--model.method.init_args.iterations=3", "--model.grid=32", "--data.geometry=biplanar"]
    main(other)
    assert len(record(tmp_path / "sirt" / "phantom-1000000")["misfit_per_view"]) == 2
    assert "leave one out" in refusal(capsys, main, [*other, "--data.orbit.views=4"])
    assert "biplanar" in refusal(capsys, main, [*other[:-1], "--data.geometry=nowhere"])


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


@pytest.mark.slow
def test_two_processes_split_the_cases_and_agree_with_one(scored, tmp_path):
    run = subprocess.run([sys.executable, str(ROOT / "infer.py"), *phantoms(tmp_path, 3, "--trainer.devices=2")],
                         capture_output=True, text=True, env=os.environ | {"OMP_NUM_THREADS": "1"}, timeout=150)
    assert run.returncode == 0, run.stderr[-2000:]
    with (tmp_path / "sirt" / "results.csv").open() as file:
        assert [row["case"][-1] for row in csv.DictReader(file)] == ["0", "1", "2"]
    assert [name for name in names(tmp_path / "sirt") if name.startswith(".")] == []
    for case in ("phantom-1000000", "phantom-1000001"):
        np.testing.assert_array_equal(volume(tmp_path / "sirt" / case), volume(scored / case))
    said = " ".join(run.stdout.split())
    assert [said.count(once) for once in ("results in", "n = 3 cases", "page: ")] == [1, 1, 1]


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
    crcs = [f"{said['settings'][f'{role}_crc32']:08x}" for role in ("prior", "super_resolution")]
    named = f"{prior.name} (CRC-32 {crcs[0]}) and fine.safetensors (CRC-32 {crcs[1]})."
    assert named.replace("_", "\\_") in (folder.parent / "results.md").read_text()
    assert said["settings"]["second"]["class"] == ("SplitGibbs" if guided else "PriorOnly")
