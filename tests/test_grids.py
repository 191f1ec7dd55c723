"""Any voxels on the command line: predict, test and ablate write them where they belong."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import nibabel
import numpy as np
import pytest
import torch
import yaml
from command_lines import refusal
from prior.tiny import tiny_prior

from phydict.baselines import SIRT
from phydict.cli.infer import main
from phydict.datasets import phantom_case, save_xrays
from phydict.evaluation import read_csv
from phydict.grid import Box, Grid
from phydict.inference import ReconstructionTask
from phydict.inference.settings import Sampling
from phydict.inference.voxels import cut_out, placed, whole
from phydict.prior import save_prior
from phydict.units import HUWindow
from phydict.xray import ConeBeam, Projector

BEAM = ConeBeam.orbit(3, 1020.0, 740.0, (24, 24), 24.0)
ORBIT = ["--data.orbit.views=3", "--data.orbit.detector=[24,24]", "--data.orbit.pixel=[24,24]"]
REGION = Grid.box((15, 12, 9), (180.0, 120.0, 90.0), (40.0, -10.0, 20.0))
BOX = ["--model.grid.voxels=[15,12,9]", "--model.grid.side=[180,120,90]", "--model.grid.centre=[40,-10,20]"]


@pytest.fixture(scope="module")
def prior(tmp_path_factory) -> Path:
    file = tmp_path_factory.mktemp("prior") / "tiny.safetensors"
    save_prior(tiny_prior(False), file)
    return file


@pytest.fixture(scope="module")
def measured(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("measured") / "anna"
    truth = HUWindow().to_mu(phantom_case(1, Grid.cube(32))["volume"])
    save_xrays(folder, Projector(Grid.cube(32), BEAM, full_detector=True)(truth[None])[0], BEAM)
    return folder


def arguments(command: str, out: Path, prior: Path, *more: str, method: str = "prior_only") -> list[str]:
    return [command, f"--model.method={method}", "--model.method.init_args.iterations=2", f"--model.prior={prior}",
            f"--model.out={out}", "--trainer.accelerator=cpu", *more]


@pytest.mark.filterwarnings("always:no network has learnt")
@pytest.mark.parametrize("method", ["prior_only", "sirt"])
def test_predict_writes_any_box_with_its_affine_and_the_coarse_volume_on_request(measured, prior, tmp_path, capsys,
                                                                                 method):
    main(arguments("predict", tmp_path, prior, f"--data.xrays={measured}", *BOX, "--model.grid.keep_coarse=true",
                   method=method))
    folder = tmp_path / method / "anna"
    fine, coarse = (nibabel.load(folder / name) for name in ("volume.nii.gz", "coarse.nii.gz"))
    np.testing.assert_allclose(fine.affine, REGION.affine)
    assert fine.shape == (15, 12, 9) and coarse.shape == ((16,) * 3 if method == "prior_only" else (64,) * 3)
    np.testing.assert_allclose(coarse.affine, Grid.cube(coarse.shape[0]).affine)
    record = json.loads((folder / "reconstruction.json").read_text())
    said = record["settings"]
    assert Grid(**said["grid"]).same_as(REGION) and ("refinement" in said) == (method == "prior_only")
    told = capsys.readouterr().err.count(" to 15 x 12 x 9 voxels here")
    assert told == (method == "prior_only") and not any("learnt" in words for words in record["warnings"])


def test_hu_are_those_of_the_water_that_the_geometry_file_states(measured, prior, tmp_path):
    volumes = []
    for water in (0.02, 0.025):
        folder = tmp_path / str(water) / "anna"
        shutil.copytree(measured, folder)
        for file in folder.glob("*.npy"):
            np.save(file, np.load(file) * np.float32(water / 0.02))
        (folder / "geometry.yaml").write_text((folder / "geometry.yaml").read_text() + f"mu_water: {water}\n")
        main(arguments("predict", out := tmp_path / f"out {water}", prior, f"--data.xrays={folder}", method="sirt"))
        assert json.loads((out / "sirt/anna/reconstruction.json").read_text())["mu_water"] == water
        volumes.append(nibabel.load(out / "sirt/anna/volume.nii.gz").get_fdata())
    np.testing.assert_allclose(*volumes, atol=0.1)


def test_one_batch_of_two_is_a_whole_number_and_what_it_leaves_out_is_named(measured, prior, tmp_path, capsys):
    for name in ("a", "b"):
        shutil.copytree(measured, tmp_path / "two" / name)
    with pytest.raises(SystemExit):
        main(arguments("predict", tmp_path / "out", prior, f"--data.xrays={tmp_path / 'two'}",
                       "--trainer.limit_predict_batches=1", method="sirt"))
    assert "1 of 2 cases were not reconstructed" in capsys.readouterr().err


def test_the_default_method_predicts_on_128_voxels_unless_a_grid_or_another_network_is_given(prior):
    assert ReconstructionTask().predicted.grid().same_as(Grid.cube(128))
    assert ReconstructionTask().voxels.result.same_as(Grid.cube(64))  # what test scores
    for given in ({"grid": 64}, {"prior": str(prior)}, {"method": SIRT()}, {"sampling": Sampling(samples=2)}):
        assert ReconstructionTask(**given).predicted is None


@pytest.mark.filterwarnings("always:no network has learnt")
@pytest.mark.parametrize("number", ["--model.grid=24", "-c={}/own.yaml"])
@pytest.mark.parametrize("order", [1, -1])
def test_a_number_of_voxels_goes_with_the_other_settings_of_a_box_in_any_order(measured, prior, tmp_path, number,
                                                                               order):
    (tmp_path / "own.yaml").write_text("model: {grid: 24}")
    given = [number.format(tmp_path), "--model.grid.keep_coarse=true", "--model.grid.side=288"][::order]
    main(arguments("predict", tmp_path, prior, f"--data.xrays={measured}", *given))
    fine, coarse = (nibabel.load(tmp_path / "prior_only" / "anna" / f"{name}.nii.gz") for name in ("volume", "coarse"))
    np.testing.assert_allclose(fine.affine, Grid.cube(24, 288.0).affine)
    assert fine.shape == (24,) * 3 and coarse.shape == (16,) * 3


@pytest.mark.filterwarnings("always:there is no coarse volume")
def test_the_coarse_volume_of_the_default_voxels_is_kept_on_request_where_there_is_one(measured, prior, tmp_path,
                                                                                       capsys):
    kept = ReconstructionTask(grid=Box(keep_coarse=True))
    assert kept.predicted == Box(128, keep_coarse=True) and kept.voxels.result.same_as(Grid.cube(64))
    alone = "--model.grid.keep_coarse=true"
    for more in [], [f"--model.prior={prior}"]:
        assert "give model.grid.voxels" in refusal(capsys, main, [
            "test", "--trainer.accelerator=cpu", "--data.cts=phantom", f"--model.out={tmp_path}", alone, *more])
    main(arguments("predict", tmp_path, prior, f"--data.xrays={measured}", "--model.grid=16", alone, method="sirt"))
    assert "there is no coarse volume to keep: sirt works on the given voxels" in capsys.readouterr().err


def test_another_grid_is_another_setting(measured, prior, tmp_path, capsys):
    main(arguments("predict", tmp_path, prior, f"--data.xrays={measured}", "--model.grid=24"))
    assert not (tmp_path / "prior_only" / "anna" / "coarse.nii.gz").exists()
    said = refusal(capsys, main, arguments("predict", tmp_path, prior, f"--data.xrays={measured}", "--model.grid=20"))
    assert "other settings" in said


def test_test_and_ablate_score_a_region_alike_inside_its_box(prior, tmp_path):
    main(arguments("test", tmp_path, prior, "--data.cts=phantom", "--data.phantoms=1", *ORBIT, *BOX,
                   "--model.sampling.with_report=false"))
    (row,) = read_csv(tmp_path / "prior_only" / "results.csv")
    (case,) = (path for path in (tmp_path / "prior_only").iterdir() if path.is_dir())
    np.testing.assert_allclose(nibabel.load(case / "volume.nii.gz").affine, REGION.affine)
    spec = {"phantoms": 1, "out": str(tmp_path / "ablate"), "methods": {"plain": {"of": "prior_only", "refine": False}},
            "base": {"voxels": [15, 12, 9], "side": [180, 120, 90], "centre": [40, -10, 20], "views": 3,
                     "detector": 24, "pixel": 24, "method.iterations": 2, "prior": str(prior), "report": False},
            "axes": {"method": ["prior_only", "plain", "sirt"]}}
    (tmp_path / "spec.yaml").write_text(yaml.safe_dump(spec))
    main(["ablate", "-c", str(tmp_path / "spec.yaml"), "--device", "cpu"])
    rows = {own["method"]: own for own in read_csv(tmp_path / "ablate" / "results.csv")}
    assert rows["prior_only"]["psnr"] == pytest.approx(row["psnr"], rel=1e-4)
    assert rows["prior_only"]["misfit"] < rows["plain"]["misfit"] and rows["sirt"]["status"] == "ok"
    assert {own["grid"] for own in rows.values()} == {"15x12x9"}


def test_more_voxels_than_memory_are_refused_before_anything_is_written(measured, prior, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("os.sysconf", {"SC_PAGE_SIZE": 4096, "SC_PHYS_PAGES": 2**18}.__getitem__)  # 1 GiB
    said = refusal(capsys, main, arguments("predict", tmp_path / "out", prior, f"--data.xrays={measured}",
                                           "--model.grid=300"))
    assert "300 x 300 x 300 voxels" in said and "GiB" in said and not (tmp_path / "out").exists()


def test_xrays_of_a_region_are_those_of_the_whole_chest():
    assert whole(Grid.cube(96)).same_as(Grid.cube(96)) and whole(Grid.cube(80, 500.0)).same_as(Grid.cube(80, 500.0))
    assert whole(REGION).same_as(Grid.cube(64)) and whole(Grid.box(64, 192.0)).same_as(Grid.cube(128))
    assert whole(Grid.box(100, 100.0)).same_as(Grid.cube(256))


def test_what_is_cut_out_lies_where_it_lay_in_the_ct():
    scene, window = Grid.cube(16), HUWindow()
    box = Grid.box((4, 5, 3), (96.0, 120.0, 72.0), (24.0, 12.0, -36.0))  # whole voxels of the scene
    affine = np.diag([24.0, 24.0, 24.0, 1.0])
    affine[:3, 3] = 7.0, -300.0, 1100.0
    place = torch.linspace(-0.3, 0.3, 16)
    ramp = (place[:, None, None] + 0.5 * place[:, None] - place)[None]  # which averages of neighbours leave as it is
    case = {"volume": ramp, "masks": 0.5 + ramp.expand(3, -1, -1, -1) / 2, "affine": torch.from_numpy(affine)}
    found = cut_out(case, scene, box, window)
    part = (slice(None), slice(7, 11), slice(6, 11), slice(5, 8))
    torch.testing.assert_close(found["volume"], case["volume"][part], atol=1e-5, rtol=0)
    torch.testing.assert_close(found["masks"], case["masks"][part], atol=1e-5, rtol=0)
    fine = torch.nn.functional.interpolate(ramp[None], 64, mode="trilinear")[0]
    torch.testing.assert_close(cut_out(case | {"fine": fine}, scene, box, window)["volume"], found["volume"],
                               atol=1e-5, rtol=0)
    np.testing.assert_allclose(found["affine"][:3, 3], affine[:3, :3] @ [7, 6, 5] + affine[:3, 3])
    np.testing.assert_allclose(placed(box, box, found["affine"].numpy()).affine, found["affine"])
