"""Training of rivals: the loss falls, a resumed run is the uninterrupted one, and its file can be compared."""

import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from command_lines import checkpoint, losses, refusal, resumed_as_uninterrupted, stage_arguments
from torch.utils.data import DataLoader, default_collate

from phydict.cli.infer import main as infer
from phydict.cli.train import main
from phydict.datasets import phantom_case
from phydict.evaluation import read_csv
from phydict.grid import Cube, Grid
from phydict.prior import save_stage
from phydict.rivals import LiftedNetwork, X2CTNetwork, XrayToCTPANetwork, load_rival
from phydict.rivals.rival import bound_orbit
from phydict.training.rivals import LiftedTraining, OrbitScenes
from phydict.training.x2ct import Adversary, X2CTTraining
from phydict.training.xray2ctpa import XrayToCTPATraining
from phydict.units import HUWindow
from rivals.tiny_rivals import GRID, lively, tiny_lifted, tiny_x2ct, tiny_xray2ctpa

CONFIGS = Path(__file__).parents[2] / "configs" / "rivals"
TINY = {"lifted": ["--model.network.class_path=phydict.rivals.LiftedNetwork",
                   "--model.network.init_args.image_channels=[4,6]", "--model.network.init_args.fine=2",
                   "--model.network.init_args.coarse=4", "--model.network.init_args.channels=[4,6,8]",
                   "--model.scenes.most_views=4", "--model.validation.views=[2]"],
        "x2ct": ["--model.network.class_path=phydict.rivals.X2CTNetwork", "--model.network.init_args.stem=8",
                 "--model.network.init_args.growth=4", "--model.network.init_args.blocks=[2,2]",
                 "--model.network.init_args.channels=[4,8,8]", "--model.scenes.views=2",
                 "--model.adversary.width=4"],
        "xray2ctpa": ["--model.network.class_path=phydict.rivals.XrayToCTPANetwork",
                      "--model.network.init_args.image_channels=[4,4]", "--model.network.init_args.embedding=8",
                      "--model.network.init_args.slice_channels=[4,8]", "--model.network.init_args.channels=[4,8]",
                      "--model.network.init_args.ddim_steps=4", "--model.scenes.views=2",
                      "--model.latent.autoencoder_steps=2", "--model.optimisation.warmup=0",
                      "--trainer.check_val_every_n_epoch=1"]}
TASKS = {"lifted": lambda: LiftedTraining(lively(lambda: LiftedNetwork((4, 6), 2, 4, (4, 6, 8))),
                                          cube=Cube(16), window=(-1000, 600)),
         "x2ct": lambda: X2CTTraining(lively(lambda: X2CTNetwork(8, 4, (2, 2), (4, 8, 8))), OrbitScenes(views=2),
                                      Cube(16), (-1000, 600), adversary=Adversary(width=4)),
         "xray2ctpa": lambda: XrayToCTPATraining(
             lively(lambda: XrayToCTPANetwork((4, 4), 8, (4, 8), (4, 8), 4)), OrbitScenes(views=2), Cube(16),
             (-1000, 600))}


def arguments(name: str, folder: Path, cache: Path, *more: str) -> list[str]:
    return stage_arguments(CONFIGS / f"{name}.yaml", folder, cache, *TINY[name], *more)


@pytest.mark.parametrize("name", TINY)
def test_a_resumed_run_is_the_uninterrupted_one_and_its_file_is_compared(name, tmp_path, cache, capsys):
    last = resumed_as_uninterrupted(main, lambda run, *more: arguments(name, run, cache, *more), tmp_path)
    file = tmp_path / "rival.safetensors"
    main(["export", "--checkpoint", str(last), "--out", str(file)])
    assert load_rival(file).network.stage == name and f"rival in {file}" in capsys.readouterr().out
    comparison = tmp_path / "comparison.yaml"
    comparison.write_text(f"methods: {{{name}: {{of: phydict.rivals.TrainedRival, method.file: {file}}}}}\n"
                          "base: {voxels: 16, views: 2, detector: 28}\n"
                          f"axes: {{method: [{name}, cgls]}}\nphantoms: 1\nout: {tmp_path / 'table'}\n")
    infer(["ablate", "-c", str(comparison)])
    rows = read_csv(tmp_path / "table" / "results.csv")
    assert [(row["method"], row["status"]) for row in rows] == [(name, "ok"), ("cgls", "ok")]


@pytest.mark.slow
def test_two_processes_train_the_rival_whose_parts_learn_in_turn_that_one_would(tmp_path, cache):
    """Without a configuration for several devices, as where a machine has two and none are asked for."""
    one, two = (arguments("xray2ctpa", tmp_path / run, cache, "--data.loading.epoch_size=8", "--trainer.max_epochs=1",
                          "--trainer.limit_val_batches=0", *more)
                for run, more in (("one", ["--trainer.devices=1", "--data.loading.batch_size=2"]),
                                  ("two", ["--trainer.devices=2", "--data.loading.batch_size=1"])))
    main(one)
    done = subprocess.run([sys.executable, str(CONFIGS.parents[1] / "train.py"), *two], capture_output=True, text=True,
                          timeout=300, env=os.environ | {"OMP_NUM_THREADS": "1"})
    assert done.returncode == 0, done.stderr[-2000:]
    expected, found = ({step: float(loss) for step, loss in losses(tmp_path / run).items()} for run in ("one", "two"))
    assert found == pytest.approx(expected, rel=1e-4) and set(found) == {0, 1, 2, 3}
    sizes = [checkpoint(tmp_path / run)["state_dict"]["prior.network.latent_size"] for run in ("one", "two")]
    torch.testing.assert_close(*sizes)


@pytest.mark.parametrize("name", TASKS)
def test_steps_on_one_batch_lower_its_loss(name):
    task = TASKS[name]()
    batch = default_collate([phantom_case(3, GRID, HUWindow(-1000, 600))])
    optimizer = torch.optim.Adam(task.parameters(), 1e-2)
    found = []
    for _ in range(25):
        found.append(task.batch_loss(batch, (1,)))
        optimizer.zero_grad()
        found[-1].backward()
        optimizer.step()
    assert found[-1] < found[0] - 0.3


@pytest.mark.parametrize("name", TASKS)
def test_the_loss_follows_from_its_key_alone(name):
    task, batch = TASKS[name](), default_collate([phantom_case(3, GRID, HUWindow(-1000, 600))])
    with torch.no_grad():
        one, again, other = (float(task.batch_loss(batch, key)) for key in ((1,), (1,), (2,)))
    assert one == again != other


def test_validation_takes_the_x_rays_that_a_bound_rival_holds_for(monkeypatch):
    task, found = X2CTTraining(X2CTNetwork(8, 4, (2, 2), (4, 8, 8)), OrbitScenes(views=2, arc_degrees=180.0), Cube(16),
                               (-1000, 600)).eval(), {}
    monkeypatch.setattr(task, "log", lambda name, value, **how: found.update({name: value}))
    monkeypatch.setattr(X2CTTraining, "trainer", SimpleNamespace(
        world_size=1, global_rank=0, val_dataloaders=DataLoader([0])))
    task.validation_step(default_collate([phantom_case(3, GRID, HUWindow(-1000, 600))]), 0)
    assert found["val/psnr"] == found["val/psnr_2"] > 5


def test_what_is_bound_to_a_geometry_goes_on_with_another_and_what_is_not_with_other_voxels(tmp_path):
    file = tmp_path / "rival.safetensors"
    save_stage(tiny_lifted(), file, dtype=torch.float32)
    going = LiftedTraining(cube=Cube(32), window=(-1000, 600), initial=str(file)).prior
    assert going.grid.same_as(Grid.cube(32))
    for name, weight in tiny_lifted().state_dict().items():
        assert torch.equal(weight, going.state_dict()[name])
    save_stage(tiny_x2ct(), file, dtype=torch.float32)
    network, settings = X2CTNetwork(8, 4, (2, 2), (4, 8, 8)), {"window": (-1000, 600), "initial": str(file)}
    going = X2CTTraining(network, OrbitScenes(views=3), Cube(16), **settings).prior
    assert going.beam.same_as(bound_orbit(GRID, 3))
    for name, weight in tiny_x2ct().state_dict().items():
        assert torch.equal(weight, going.state_dict()[name])
    with pytest.raises(ValueError, match="differ in 'grid'"):
        X2CTTraining(network, OrbitScenes(views=2), Cube(16, 300.0), **settings)


@pytest.mark.parametrize("name, made, other, sentence", [
    ("lifted", tiny_lifted, lambda: LiftedNetwork((4, 6), 3, 4, (4, 6, 8)), "fine 3, .* 2:"),
    ("x2ct", tiny_x2ct, lambda: X2CTNetwork(8, 6, (2, 2), (4, 8, 8)), "growth 6, .* 4:"),
    ("xray2ctpa", tiny_xray2ctpa, lambda: XrayToCTPANetwork((4, 4), 8, (4, 8), (4, 8), 5),
     "ddim_steps 5, .* 4:")])
def test_a_network_beside_a_rival_to_continue_from_is_the_rivals_own(tmp_path, name, made, other, sentence):
    file, training = tmp_path / "rival.safetensors", type(TASKS[name]())
    save_stage(made(), file)
    more = {"cube": Cube(16), "window": (-1000, 600), "initial": str(file)}
    if name != "lifted":
        more["scenes"] = OrbitScenes(views=2)
    for network in [made().network] + [None] * (name != "x2ct"):  # whose default is for other voxels
        assert training(network, **more).prior.network.settings == made().network.settings
    with pytest.raises(ValueError, match=f"model.network has {sentence} leave model.network out"):
        training(other(), **more)


def test_a_rival_counts_the_steps_that_it_went_on_from(tmp_path, monkeypatch):
    file = tmp_path / "rival.safetensors"
    save_stage(tiny_lifted(), file, {"steps": 6, "samples": 12})
    task = LiftedTraining(cube=Cube(16), window=(-1000, 600), initial=str(file))
    monkeypatch.setattr(LiftedTraining, "trainer", SimpleNamespace(
        global_step=2, datamodule=None, strategy=SimpleNamespace(reduce=lambda value, **_: value)))
    task.samples, checkpoint = 4, {"state_dict": {}, "global_step": 2}
    task.on_save_checkpoint(checkpoint)
    assert checkpoint["phydict"]["training"] == {"steps": 8, "samples": 16}
    task.samples = 0
    task.on_load_checkpoint(checkpoint)
    assert task.samples == 4
    resumed = LiftedTraining(tiny_lifted().network, cube=Cube(16), window=(-1000, 600))  # without the file
    resumed.on_load_checkpoint(checkpoint)
    resumed.on_save_checkpoint(again := {"state_dict": {}})
    assert again["phydict"]["training"] == {"steps": 8, "samples": 16}


def test_a_diffusion_that_resumes_without_the_file_that_it_began_from_goes_on_with_it(monkeypatch):
    task = TASKS["xray2ctpa"]()
    saved = {"phydict": task.prior.describe(), "global_step": 5, "state_dict": task.state_dict()}
    monkeypatch.setattr(XrayToCTPATraining, "global_step", 5)
    for learns in (False, True):
        task.on_load_checkpoint(saved)
        assert task.learns_slices == learns
        saved["state_dict"]["prior.network.denoiser.leave.weight"].zero_()
        task = TASKS["xray2ctpa"]()


def test_training_that_cannot_be_is_refused(tmp_path, cache, capsys):
    args = arguments("lifted", tmp_path, cache, "--model.cube.voxels=18")
    assert "divisible by 4" in refusal(capsys, main, args)
    save_stage(tiny_lifted(), tmp_path / "rival.safetensors")
    args = arguments("lifted", tmp_path, cache, f"--model.initial={tmp_path / 'rival.safetensors'}",
                     "--model.network.init_args.fine=3")
    assert "model.network has fine 3" in refusal(capsys, main, args)
