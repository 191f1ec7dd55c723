"""Rivals as methods: their file gives them back, and what they were not trained for is refused in a sentence."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
import yaml
from command_lines import refusal
from prior.tiny import tiny_prior
from scenes import WINDOW, block

from phydict.cli.infer import main as infer
from phydict.datasets import phantom_case
from phydict.datasets.phantoms.cached import HELD_OUT_PHANTOM
from phydict.evaluation import read_csv
from phydict.grid import Grid
from phydict.inference import ReconstructionTask
from phydict.inference.settings import Sampling
from phydict.methods import METHODS, reconstruct, reconstructor
from phydict.prior import load_prior, save_prior, save_stage
from phydict.rivals import LiftedNetwork, Rival, RivalAnswer, TrainedRival, load_rival
from phydict.units import MU_WATER, HUWindow, hu_to_mu
from phydict.xray import ConeBeam, Projector
from rivals.tiny_rivals import GRID, tiny_lifted, tiny_x2ct

ORBIT = ConeBeam.orbit(3, 1020, 740, (28, 28), 20.0)


def xrays(beam: ConeBeam = ORBIT) -> torch.Tensor:
    return Projector(GRID, beam, full_detector=True)(WINDOW.to_mu(block()))[0]


@pytest.fixture
def file(tmp_path) -> str:
    save_stage(tiny_lifted(), tmp_path / "rival.safetensors", dtype=torch.float32)
    return str(tmp_path / "rival.safetensors")


def test_a_rivals_file_gives_it_back(file):
    found = reconstruct(xrays(), ORBIT, method=TrainedRival(file, "float32"), grid=GRID)
    again = reconstruct(xrays(), ORBIT, method=RivalAnswer(tiny_lifted(), precision="float32"), grid=GRID)
    assert torch.equal(found.volume, again.volume) and found.network_calls == 1 and found.precision == "float32"
    assert -1000 <= found.volume.min() < found.volume.max() <= 600


def test_the_command_line_takes_a_rivals_file(file, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    args = ["test", "--data.cts=phantom", "--data.phantoms=1", "--data.orbit.views=2", "--model.out=out",
            "--model.method=phydict.rivals.TrainedRival", f"--model.method.init_args.file={file}",
            "--model.name=lifted"]
    infer(args)
    assert [row["grid"] for row in read_csv(tmp_path / "out" / "lifted" / "results.csv")] == ["16x16x16"]
    assert f"Files: lifted with {Path(file).name} (CRC-32 " in (tmp_path / "out" / "lifted" / "results.md").read_text()
    infer([*args, "--model.grid=24", "--model.overwrite=true"])
    assert [row["grid"] for row in read_csv(tmp_path / "out" / "lifted" / "results.csv")] == ["24x24x24"]


def test_the_shipped_rival_is_found_from_any_folder_and_has_learnt_chests(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    grid, beam = Grid.cube(64), ConeBeam.orbit(2, 1020, 740, (112, 112), 5.0)
    truth = HUWindow().to_hu(phantom_case(HELD_OUT_PHANTOM, grid, HUWindow())["volume"])[0]
    y = Projector(grid, beam, full_detector=True)(hu_to_mu(truth)[None, None])[0]
    errors = [(reconstruct(y, beam, method=method).volume - truth).square().mean() for method in (
        TrainedRival("data/rivals/lifted_64.safetensors"), METHODS["cgls"])]
    assert errors[0] < errors[1] / 2


def test_hu_do_not_depend_on_what_water_attenuates(file):
    method = TrainedRival(file, "float32")
    doubled = reconstruct(2 * xrays(), ORBIT, method=replace(method, mu_water=2 * MU_WATER), grid=GRID)
    torch.testing.assert_close(doubled.volume, reconstruct(xrays(), ORBIT, method=method, grid=GRID).volume, atol=0.05,
                               rtol=0)


def test_display_values_give_the_same_volume_for_any_gain_and_offset(file):
    method = TrainedRival(file, "float32")
    one, other = (reconstruct(gain * xrays() + 0.1, ORBIT, method=method, display=True, grid=GRID)
                  for gain in (1.0, 3.0))
    torch.testing.assert_close(one.volume, other.volume, atol=0.5, rtol=0)


def test_other_weights_are_another_method(file, tmp_path):
    save_stage(tiny_lifted(seed=1), tmp_path / "other.safetensors", dtype=torch.float32)
    other = TrainedRival(str(tmp_path / "other.safetensors"))
    assert TrainedRival(file).weights_crc32 != other.weights_crc32


def test_a_file_is_read_anew_when_it_is_replaced(file):
    before = reconstruct(xrays(), ORBIT, method=TrainedRival(file, "float32"), grid=GRID).volume
    save_stage(tiny_lifted(seed=1), file, dtype=torch.float32)
    after = reconstruct(xrays(), ORBIT, method=TrainedRival(file, "float32"), grid=GRID).volume
    assert not torch.equal(before, after)


def test_what_a_rival_is_not_for_is_refused(file, tmp_path):
    with pytest.raises(ValueError, match=r"trained on \(16, 16, 16\) voxels"):
        TrainedRival(file).reconstruct(xrays(), Projector(Grid.cube(32), ORBIT, full_detector=True))
    with pytest.raises(ValueError, match="no file was given"):
        reconstruct(xrays(), ORBIT, method=TrainedRival(), grid=GRID)
    with pytest.raises(ValueError, match="there is no rival's file"):
        TrainedRival(str(tmp_path / "nowhere.safetensors"))
    with pytest.raises(ValueError, match="not bound to one geometry"):
        Rival(LiftedNetwork(), Grid.cube(64), WINDOW, ORBIT)
    with pytest.raises(ValueError, match="divisible by 8"):
        Rival(LiftedNetwork(), Grid.cube(20), WINDOW)
    with pytest.raises(ValueError, match="precision"):
        TrainedRival(file, "half")


def test_other_voxels_are_refined_from_the_rivals_own(file):
    for method in (TrainedRival(file), RivalAnswer(tiny_lifted())):
        found = reconstruct(xrays(), ORBIT, method=method, grid=Grid.cube(32))
        assert found.volume.shape == (32, 32, 32) and found.coarse.grid.same_as(GRID)
        assert found.misfit < found.coarse.misfit


@pytest.mark.filterwarnings("ignore:no volume")
def test_a_patient_who_goes_on_gives_a_rival_no_more_voxels_than_its_own(file):
    beam = replace(ORBIT, continued=True)
    read, made = (reconstruct(xrays(beam), beam, method=method, grid=GRID)
                  for method in (TrainedRival(file, "float32"), RivalAnswer(tiny_lifted(), precision="float32")))
    assert made.grid.same_as(GRID) and torch.equal(read.volume, made.volume)


def test_the_precision_that_is_asked_for_is_a_ready_rival_s(file):
    for method in (TrainedRival(file), RivalAnswer(tiny_lifted())):
        assert reconstructor(method, precision="float32") == replace(method, precision="float32")
        assert reconstructor(method) == method


def test_cases_of_another_precision_are_others_and_double_precision_is_taken(file, tmp_path):
    tasks = [ReconstructionTask(TrainedRival(file), out=str(tmp_path), sampling=Sampling(precision=precision))
             for precision in ("auto", "float32", "bfloat16")]
    assert len({str(task.settings) for task in tasks}) == 3
    ready, A = RivalAnswer(tiny_lifted()), Projector(GRID, ORBIT)
    found = [ready.reconstruct(y, A).volume for y in (xrays(), xrays().double())]
    torch.testing.assert_close(*found, check_dtype=False, atol=0.5, rtol=0)


def test_a_prior_is_no_rival_and_a_rival_no_prior(file, tmp_path):
    save_prior(tiny_prior(), tmp_path / "prior.safetensors")
    with pytest.raises(ValueError, match="is a base prior, but a rival is needed"):
        load_rival(tmp_path / "prior.safetensors")
    with pytest.raises(ValueError, match="is a rival, but a base prior is needed"):
        load_prior(file)
    (tmp_path / "cut.safetensors").write_bytes(open(file, "rb").read()[:-100])
    with pytest.raises(ValueError, match="truncated"):
        load_rival(tmp_path / "cut.safetensors")


@pytest.mark.parametrize("training, words", [
    ({"steps": 790, "samples": 1580}, "790 steps, 1,580 samples"), ({}, "steps not stated"), (None, "steps not stated"),
    ({"steps": "many"}, "steps not stated")])
def test_a_file_tells_for_which_views_and_how_long_it_was_trained(tmp_path, training, words):
    for made, views in ((tiny_lifted(), "any K"), (tiny_x2ct(views=2), "K = 2")):
        save_stage(made, tmp_path / f"{views}.safetensors", training)
        assert TrainedRival(str(tmp_path / f"{views}.safetensors")).training == f"{views}, {words}"


def test_the_table_of_a_comparison_says_so_and_that_of_a_damaged_file_is_made_too(file, tmp_path):
    def table(training: dict, damage: bool) -> str:
        save_stage(tiny_lifted(), file, training)
        if damage:
            Path(file).write_bytes(b"no rival")
        (tmp_path / "spec.yaml").write_text(yaml.safe_dump({
            "out": str(tmp_path / f"out{damage}"), "phantoms": 1, "base": {"detector": 24, "views": 3, "voxels": 16},
            "methods": {"mine": {"of": "phydict.rivals.TrainedRival", "method.file": file}},
            "axes": {"method": ["mine", "fdk"]}}))
        infer(["ablate", "-c", str(tmp_path / "spec.yaml"), "--device", "cpu"])
        return (tmp_path / f"out{damage}" / "tables.md").read_text()

    assert "Trained rivals, as their files tell: mine any K, 7 steps." in table({"steps": 7}, False)
    assert "mine: refused: " in table({"steps": 7}, True)


def test_a_comparison_is_made_on_a_rivals_own_voxels_and_refuses_several(file, tmp_path, capsys):
    (tmp_path / "spec.yaml").write_text(yaml.safe_dump({
        "out": str(tmp_path / "out"), "phantoms": 1, "base": {"detector": 24, "views": 3},
        "methods": {"mine": {"of": "phydict.rivals.TrainedRival", "method.file": file}}, "axes": {"method": ["mine"]}}))
    run = ["ablate", "-c", str(tmp_path / "spec.yaml"), "--device", "cpu"]
    infer(run)
    [row] = read_csv(tmp_path / "out" / "results.csv")
    assert (row["status"], row["grid"]) == ("ok", "16x16x16")
    assert "compared on one grid" in refusal(capsys, infer, [*run, "--set", "method=[mine,sirt]"])
