"""Several processes, and flags of execution, train what one process would."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from command_lines import CONFIG, arguments, checkpoint, losses, refusal
from torch.utils.data import DataLoader, DistributedSampler, default_collate

from phydict.cli.train import main
from phydict.grid import Cube
from phydict.prior import VolumeUNet, load_prior
from phydict.runtime.precision import computes_bfloat16
from phydict.runtime.profiling import CPU
from phydict.training import PriorTraining, SuperResolutionTraining
from phydict.training.data import PriorData
from phydict.training.refinement import RefinementTraining
from phydict.training.refiner import RefinerTraining
from phydict.training.settings import HoldOut, Loading, TextSettings
from phydict.training.stage import StageTraining


def two_processes(folder: Path, cache: Path, config: str, *more: str) -> subprocess.CompletedProcess:
    """One epoch by two processes on one sample each per step, with a configuration for several devices."""
    args = arguments(folder, cache, f"--config={CONFIG.with_name(config)}", "--trainer.max_epochs=1",
                     "--data.loading.batch_size=1", "--trainer.devices=2", *more)
    return subprocess.run([sys.executable, str(CONFIG.parents[2] / "train.py"), *args], capture_output=True, text=True,
                          env=os.environ | {"OMP_NUM_THREADS": "1"}, timeout=300)


def assert_same_curve(folder: Path, trained: Path, column: str = "loss", tolerance: float = 1e-4) -> None:
    """The logged numbers of one epoch are those of the uninterrupted one-process run, to rounding: sums are taken in
    another order, which Adam carries on."""
    expected = {step: float(value) for step, value in losses(trained, column).items() if step < 4}
    found = {step: float(value) for step, value in losses(folder, column).items()}
    assert found == pytest.approx(expected, rel=tolerance)


@pytest.mark.slow
def test_two_processes_train_the_prior_that_one_would(tmp_path, cache, trained):
    done = two_processes(tmp_path, cache, "ddp.yaml")
    assert done.returncode == 0, done.stderr[-2000:]
    for column in ("loss", "val/rmse_hu", "val/rmse_hu_t0.5", "samples"):
        assert_same_curve(tmp_path, trained, column)
    assert_same_curve(tmp_path, trained, "val/psnr", tolerance=1e-3)  # ten calls of the network carry rounding on
    assert checkpoint(tmp_path)["phydict"]["training"] == {"steps": 4, "samples": 8}
    assert list(tmp_path.glob("logs/**/samples/*.png"))


@pytest.mark.slow
def test_every_process_stops_where_one_of_them_has_a_loss_that_is_not_finite(tmp_path, cache):
    (tmp_path / "train.py").write_text("""if True:
        from phydict.training import PriorTraining
        from phydict.cli.train import main
        loss = PriorTraining.batch_loss
        def broken(task, batch, key, rank, processes):
            return loss(task, batch, key, rank, processes) * (float("nan") if rank == task.global_step == 1 else 1)
        PriorTraining.batch_loss = broken
        main()""")
    args = arguments(tmp_path / "run", cache, f"--config={CONFIG.with_name('ddp.yaml')}", "--trainer.devices=2",
                     "--data.loading.batch_size=1", "--trainer.max_epochs=1", "--model.text.encoder=none")
    done = subprocess.run([sys.executable, str(tmp_path / "train.py"), *args], capture_output=True, text=True,
                          env=os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": str(CONFIG.parents[2])}, timeout=300)
    assert done.returncode == 2 and "Traceback" not in done.stderr, done.stderr[-2000:]
    assert "error: the loss is nan after 1 steps: no checkpoint" in done.stderr
    assert not (tmp_path / "run" / "last.ckpt").exists()


@pytest.mark.slow
def test_two_processes_with_half_the_weights_each_train_the_prior_that_one_would(tmp_path, cache, trained):
    done = two_processes(tmp_path, cache, "fsdp.yaml")
    assert done.returncode == 0, done.stderr[-2000:]
    assert_same_curve(tmp_path, trained)
    assert list(tmp_path.glob("logs/**/samples/*.png"))
    again = two_processes(tmp_path, cache, "fsdp.yaml", f"--ckpt_path={tmp_path / 'last.ckpt'}",
                          "--trainer.max_epochs=2")
    assert again.returncode == 0, again.stderr[-2000:]
    expected = {step: float(value) for step, value in losses(trained).items() if step >= 4}
    assert {step: float(value) for step, value in losses(tmp_path).items()} == pytest.approx(expected, rel=1e-3)
    main(["export", f"--checkpoint={tmp_path / 'last.ckpt'}", f"--out={tmp_path / 'prior.safetensors'}"])
    assert load_prior(tmp_path / "prior.safetensors").grid.shape == (16, 16, 16)


@pytest.mark.slow
def test_sharded_weights_are_not_averaged(tmp_path, cache):
    done = two_processes(tmp_path, cache, "fsdp.yaml",
                         "--trainer.callbacks=lightning.pytorch.callbacks.EMAWeightAveraging")
    assert done.returncode != 0 and "sharded weights cannot be averaged" in done.stderr, done.stderr[-2000:]


@pytest.mark.parametrize("flags, tolerance", [
    (["--model.execution.gradient_checkpointing=true"], 1e-6), (["--model.execution.channels_last=false"], 1e-4),
    pytest.param(["--precision=bfloat16"], 0.03, marks=pytest.mark.skipif(
        not computes_bfloat16(CPU), reason="this processor does not compute bfloat16"))],
    ids=["checkpointing", "layout", "bf16"])
def test_flags_leave_the_loss_and_their_checkpoint_goes_on_without_them(flags, tolerance, trained, cache, tmp_path):
    main(arguments(tmp_path, cache, "--trainer.max_epochs=1", "--trainer.limit_val_batches=0", *flags))
    loss, expected = losses(tmp_path), losses(trained)
    for step in range(4):
        assert float(loss[step]) == pytest.approx(float(expected[step]), rel=tolerance)
    main(arguments(tmp_path, cache, "--trainer.max_epochs=2", "--trainer.limit_val_batches=0",
                   f"--ckpt_path={tmp_path / 'last.ckpt'}"))
    assert checkpoint(tmp_path)["state_dict"].keys() == checkpoint(trained)["state_dict"].keys()
    assert float(losses(tmp_path)[7]) == pytest.approx(float(expected[7]), rel=10 * tolerance)


def test_a_batch_is_one_loss_however_many_processes_share_it(cache):
    data = PriorData(phantoms=4, cache=str(cache), cube=Cube(16))
    task = PriorTraining(VolumeUNet(4, 2, (8, 8), (False, True), 1, 8), TextSettings("none"), cube=Cube(16))
    torch.nn.init.normal_(task.prior.network.unfold.weight, std=0.1)
    batch = default_collate([data.phantoms[i] for i in range(4)])
    shares = [{key: value[rank::2] for key, value in batch.items()} for rank in range(2)]
    for key in ((0, 0), (0, 1)):
        halves = [task.batch_loss(share, key, rank, 2) for rank, share in enumerate(shares)]
        torch.testing.assert_close(sum(halves) / 2, task.batch_loss(batch, key))
    assert task.batch_loss(batch, (0, 0)) != task.batch_loss(batch, (0, 1))


@pytest.mark.parametrize("processes", [1, 3])
def test_what_is_drawn_for_a_held_out_case_does_not_depend_on_the_process_that_sees_it(monkeypatch, processes):
    task = PriorTraining(VolumeUNet(4, 2, (8, 8), (False, True), 1, 8), TextSettings("none"), cube=Cube(16))
    for rank in range(processes):
        monkeypatch.setattr(PriorTraining, "trainer", SimpleNamespace(
            world_size=processes, global_rank=rank, val_dataloaders=DataLoader(range(5))))
        dealt = list(DistributedSampler(range(5), processes, rank, shuffle=False))
        assert [task.validation_number(i) for i in range(len(dealt))] == dealt


@pytest.mark.parametrize("processes", [1, 3])
def test_what_held_out_cases_give_is_gathered_once_and_in_order(monkeypatch, processes):
    task = RefinementTraining((8, 8))
    dealt = [list(DistributedSampler(range(5), processes, rank, shuffle=False)) for rank in range(processes)]
    given = [[torch.tensor([case, case + 0.5]) for case in mine] for mine in dealt]
    monkeypatch.setattr(StageTraining, "trainer", SimpleNamespace(
        world_size=processes, val_dataloaders=DataLoader(range(5))))
    monkeypatch.setattr(StageTraining, "all_gather", lambda self, own: own if processes == 1 else torch.stack(
        [torch.stack(values) for values in given]))
    [row] = task.of_all_processes([(value,) for value in given[-1]])
    assert row.tolist() == [0, 0.5, 1, 1.5, 2, 2.5, 3, 3.5, 4, 4.5]


def test_every_held_out_case_counts_once_however_many_processes_share_them(monkeypatch):
    task, weights = RefinementTraining((8, 8)), np.zeros(5)
    for rank in range(3):
        monkeypatch.setattr(StageTraining, "trainer", SimpleNamespace(
            world_size=3, global_rank=rank, val_dataloaders=DataLoader(range(5))))
        for i, case in enumerate(DistributedSampler(range(5), 3, rank, shuffle=False)):
            with monkeypatch.context() as patch:
                patch.setattr(task, "log", lambda *_, batch_size, case=case, **__: np.add.at(weights, case, batch_size))
                task.log_case(i, "val/psnr", 1.0)
    assert weights.min() == weights.max() > 0 and weights.sum() % 3 == 0


@pytest.mark.parametrize("limit, cases", [(2, 2), (9, 3), (1.0, 3)])
def test_as_many_cases_validate_as_are_asked_for_however_many_processes_share_them(cache, limit, cases):
    data = PriorData(phantoms=1, holdout=HoldOut(phantoms=3), cache=str(cache), cube=Cube(16))
    data.trainer = SimpleNamespace(limit_val_batches=limit)
    assert len(data.val_dataloader().dataset) == cases


class Struck:
    """Four cases, while each of which is made the process that makes it gets a signal."""

    def __init__(self, number: int):
        self.number = number

    def __len__(self) -> int:
        return 4

    def __getitem__(self, index: int) -> int:
        signal.raise_signal(self.number)
        return index


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("kind", ["train", "val"])
def test_loaders_go_on_where_a_signal_strikes_every_process_of_a_training(monkeypatch, cache, kind, number):
    data = PriorData(phantoms=1, holdout=HoldOut(phantoms=1), cache=str(cache), cube=Cube(16),
                     loading=Loading(batch_size=1, epoch_size=4, workers=1))
    progress = SimpleNamespace(epoch_progress=SimpleNamespace(current=None), restarting=False)
    data.trainer = SimpleNamespace(limit_val_batches=1.0, reload_dataloaders_every_n_epochs=1, current_epoch=0,
                                   world_size=1, global_rank=0, fit_loop=progress)
    for name, value in {"draws": lambda _: Struck(number), "validation": Struck(number), "collate": list}.items():
        monkeypatch.setattr(data, name, value, raising=False)
    assert list(getattr(data, f"{kind}_dataloader")()) == [[0], [1], [2], [3]]


def test_weights_are_shared_out_to_as_many_devices_as_there_are(tmp_path, cache, capsys):
    said = refusal(capsys, main, arguments(tmp_path, cache, f"--config={CONFIG.with_name('fsdp.yaml')}",
                                           "--trainer.devices=1"))
    assert "= 2 x 1 devices, but this run has 1" in said and not list(tmp_path.iterdir())


@pytest.mark.parametrize("stage", [StageTraining, SuperResolutionTraining, RefinerTraining, RefinementTraining])
def test_only_a_prior_is_sharded(stage):
    with pytest.raises(ValueError, match="too small to be sharded over devices: train it with configs/prior/ddp.yaml"):
        stage.configure_model(SimpleNamespace(device_mesh=object()))
