"""Training: the loss falls, a resumed run is the uninterrupted one, what is held out only validates."""

from __future__ import annotations

import json
import signal
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from command_lines import CONFIG, arguments, checkpoint, losses, refusal
from ct_files import save_ct, thorax_hu
from lightning.pytorch.callbacks import EMAWeightAveraging
from prior.tiny import tiny_prior
from processes import TRAIN, Python
from torch.utils.data import default_collate

from phydict.cli.train import main
from phydict.datasets import CTSource, phantom_case
from phydict.datasets.phantoms.cached import CachedPhantoms
from phydict.grid import Cube, Grid
from phydict.inference.data import ReconstructionData
from phydict.prior import load_prior, save_prior
from phydict.training import PriorTraining
from phydict.training.checkpoints import RecentCheckpoint
from phydict.training.data import PriorData
from phydict.training.draws import MixedCases
from phydict.training.refinement import RefinementTraining
from phydict.training.scores import reconstruction_scores
from phydict.training.settings import HoldOut, Optimisation
from phydict.units import HUWindow


def test_the_loss_falls(tmp_path, cache):
    main(arguments(tmp_path, cache, "--trainer.max_epochs=4", "--model.optimisation.learning_rate=5e-3",
                   "--trainer.limit_val_batches=0"))
    loss = [float(value) for _, value in sorted(losses(tmp_path).items())]
    assert len(loss) == 16
    assert np.mean(loss[-8:]) < 0.7 * np.mean(loss[:4])


def test_a_log_file_tells_steps_in_whole_lines_and_nothing_of_lightnings(tmp_path, cache):
    both = "import json, sys; from phydict.cli.train import main; [main(args) for args in json.loads(sys.argv[1])]"
    args = [arg for arg in arguments(tmp_path, cache, "--progress.interval=0") if "enable_" not in arg]
    runs = [[*args, *more] for more in (["--trainer.max_steps=3"], [
        "--trainer.max_steps=6", f"--ckpt_path={tmp_path / 'last.ckpt'}"])]
    done = Python(both, json.dumps(runs))
    assert done.wait() == 0, done.err[-2000:]
    said = (done.out + done.err).splitlines()
    for last in ("step 3 of 3: loss ", "step 6 of 6: loss "):
        assert any(line.startswith(last) and "samples_per_s" in line for line in said), said
    known = ("step ", "training", "validation: ", "report ", "sentences: ", "Seed")
    assert all(line.startswith(known) for line in said), said


def test_each_epoch_has_draws_of_its_own_whatever_the_configuration_says(tmp_path, cache, monkeypatch, capsys):
    seen, step = [], PriorTraining.training_step
    monkeypatch.setattr(PriorTraining, "training_step", lambda task, batch, index: (
        seen.append(batch["volume"].sum().item()), step(task, batch, index))[1])
    plain = tmp_path / "plain.yaml"
    plain.write_text("".join(line for line in CONFIG.read_text().splitlines(True) if "reload" not in line))
    args = [f"--config={plain}" if arg.startswith("--config") else arg for arg in arguments(
        tmp_path / "run", cache, "--trainer.max_epochs=2", "--trainer.limit_val_batches=0")]
    main(args)
    assert len(seen) == 8 and len(set(seen)) == 8
    assert "reload_dataloaders_every_n_epochs must be 1, but 0" in refusal(
        capsys, main, [*args[:-1], f"--out={tmp_path / 'other'}", "--trainer.reload_dataloaders_every_n_epochs=0"])


def test_a_killed_run_goes_on_as_if_it_had_not_been(tmp_path, trained, cache):
    killed = """if True:  # a process that dies without a word in the second epoch, after the first's checkpoint
        import os, signal, sys
        from phydict.training import PriorTraining
        from phydict.cli.train import main
        step = PriorTraining.training_step
        def fatal_step(task, batch, index):
            if task.global_step == 6:
                os.kill(os.getpid(), signal.SIGKILL)
            return step(task, batch, index)
        PriorTraining.training_step = fatal_step
        main(sys.argv[1:])"""
    done = Python(killed, *arguments(tmp_path, cache, "--trainer.max_epochs=2"))
    assert done.wait() == -signal.SIGKILL, done.err[-2000:]
    assert checkpoint(tmp_path)["global_step"] == 4
    torch.manual_seed(99)  # the new process knows nothing of the old one's random numbers
    main(arguments(tmp_path, cache, "--trainer.max_epochs=2", f"--ckpt_path={tmp_path / 'last.ckpt'}",
                   "--seed_everything=5"))
    ours, theirs = checkpoint(tmp_path), checkpoint(trained)
    for weights in ("state_dict", "current_model_state"):
        assert ours[weights].keys() == theirs[weights].keys()
        different = [name for name, weight in ours[weights].items() if not torch.equal(weight, theirs[weights][name])]
        assert not different, weights
    assert any(not torch.equal(w, ours["current_model_state"][k]) for k, w in ours["state_dict"].items())
    resumed, expected = losses(tmp_path), losses(trained)
    assert {step: resumed[step] for step in range(4, 8)} == {step: expected[step] for step in range(4, 8)}
    assert ours["phydict"]["training"] == {"steps": 8, "samples": 16}


def test_a_run_stopped_within_a_long_epoch_resumes_from_its_last_minutes(tmp_path, cache, monkeypatch):
    args = arguments(tmp_path, cache, "--trainer.limit_val_batches=0", "--model.text.encoder=none",
                     "--trainer.max_steps=4", "--trainer.max_epochs=1", "--recent.train_time_interval=0:00:00")
    main([*args, f"--out={tmp_path / 'straight'}"])
    step = PriorTraining.training_step

    def stopped(task, *given):
        if task.global_step == 3:
            raise KeyboardInterrupt
        return step(task, *given)

    with monkeypatch.context() as stopping, pytest.raises(SystemExit):
        stopping.setattr(PriorTraining, "training_step", stopped)
        main([*args, f"--out={tmp_path / 'halved'}"])
    assert checkpoint(tmp_path / "halved")["global_step"] == 3
    main([*args, f"--out={tmp_path / 'halved'}", "--ckpt_path=last"])
    one, other = (checkpoint(tmp_path / run)["state_dict"] for run in ("straight", "halved"))
    assert one.keys() == other.keys() and all(torch.equal(one[name], other[name]) for name in one)


def test_minutes_that_end_within_a_step_end_with_it(tmp_path, cache, monkeypatch):
    step = PriorTraining.training_step

    def stopped(task, batch, index):
        if (task.global_step, index % 2) == (1, 0):
            [recent] = [one for one in task.trainer.checkpoint_callbacks if isinstance(one, RecentCheckpoint)]
            recent._last_time_checked = float("-inf")
        if task.global_step == 2:
            raise KeyboardInterrupt
        return step(task, batch, index)

    monkeypatch.setattr(PriorTraining, "training_step", stopped)
    with pytest.raises(SystemExit):
        ten_steps(tmp_path, cache, "--trainer.accumulate_grad_batches=2", "--data.loading.epoch_size=16")
    progress = checkpoint(tmp_path)["loops"]["fit_loop"]["epoch_loop.batch_progress"]["current"]
    assert (checkpoint(tmp_path)["global_step"], progress["ready"]) == (2, 4)


@pytest.fixture
def handler_of_sigint() -> Iterator[None]:
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_run_that_a_signal_stops_within_a_step_keeps_that_step(number, straight, handler_of_sigint, tmp_path, cache,
                                                                 monkeypatch, capfd):
    step = PriorTraining.training_step

    def signalled(task, *given):
        if task.global_step == 6:
            signal.raise_signal(number)
        return step(task, *given)

    with monkeypatch.context() as stopping, pytest.raises(SystemExit) as stopped:
        stopping.setattr(PriorTraining, "training_step", signalled)
        ten_steps(tmp_path, cache)
    assert stopped.value.code == 128 + number and checkpoint(tmp_path)["global_step"] == 7
    assert ("stopping after this step" in capfd.readouterr().err) == (number == signal.SIGINT)
    resumed = ten_steps(tmp_path, cache, "--ckpt_path=last")
    assert all(torch.equal(weight, resumed["state_dict"][name]) for name, weight in straight["state_dict"].items())


IN_TWO_BATCHES = "--trainer.accumulate_grad_batches=2", "--trainer.max_steps=4", "--data.loading.epoch_size=16"


@pytest.fixture(scope="module")
def straight_in_two_batches(tmp_path_factory, cache) -> dict:
    return ten_steps(tmp_path_factory.mktemp("straight"), cache, *IN_TWO_BATCHES)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_waits_for_all_batches_of_a_step(number, straight_in_two_batches, handler_of_sigint, tmp_path, cache,
                                                  monkeypatch):
    step = PriorTraining.training_step

    def signalled(task, batch, index):
        if (task.global_step, index % 2) == (1, 0):
            signal.raise_signal(number)
        return step(task, batch, index)

    with monkeypatch.context() as stopping, pytest.raises(SystemExit):
        stopping.setattr(PriorTraining, "training_step", signalled)
        ten_steps(tmp_path, cache, *IN_TWO_BATCHES)
    assert checkpoint(tmp_path)["global_step"] == 2
    resumed, straight = ten_steps(tmp_path, cache, *IN_TWO_BATCHES, "--ckpt_path=last"), straight_in_two_batches
    assert all(torch.equal(weight, resumed["state_dict"][name]) for name, weight in straight["state_dict"].items())


def test_a_training_that_ends_gives_ctrl_c_back(handler_of_sigint, tmp_path, cache, capsys, monkeypatch):
    main(arguments(tmp_path, cache, "--trainer.max_steps=1", "--trainer.limit_val_batches=0",
                   "--model.text.encoder=none"))
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    monkeypatch.setattr(PriorTraining, "batch_loss", lambda *_: torch.tensor(float("nan"), requires_grad=True))
    refusal(capsys, main, arguments(tmp_path / "nan", cache, "--trainer.max_steps=1", "--model.text.encoder=none"))
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


@pytest.mark.parametrize("before", [False, True], ids=["at once", "after a checkpoint"])
def test_a_loss_that_is_not_finite_stops_the_training(tmp_path, cache, capsys, monkeypatch, before):
    loss, at = PriorTraining.batch_loss, 5 if before else 1
    monkeypatch.setattr(PriorTraining, "batch_loss", lambda task, *given: loss(task, *given) * (
        float("nan") if task.global_step == at else 1))
    said = refusal(capsys, main, arguments(tmp_path, cache, "--trainer.max_epochs=2", "--trainer.limit_val_batches=0"))
    assert f"the loss is nan after {at} steps" in said
    assert (f"the last good checkpoint is {tmp_path / 'last.ckpt'}" if before else "no checkpoint") in said
    assert not before or checkpoint(tmp_path)["global_step"] == 4


def test_validation_logs_every_noise_level_and_paints_a_montage(trained):
    log = next(trained.glob("logs/**/metrics.csv")).read_text().splitlines()[0].split(",")
    assert {f"val/rmse_hu_t{t}" for t in (0.1, 0.3, 0.5, 0.7, 0.9)} | {"val/rmse_hu"} <= set(log)
    assert [file.name for file in sorted(trained.glob("logs/**/samples/*.png"))] == [
        "step000004_0.png", "step000008_0.png"]


@pytest.mark.filterwarnings("ignore:You.re using the WeightAveraging callback")
def test_averaged_weights_read_reports_as_the_same_weights_do_without_averaging(tmp_path, monkeypatch):
    save_prior(tiny_prior(detail=True), file := str(tmp_path / "prior.safetensors"))
    task, averaging = PriorTraining(cube=Cube(16), window=(-1000, 600), initial=file), EMAWeightAveraging(decay=0.9999)
    monkeypatch.setattr(PriorTraining, "trainer", SimpleNamespace(max_steps=-1, callbacks=[averaging]))
    averaging.setup(task.trainer, task, "fit")
    task.on_fit_start()
    for _ in range(20):
        averaging._average_model.update_parameters(task)
    averaged, report = averaging._average_model.module.prior, ["Large left pleural effusion. No nodule or mass."]
    torch.testing.assert_close(averaged.context(report), task.prior.context(report), rtol=1e-4, atol=1e-5)


def test_without_validation_views_nothing_is_reconstructed_or_kept(tmp_path, cache):
    main(arguments(tmp_path, cache, "--trainer.max_epochs=1", "--model.validation.views=0"))
    assert "val/psnr" not in next(tmp_path.glob("logs/**/metrics.csv")).read_text()
    assert not (tmp_path / "best.ckpt").exists() and (tmp_path / "last.ckpt").exists()


def test_a_prior_of_coarser_voxels_goes_on_at_finer_ones_of_its_box_alone(tmp_path):
    save_prior(tiny_prior(detail=True), file := str(tmp_path / "coarse.safetensors"))
    finer = PriorTraining(cube=Cube(24), window=(-1000, 600), initial=file).prior
    assert finer.grid.same_as(Grid.cube(24)) and finer.bind().denoise(torch.zeros(1, 4, 24, 24, 24), 0.5).any()
    for name, weight in load_prior(file).state_dict().items():
        torch.testing.assert_close(finer.state_dict()[name], weight, msg=name)
    for cube, words in ((Cube(24, 300.0), "has another grid or HU window"), (Cube(22), "sizes divisible by")):
        with pytest.raises(ValueError, match=words):
            PriorTraining(cube=cube, window=(-1000, 600), initial=file)


def test_more_views_reconstruct_a_held_out_case_better():
    prior = tiny_prior()
    ct = phantom_case(0, prior.grid, prior.window)["volume"][None]
    few, many = (reconstruction_scores(prior, ct, views, seed=0) for views in (2, 32))
    assert many["psnr"] > few["psnr"] + 3 and many["ssim"] > few["ssim"]


def test_held_out_cts_only_validate_and_draws_mix_cts_with_phantoms(cts, tmp_path):
    data = PriorData(str(cts), holdout=HoldOut(["patient1"], phantoms=1), phantoms=2, cache=str(tmp_path),
                     cube=Cube(16))
    assert [ct.id for ct in data.cts.cts] == ["patient0"]
    assert [ct.id for ct in data.validation.datasets[1].cts] == ["patient1"]
    both = [{key: case[key] for key in ("volume", "masks", "has_masks")} for case in (data.phantoms[0], data.cts[0])]
    for pair in (both, both[::-1]):  # in either order, as a loader process writes into the first case's dtype
        assert default_collate(pair)["has_masks"].dtype == torch.bool


def test_a_held_out_patients_other_scans_and_reports_are_not_learnt_from(cts, tmp_path):
    folder = tmp_path / "train"
    for scan in ("train_1_a_1", "train_1_b_2", "train_2_a_1"):
        place = folder / scan[:7] / scan[:9]
        place.mkdir(parents=True, exist_ok=True)
        (place / f"{scan}.nii.gz").write_bytes((cts / "patient0.nii.gz").read_bytes())
    (tmp_path / "reports.csv").write_text("VolumeName,Findings_EN,Impressions_EN\n" + "".join(
        f"{scan}.nii.gz,Words of {scan}.,\n" for scan in ("train_1_a_1", "train_1_b_2", "train_2_a_1")))
    data = PriorData(str(folder), CTSource(reports=str(tmp_path / "reports.csv")), HoldOut(["train_1_a"], phantoms=1),
                     phantoms=2, cache=str(tmp_path / "cache"), cube=Cube(16))
    assert [ct.id for ct in data.cts.cts] == ["train_2_a_1"] and len(data.held_out) == 2
    assert [words for words in data.reports if "Words of" in words] == [
        words for words in data.reports if "train_2" in words] != []


def test_a_gpu_that_is_not_there_is_not_asked_for_its_precision(cache, tmp_path, monkeypatch):
    def accelerator(check_available=False):  # what a CUDA build of PyTorch answers on a machine without a GPU
        return None if check_available else torch.device("cuda")

    monkeypatch.setattr(torch.accelerator, "current_accelerator", accelerator)
    args = [arg for arg in arguments(tmp_path, cache, "--trainer.max_steps=1", "--trainer.limit_val_batches=0")
            if "accelerator" not in arg and "--precision" not in arg]
    main(args)
    assert (tmp_path / "last.ckpt").exists()


def test_the_held_out_cts_are_written_down_and_told(cts, cache, tmp_path, capsys):
    args = arguments(tmp_path, cache, "--trainer.max_epochs=1", "--trainer.limit_train_batches=1",
                     "--trainer.limit_val_batches=0", f"--data.cts={cts}")
    main([*args, "--data.holdout.ids=[patient1]"])
    assert (tmp_path / "held_out.txt").read_text() == "patient1\n"
    assert checkpoint(tmp_path)["phydict"]["training"]["held_out"] == ["patient1"]
    assert "1 of 2 CTs are held out for validation, beside phantoms" in capsys.readouterr().err
    main([*args, f"--out={tmp_path / 'all'}"])
    assert checkpoint(tmp_path / "all")["phydict"]["training"]["held_out"] == []
    assert "no CT is held out, so that phantoms alone validate: data.holdout.ids may" in capsys.readouterr().err


def test_a_training_resumes_with_the_same_cts_held_out(cts, cache, tmp_path, capsys):
    args = arguments(tmp_path / "run", cache, "--trainer.limit_train_batches=1", "--trainer.limit_val_batches=0",
                     f"--data.cts={cts}", "--model.text.encoder=none", "--trainer.max_epochs=1")
    main([*args, "--data.holdout.ids=[patient1]"])
    more = ["--trainer.max_epochs=2", f"--ckpt_path={tmp_path / 'run' / 'last.ckpt'}", f"--out={tmp_path / 'on'}"]
    assert "patient0 is held out now" in refusal(capsys, main, [*args, *more, "--data.holdout.ids=[patient]"])
    assert "patient1 is not held out now" in refusal(capsys, main, [*args, *more])
    assert not (tmp_path / "on" / "held_out.txt").exists()
    main([*args, *more, "--data.holdout.ids=[patient1]"])
    assert (tmp_path / "on" / "held_out.txt").read_text() == "patient1\n"


def test_last_begins_a_training_as_if_it_were_left_out_and_then_goes_on_with_it(cts, cache, tmp_path, capsys):
    args = arguments(tmp_path, cache, "--trainer.limit_train_batches=1", "--trainer.limit_val_batches=0",
                     f"--data.cts={cts}", "--model.text.encoder=none", "--data.holdout.ids=[patient1]",
                     "--ckpt_path=last")
    for word, command in (("best", "fit"), ("best", "validate"), ("last", "validate")):
        said = refusal(capsys, main, [command, *args[1:-1], f"--ckpt_path={word}"])
        assert str(tmp_path / f"{word}.ckpt") in said
    for epochs in (1, 2):
        main([*args, f"--trainer.max_epochs={epochs}"])
        assert (tmp_path / "held_out.txt").read_text() == "patient1\n" and checkpoint(tmp_path)["epoch"] == epochs - 1


def test_a_resumed_run_learns_at_the_rate_and_decay_that_are_given(trained, cache, tmp_path, monkeypatch):
    reads, load = [], torch.load
    monkeypatch.setattr(torch, "load", lambda *given, **more: (reads.append(given), load(*given, **more))[1])
    main(arguments(tmp_path, cache, "--trainer.max_epochs=3", "--trainer.limit_val_batches=0",
                   f"--ckpt_path={trained / 'last.ckpt'}", "--model.optimisation.learning_rate=1e-3",
                   "--model.optimisation.weight_decay=0.5"))
    assert len(reads) == 2  # before anything is made, and to go on from it
    resumed = checkpoint(tmp_path)
    for group in resumed["optimizer_states"][0]["param_groups"]:
        assert group["lr"] == group["initial_lr"] == 1e-3 and group["weight_decay"] == 0.5
    assert resumed["lr_schedulers"][0]["base_lrs"] == [1e-3]


@pytest.mark.parametrize("steps, said", [(40, "nothing is learnt after step 30"), (20, "it does not come to 0"),
                                         (30, None), (-1, None)])
def test_a_training_that_does_not_end_with_its_decay_is_warned_of(monkeypatch, recwarn, steps, said):
    task = RefinementTraining((8, 8), optimisation=Optimisation(decay_from=10, decay_steps=20))
    monkeypatch.setattr(RefinementTraining, "trainer", SimpleNamespace(max_steps=steps, callbacks=[]))
    task.on_fit_start()
    told = f"falls to 0 from step 10 to 30, but trainer.max_steps is {steps}, so that {said}"
    assert [told in str(warning.message) for warning in recwarn] == [True] * bool(said)


def test_a_run_that_stopped_within_an_epoch_goes_on_with_the_draws_after_it(tmp_path, cache, monkeypatch):
    drawn, item = [], MixedCases.__getitem__
    monkeypatch.setattr(MixedCases, "__getitem__", lambda draws, i: (
        drawn.append((draws.epoch, i)), item(draws, i))[1])
    args = arguments(tmp_path, cache, "--trainer.limit_val_batches=0", "--model.text.encoder=none")
    main([*args, "--trainer.max_steps=3"])
    main([*args, "--trainer.max_steps=6", f"--ckpt_path={tmp_path / 'last.ckpt'}"])
    assert drawn[:12] == [(0, i) for i in range(8)] + [(1, i) for i in range(4)]


def test_a_run_that_stopped_at_an_epochs_last_batch_goes_on_with_the_next_ones_first(tmp_path, cache, monkeypatch):
    drawn, item = [], MixedCases.__getitem__
    monkeypatch.setattr(MixedCases, "__getitem__", lambda draws, i: (
        drawn.append((draws.epoch, i)), item(draws, i))[1])
    args = arguments(tmp_path, cache, "--trainer.limit_val_batches=0", "--model.text.encoder=none",
                     "--data.loading.epoch_size=7", "--checkpoint.every_n_train_steps=3",
                     "--checkpoint.every_n_epochs=null", "--checkpoint.save_on_train_epoch_end=false")
    main([*args, "--trainer.max_steps=3"])
    before = len(drawn)
    main([*args, "--trainer.max_steps=5", f"--ckpt_path={tmp_path / 'last.ckpt'}"])
    assert drawn[before:before + 4] == [(1, i) for i in range(4)]


def ten_steps(folder: Path, cache: Path, *more: str) -> dict:
    """The checkpoint of ten steps that are validated now and then, by the error of denoising alone."""
    main(arguments(folder, cache, "--model.text.encoder=none", "--data.loading.epoch_size=4",
                   "--trainer.check_val_every_n_epoch=5", "--trainer.limit_val_batches=1", "--trainer.max_steps=10",
                   "--model.validation.views=0", *more))
    return checkpoint(folder)


@pytest.fixture(scope="module")
def straight(tmp_path_factory, cache) -> dict:
    return ten_steps(tmp_path_factory.mktemp("straight"), cache)


@pytest.mark.parametrize("stop", [4, 6])
def test_a_run_of_so_many_steps_that_validates_now_and_then_resumes_as_the_uninterrupted_one(straight, tmp_path, cache,
                                                                                             stop):
    ten_steps(tmp_path, cache, f"--trainer.max_steps={stop}")
    one, other = straight, ten_steps(tmp_path, cache, "--ckpt_path=last")
    assert one["global_step"] == other["global_step"] == 10 and one["epoch"] == other["epoch"]
    assert all(torch.equal(one["state_dict"][name], other["state_dict"][name]) for name in one["state_dict"])


def test_a_training_that_has_ended_says_that_nothing_is_left(trained, cache, tmp_path, capsys):
    main(arguments(tmp_path, cache, "--trainer.max_steps=8", f"--ckpt_path={trained / 'last.ckpt'}"))
    assert "is of step 8 already, and trainer.max_steps is 8: nothing is left to learn" in capsys.readouterr().err


def test_a_training_whose_time_is_over_says_so_and_one_whose_steps_are_over_does_not(trained, cache, tmp_path, capsys):
    main(arguments(tmp_path, cache, "--trainer.max_time=00:00:00:00", f"--ckpt_path={trained / 'last.ckpt'}",
                   "--trainer.max_epochs=3"))
    assert "trainer.max_time is over after step 8: to go on, give" in capsys.readouterr().err
    main(arguments(tmp_path / "ended", cache, "--trainer.max_time=00:01:00:00", "--trainer.limit_val_batches=0",
                   f"--ckpt_path={trained / 'last.ckpt'}", "--trainer.max_epochs=2"))
    assert "max_time" not in capsys.readouterr().err


def test_an_id_that_is_held_out_is_no_word_for_longer_ones(tmp_path):
    for name in ("1", "10", "21"):
        save_ct(tmp_path / "cts" / f"{name}.nii.gz", thorax_hu())
    held_out = [PriorData(str(tmp_path / "cts"), holdout=HoldOut([word], phantoms=1), cache=str(tmp_path / "cache"),
                          cube=Cube(16)).held_out for word in ("1", "2", "0")]
    assert held_out == [["1"], ["21"], ["10"]]


def test_no_phantom_both_tests_and_validates_or_is_trained_on(tmp_path):
    data = PriorData(holdout=HoldOut(phantoms=2), phantoms=2, cache=str(tmp_path), cube=Cube(16))
    tested = ReconstructionData(cts="phantom", phantoms=1000).test_cases(data.grid, data.window)
    seeds = [range(part.first_seed, part.first_seed + len(part)) for part in (
        data.phantoms, data.validation.datasets[0])]
    tested = {int(case[0].removeprefix("phantom-")) for case in tested}
    assert not tested & {*seeds[0], *seeds[1]} and not {*seeds[0]} & {*seeds[1]}


def test_it_is_said_that_no_ct_is_held_out(cts, tmp_path):
    with pytest.warns(UserWarning, match="no CT is held out, since 0.2 of 1 is none"):
        PriorData(str(cts / "patient0.nii.gz"), holdout=HoldOut(fraction=0.2), phantoms=2, cache=str(tmp_path))


def test_a_signal_is_no_success(cache, tmp_path):
    train = Python(TRAIN, *arguments(tmp_path, cache, "--trainer.max_epochs=9999"))
    train.wait_for((tmp_path / "last.ckpt").exists)
    train.process.terminate()
    assert train.wait(60) == 143 and "--ckpt_path" in train.err.splitlines()[-1], train.err


def test_a_damaged_phantom_in_the_cache_is_made_again(tmp_path):
    phantoms = CachedPhantoms(0, 1, Grid.cube(16), HUWindow(), tmp_path)
    with pytest.warns(match="prepared again"):
        first, file = phantoms[0], next(tmp_path.rglob("*.npz"))
        file.write_bytes(file.read_bytes()[:500])
        again = phantoms[0]
    assert torch.equal(first["volume"], again["volume"]) and torch.equal(first["masks"], again["masks"])


def test_phantoms_on_other_voxels_of_as_many_are_others(tmp_path):
    longer = Grid((16, 16, 16), spacing=(24.0, 24.0, 12.0))
    one, other = (CachedPhantoms(0, 1, grid, HUWindow(), tmp_path)[0]["volume"] for grid in (Grid.cube(16), longer))
    assert not torch.equal(one, other)
    assert torch.equal(CachedPhantoms(0, 1, Grid.cube(16), HUWindow(), tmp_path)[0]["volume"], one)
