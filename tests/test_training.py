"""Training: the loss falls, a resumed run is the uninterrupted one, and a checkpoint becomes a prior."""

from __future__ import annotations

import os
import resource
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import nibabel
import numpy as np
import pytest
import torch
from command_lines import CONFIG, TINY, arguments, checkpoint, losses, refusal
from prior.medsyn_files import entries, text_unet, write
from prior.tiny import REPORTS, tiny_prior
from torch.utils.data import default_collate

from phydict.cli.train import main
from phydict.datasets import phantom_case
from phydict.datasets.phantoms.cached import CachedPhantoms
from phydict.datasets.phantoms.findings import KINDS
from phydict.grid import Cube, Grid
from phydict.prior import VolumeUNet, load_prior, save_prior
from phydict.runtime.files import alone_in
from phydict.training import PriorTraining
from phydict.training.prior import reconstruction_scores
from phydict.training.data import PriorData
from phydict.training.settings import HoldOut, TextSettings
from phydict.units import HUWindow

@pytest.fixture(scope="module")
def straight(tmp_path_factory, cache) -> Path:
    """The folder of an uninterrupted run of two epochs."""
    folder = tmp_path_factory.mktemp("straight")
    main(arguments(folder, cache, "--trainer.max_epochs=2"))
    return folder


class Code:
    """What runs a command when it is unpickled."""

    def __reduce__(self):
        return os.system, ("exit 1",)


def test_the_loss_falls(tmp_path, cache):
    main(arguments(tmp_path, cache, "--trainer.max_epochs=8", "--model.optimisation.learning_rate=5e-3",
                   "--trainer.limit_val_batches=0"))
    loss = [float(value) for _, value in sorted(losses(tmp_path).items())]
    assert len(loss) == 32
    assert np.mean(loss[-8:]) < 0.7 * np.mean(loss[:4])


def test_a_log_file_tells_steps_in_whole_lines_and_nothing_of_lightnings(tmp_path, cache):
    for more in (["--trainer.max_steps=3"], ["--trainer.max_steps=6", f"--ckpt_path={tmp_path / 'last.ckpt'}"]):
        args = [arg for arg in arguments(tmp_path, cache, "--progress.interval=0") if "enable_" not in arg]
        run = subprocess.run([sys.executable, "-c", "from phydict.cli.train import main; main()", *args, *more],
                             capture_output=True, text=True, cwd=CONFIG.parents[2], timeout=300)
        assert run.returncode == 0, run.stderr[-2000:]
        said = (run.stdout + run.stderr).splitlines()
        last = f"step {more[0].split('=')[1]} of {more[0].split('=')[1]}: loss "
        assert any(line.startswith(last) and "samples_per_s" in line for line in said), said
        known = ("step ", "training", "report ", "sentences: ", "Seed")
        assert all(line.startswith(known) for line in said)


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


def test_a_killed_run_goes_on_as_if_it_had_not_been(tmp_path, straight, cache):
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
    done = subprocess.run([sys.executable, "-c", killed, *arguments(tmp_path, cache, "--trainer.max_epochs=2")],
                          capture_output=True, text=True, cwd=CONFIG.parents[2],
                          env=os.environ | {"OMP_NUM_THREADS": str(torch.get_num_threads())})  # sums in the same order
    assert done.returncode == -signal.SIGKILL, done.stderr[-2000:]
    assert checkpoint(tmp_path)["global_step"] == 4
    torch.manual_seed(99)  # the new process knows nothing of the old one's random numbers
    main(arguments(tmp_path, cache, "--trainer.max_epochs=2", f"--ckpt_path={tmp_path / 'last.ckpt'}",
                   "--seed_everything=5"))
    ours, theirs = checkpoint(tmp_path), checkpoint(straight)
    for weights in ("state_dict", "current_model_state"):
        assert ours[weights].keys() == theirs[weights].keys()
        different = [name for name, weight in ours[weights].items() if not torch.equal(weight, theirs[weights][name])]
        assert not different, weights
    assert any(not torch.equal(w, ours["current_model_state"][k]) for k, w in ours["state_dict"].items())
    resumed, expected = losses(tmp_path), losses(straight)
    assert {step: resumed[step] for step in range(4, 8)} == {step: expected[step] for step in range(4, 8)}
    assert ours["phydict"]["training"] == {"steps": 8, "samples": 16}


@pytest.mark.parametrize("before", [False, True], ids=["at once", "after a checkpoint"])
def test_a_loss_that_is_not_finite_stops_the_training(tmp_path, cache, capsys, monkeypatch, before):
    loss, at = PriorTraining.batch_loss, 5 if before else 1
    monkeypatch.setattr(PriorTraining, "batch_loss", lambda task, *given: loss(task, *given) * (
        float("nan") if task.global_step == at else 1))
    said = refusal(capsys, main, arguments(tmp_path, cache, "--trainer.max_epochs=2", "--trainer.limit_val_batches=0"))
    assert f"the loss is nan after {at} steps" in said
    assert (f"the last good checkpoint is {tmp_path / 'last.ckpt'}" if before else "no checkpoint") in said
    assert not before or checkpoint(tmp_path)["global_step"] == 4


@pytest.mark.parametrize("validated", [True, False])
def test_weights_that_are_not_finite_never_replace_a_checkpoint(tmp_path, cache, capsys, monkeypatch, validated):
    def spoil(task: PriorTraining, *_) -> None:
        if task.global_step == 8:
            task.prior.null.data.view(-1)[3] = float("nan")

    monkeypatch.setattr(PriorTraining, "on_train_batch_end", spoil)
    more = [] if validated else ["--trainer.limit_val_batches=0"]
    said = refusal(capsys, main, arguments(tmp_path, cache, "--trainer.max_epochs=3", *more))
    assert "the weights are not finite after 8 steps (prior.null has 1 NaN" in said and "last.ckpt" in said
    assert checkpoint(tmp_path)["global_step"] == 4
    assert not validated or torch.load(tmp_path / "best.ckpt", weights_only=True)["global_step"] == 4


@pytest.fixture
def spoilt(straight, tmp_path) -> Path:
    """A checkpoint of which one weight is NaN."""
    content = checkpoint(straight)
    content["state_dict"]["prior.null"].view(-1)[3] = float("nan")
    torch.save(content, tmp_path / "spoilt.ckpt")
    return tmp_path / "spoilt.ckpt"


def test_weights_that_are_not_finite_are_refused_by_name(spoilt, cache, tmp_path, capsys):
    for args in (["export", f"--checkpoint={spoilt}", f"--out={tmp_path / 'prior.safetensors'}"],
                 ["inspect-prior", str(spoilt)],
                 arguments(tmp_path / "run", cache, f"--ckpt_path={spoilt}")):
        said = refusal(capsys, main, args)
        assert "spoilt.ckpt" in said and "not finite (prior.null has 1 NaN or infinite values of 64)" in said
    assert [path.name for path in tmp_path.iterdir()] == ["spoilt.ckpt"]


def test_a_checkpoint_that_the_disk_cannot_hold_leaves_the_last_one(tmp_path, cache, capsys):
    short = ["--trainer.limit_train_batches=1", "--trainer.limit_val_batches=0"]
    main(arguments(tmp_path, cache, "--trainer.max_epochs=1", *short))
    last, limits = (tmp_path / "last.ckpt").read_bytes(), resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (len(last) // 2, limits[1]))  # no file may grow beyond half of it
    try:
        said = refusal(capsys, main, arguments(tmp_path, cache, "--trainer.max_epochs=2", *short,
                                         f"--ckpt_path={tmp_path / 'last.ckpt'}"))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert "last.ckpt could not be written" in said and "--ckpt_path" in said
    assert (tmp_path / "last.ckpt").read_bytes() == last and not list(tmp_path.rglob("*.part.*"))


def test_an_exported_checkpoint_is_a_prior_with_the_averaged_weights(tmp_path, straight, capsys):
    file = tmp_path / "prior" / "tiny.safetensors"
    main(["export", f"--checkpoint={straight / 'last.ckpt'}", "--out", str(file)])
    assert str(file) in capsys.readouterr().out
    prior = load_prior(file)
    averaged = checkpoint(straight)["state_dict"]
    for name, weight in prior.state_dict().items():
        assert torch.equal(weight, averaged[f"prior.{name}"].half().float()), name
    assert prior.grid.shape == (16, 16, 16) and prior.window.low == -1000
    prior.bind("Large left pleural effusion.")  # loads the text encoder
    for name, weight in prior.text.state_dict().items():
        assert torch.equal(weight, averaged[f"prior.text.{name}"].half().float()), name


def test_validation_logs_every_noise_level_and_paints_a_montage(straight):
    log = next(straight.glob("logs/**/metrics.csv")).read_text().splitlines()[0].split(",")
    assert {f"val/rmse_hu_t{t}" for t in (0.1, 0.3, 0.5, 0.7, 0.9)} | {"val/rmse_hu"} <= set(log)
    assert [file.name for file in sorted(straight.glob("logs/**/samples/*.png"))] == [
        "step000004_0.png", "step000008_0.png"]


def test_the_checkpoint_that_reconstructs_best_is_kept(tmp_path, cache, monkeypatch):
    scores = iter((10.0, 30.0, 20.0))
    monkeypatch.setattr("phydict.training.prior.reconstruction_scores",
                        lambda *_: {"psnr": next(scores), "ssim": 0.5})
    main(arguments(tmp_path, cache, "--trainer.max_epochs=3"))
    best = torch.load(tmp_path / "best.ckpt", map_location="cpu", weights_only=True)
    assert best["global_step"] == 8 and checkpoint(tmp_path)["global_step"] == 12
    assert {step: float(value) for step, value in losses(tmp_path, "val/psnr").items()} == {3: 10, 7: 30, 11: 20}
    assert [float(value) for value in losses(tmp_path, "samples").values()] == [8, 16, 24]
    main(["export", f"--checkpoint={tmp_path / 'best.ckpt'}", f"--out={tmp_path / 'prior.safetensors'}"])
    assert load_prior(tmp_path / "prior.safetensors").grid.shape == (16, 16, 16)


def test_without_validation_views_nothing_is_reconstructed_or_kept(tmp_path, cache):
    main(arguments(tmp_path, cache, "--trainer.max_epochs=1", "--model.validation.views=0"))
    assert "val/psnr" not in next(tmp_path.glob("logs/**/metrics.csv")).read_text()
    assert not (tmp_path / "best.ckpt").exists() and (tmp_path / "last.ckpt").exists()


def test_more_views_reconstruct_a_held_out_case_better():
    prior = tiny_prior()
    ct = phantom_case(0, prior.grid, prior.window)["volume"][None]
    few, many = (reconstruction_scores(prior, ct, views, seed=0) for views in (2, 32))
    assert many["psnr"] > few["psnr"] + 3 and many["ssim"] > few["ssim"]


@pytest.fixture(scope="module")
def cts(tmp_path_factory) -> Path:
    """A folder of two small CTs."""
    folder = tmp_path_factory.mktemp("cts")
    for n in range(2):
        hu = np.full((20, 20, 20), -1000, np.int16)
        hu[4:16, 6:15, :] = 40 + n
        image = nibabel.Nifti1Image(hu, np.diag([10.0, 10.0, 10.0, 1.0]))
        image.set_sform(image.affine, code=1)
        nibabel.save(image, folder / f"patient{n}.nii.gz")
    return folder


def test_held_out_cts_only_validate_and_draws_mix_cts_with_phantoms(cts, tmp_path):
    data = PriorData(str(cts), holdout=HoldOut(["patient1"], phantoms=1), phantoms=2, cache=str(tmp_path),
                     cube=Cube(16))
    assert [ct.id for ct in data.cts.cts] == ["patient0"]
    assert [ct.id for ct in data.validation.datasets[1].cts] == ["patient1"]
    both = [{key: case[key] for key in ("volume", "masks", "has_masks")} for case in (data.phantoms[0], data.cts[0])]
    for pair in (both, both[::-1]):  # in either order, as a loader process writes into the first case's dtype
        assert default_collate(pair)["has_masks"].dtype == torch.bool


@pytest.mark.parametrize("change, words", [
    (["--data.phantoms=0"], ["nothing to train on"]),
    (["--data.cts=/nowhere/at/all"], ["/nowhere/at/all"]),
    (["--data.holdout.ids=[nobody]", "--data.cts={cts}"], ["nobody", "patient0"]),
    (["--data.holdout.ids=[patient]", "--data.cts={cts}", "--data.phantoms=0"], ["nothing to train on"]),
    (["--data.cts={cts}", "--data.cache={cts}/cache"], ["inside"]),
    (["--data.cts={cts}", "--data.holdout.ids=[patient1]", "--data.loading.population.share=0.5"],
     ["at least 2 patients", "there is 1", "patient0"]),
    (["--data.loading.population.share=0.5"], ["at least 2 patients", "there are 0"]),
    (["--data.loading.population.variation.lungs=3"], ["variation.lungs", "3"]),
    (["--data.loading.epoch_size=1"], ["epoch_size", "batch"]),
    (["--data.lungs=2"], ["data.lungs"]),
    (["--data.augmentation.shift=-5"], ["shift", "-5"]),
    (["--throughput.peak=0"], ["throughput.peak"]),
    (["--model.cube.voxels=15"], ["15", "divisible"]),
    (["--ckpt_path=/nowhere/last.ckpt"], ["/nowhere/last.ckpt"]),
    (["--ckpt_path={cut}"], ["cut.ckpt", "truncated"]),
], ids=lambda value: value[0].split("=")[0].strip("-") if isinstance(value, list) and value[0][0] == "-" else "")
def test_bad_input_is_one_sentence(change, words, cts, straight, cache, tmp_path, capsys):
    whole = (straight / "last.ckpt").read_bytes()
    (tmp_path / "cut.ckpt").write_bytes(whole[:len(whole) // 2])
    change = [text.format(cts=cts, cut=tmp_path / "cut.ckpt") for text in change]
    said = refusal(capsys, main, arguments(tmp_path / "run", cache, "--trainer.max_epochs=1", *change))
    assert all(word in said for word in words), said
    assert not list((tmp_path / "run").glob("*.ckpt"))


def test_a_second_training_never_overwrites_a_first(straight, cache, capsys):
    before = (straight / "last.ckpt").read_bytes()
    said = refusal(capsys, main, arguments(straight, cache, "--trainer.max_epochs=1"))
    assert str(straight) in said and "--ckpt_path" in said and "--out" in said
    assert (straight / "last.ckpt").read_bytes() == before


@pytest.mark.parametrize("name", ["last.ckpt", "best.ckpt"])
def test_a_training_that_goes_on_elsewhere_overwrites_no_other(straight, cache, tmp_path, capsys, name):
    (tmp_path / name).write_bytes(b"another's")
    for more in ([], [f"--ckpt_path={straight / 'last.ckpt'}"]):
        said = refusal(capsys, main, arguments(tmp_path, cache, "--trainer.max_epochs=3", *more))
        assert f"--ckpt_path {tmp_path / name}" in said and "--out" in said
    assert (tmp_path / name).read_bytes() == b"another's"


def test_of_two_trainings_at_once_in_one_folder_the_second_is_refused(cache, tmp_path, capsys, monkeypatch):
    short = ["--data.loading.epoch_size=2", "--trainer.limit_val_batches=0", "--model.text.encoder=none"]
    step, met = PriorTraining.training_step, []

    def meanwhile(task, batch, index):
        if len(met) <= task.current_epoch:
            met.append(sorted(tmp_path.rglob("*")))
            more = [f"--ckpt_path={tmp_path / 'last.ckpt'}"] if task.current_epoch else []
            said = refusal(capsys, main, arguments(tmp_path, cache, "--trainer.max_epochs=3", *short, *more))
            assert f"another run writes to {tmp_path}: wait for its end, or give another --out" in said
            assert sorted(tmp_path.rglob("*")) == met[-1]
        return step(task, batch, index)

    monkeypatch.setattr(PriorTraining, "training_step", meanwhile)
    main(arguments(tmp_path, cache, "--trainer.max_epochs=2", *short))
    assert len(met) == 2 and checkpoint(tmp_path)["global_step"] == 2


def test_a_killed_run_leaves_its_folder_free_even_while_its_loaders_live_on(tmp_path):
    code = """if True:
        import os, sys, time
        from pathlib import Path
        from phydict.runtime.files import alone_in
        with alone_in(Path(sys.argv[1]), "--out"):
            if os.fork() == 0:
                print(os.getpid(), flush=True)
            time.sleep(60)"""
    run = subprocess.Popen([sys.executable, "-c", code, str(tmp_path)], stdout=subprocess.PIPE, text=True,
                           cwd=CONFIG.parents[2])
    loader = int(run.stdout.readline())
    with pytest.raises(ValueError, match="another run"), alone_in(tmp_path, "--out"):
        pass
    run.kill()
    run.wait(60)
    with alone_in(tmp_path, "--out"):
        os.kill(loader, signal.SIGKILL)  # was alive until now


def test_a_gpu_that_is_not_there_is_not_asked_for_its_precision(cache, tmp_path, monkeypatch):
    def accelerator(check_available=False):  # what a CUDA build of PyTorch answers on a machine without a GPU
        return None if check_available else torch.device("cuda")

    monkeypatch.setattr(torch.accelerator, "current_accelerator", accelerator)
    args = [arg for arg in arguments(tmp_path, cache, "--trainer.max_steps=1", "--trainer.limit_val_batches=0")
            if "accelerator" not in arg and "--precision" not in arg]
    main(args)
    assert (tmp_path / "last.ckpt").exists()


@pytest.mark.parametrize("command", ["fit", "validate"])
def test_a_missing_configuration_says_which_to_give(command, cache, tmp_path, capsys):
    args = [command, *TINY, "--trainer.max_epochs=1", f"--data.cache={cache}", f"--out={tmp_path / 'run'}"]
    assert "no configuration file was given: add -c <file>, such as -c configs/prior/phantom.yaml" in refusal(
        capsys, main, args)
    assert not (tmp_path / "run").exists()


def test_a_list_of_someone_elses_is_not_replaced(cts, cache, tmp_path, capsys):
    (tmp_path / "held_out.txt").write_text("mine\n")
    said = refusal(capsys, main, arguments(tmp_path, cache, "--trainer.max_epochs=1", f"--data.cts={cts}",
                                     "--data.holdout.ids=[patient1]"))
    assert "held_out.txt is there already" in said and (tmp_path / "held_out.txt").read_text() == "mine\n"


def test_an_export_replaces_a_prior_when_asked_and_nothing_else_ever(straight, tmp_path, capsys):
    file = tmp_path / "prior.safetensors"
    args = ["export", f"--checkpoint={straight / 'last.ckpt'}", f"--out={file}"]
    file.write_bytes(b"mine")
    for more in ([], ["--overwrite=true"]):
        assert "is no prior of phydict's, and is not replaced" in refusal(capsys, main, [*args, *more])
    assert file.read_bytes() == b"mine"
    save_prior(tiny_prior(), file)
    before = file.read_bytes()
    assert "add --overwrite true" in refusal(capsys, main, args) and file.read_bytes() == before
    main([*args, "--overwrite=true"])
    assert load_prior(file).window.high == 1000


@pytest.mark.parametrize("change, key", [(["--model.cube.voxels=24"], "grid"), (["--model.text.encoder=none"], "text"),
                                         (["--model.window=[-1000,600]"], "hu_window")])
def test_a_checkpoint_is_resumed_only_as_what_it_is(change, key, straight, cache, tmp_path, capsys):
    resumed = ["--trainer.max_epochs=3", f"--ckpt_path={straight / 'last.ckpt'}"]
    said = refusal(capsys, main, arguments(tmp_path, cache, *resumed, *change))
    assert f"'{key}'" in said and not (tmp_path / "last.ckpt").exists()


def test_validation_needs_trained_weights(cache, tmp_path, capsys):
    args = [arg for arg in arguments(tmp_path, cache)[1:] if "max_steps" not in arg]
    assert "--ckpt_path" in refusal(capsys, main, ["validate", *args])


def test_the_held_out_cts_are_written_down(cts, cache, tmp_path):
    main(arguments(tmp_path, cache, "--trainer.max_epochs=1", "--trainer.limit_train_batches=1",
                   "--trainer.limit_val_batches=0", f"--data.cts={cts}", "--data.holdout.ids=[patient1]"))
    assert (tmp_path / "held_out.txt").read_text() == "patient1\n"


def test_a_signal_is_no_success(cache, tmp_path):
    train = subprocess.Popen(
        [sys.executable, str(CONFIG.parents[2] / "train.py"), *arguments(tmp_path, cache, "--trainer.max_epochs=9999")],
        stderr=subprocess.PIPE, text=True)
    for _ in range(600):
        if (tmp_path / "last.ckpt").exists():
            break
        time.sleep(0.1)
    train.terminate()
    _, said = train.communicate(timeout=60)
    assert train.returncode == 143 and "--ckpt_path" in said.splitlines()[-1], said


def test_a_damaged_phantom_in_the_cache_is_made_again(tmp_path):
    phantoms = CachedPhantoms(0, 1, Grid.cube(16), HUWindow(), tmp_path)
    with pytest.warns(match="prepared again"):
        first, file = phantoms[0], next(tmp_path.rglob("*.npz"))
        file.write_bytes(file.read_bytes()[:500])
        again = phantoms[0]
    assert torch.equal(first["volume"], again["volume"]) and torch.equal(first["masks"], again["masks"])


def test_an_unknown_key_of_a_config_file_is_named(tmp_path, cache, capsys):
    config = tmp_path / "mine.yaml"
    config.write_text("model:\n  learning_rats: 1.0\n")
    assert "model.learning_rats" in refusal(capsys, main, arguments(tmp_path, cache, f"--config={config}"))


def test_a_loader_process_sends_the_message_too(cts, tmp_path, cache, capsys):
    (tmp_path / "cts").mkdir()
    (tmp_path / "cts" / "cut.nii.gz").write_bytes((cts / "patient0.nii.gz").read_bytes()[:200])
    said = refusal(capsys, main, arguments(tmp_path / "run", cache, "--trainer.max_epochs=1",
                                     f"--data.cts={tmp_path / 'cts'}", "--data.phantoms=0",
                                     "--data.loading.workers=1", "--model.text.encoder=none"))
    assert "cut.nii.gz" in said and "Traceback" not in said


@pytest.mark.parametrize("spoil, words", [
    (lambda file, whole: file.write_bytes(whole[:-1000]), ["truncated"]),
    (lambda file, whole: torch.save({"state_dict": {}}, file), ["no checkpoint of a prior"]),
    (lambda file, whole: torch.save({"phydict": {}, "code": Code()}, file), ["asks for code (posix.system)"]),
    (lambda file, whole: None, ["there is no checkpoint"]),
])
def test_what_cannot_be_exported_is_one_sentence(spoil, words, straight, tmp_path, capsys):
    file, out = tmp_path / "spoilt.ckpt", tmp_path / "out.safetensors"
    spoil(file, (straight / "last.ckpt").read_bytes())
    said = refusal(capsys, main, ["export", f"--checkpoint={file}", f"--out={out}"])
    assert all(word in said for word in [*words, "spoilt.ckpt"]), said
    assert not out.exists()


def test_inspecting_tells_what_training_and_medsyn_left(straight, tmp_path, capsys):
    main(["inspect-prior", str(straight / "last.ckpt")])
    told = capsys.readouterr().out
    assert told.startswith(f"{straight / 'last.ckpt'}\n  kind: phydict training checkpoint") and "16 x 16 x 16" in told
    write(tmp_path / "5_ckpt" / "model.safetensors", entries(text_unet()))
    main(["inspect-prior", str(tmp_path)])
    assert "kind: MedSyn's 64^3 stage" in capsys.readouterr().out
    assert "nowhere" in refusal(capsys, main, ["inspect-prior", str(tmp_path / "nowhere")])


@pytest.mark.parametrize("out", ["folder.safetensors", "file/prior.safetensors"])
def test_an_export_that_cannot_be_written_leaves_nothing(out, straight, tmp_path, capsys):
    (tmp_path / "folder.safetensors").mkdir()
    (tmp_path / "file").write_text("")
    said = refusal(capsys, main, ["export", f"--checkpoint={straight / 'last.ckpt'}", f"--out={tmp_path / out}"])
    assert out in said and "--out" in said
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["file", "folder.safetensors"]


def two_processes(folder: Path, cache: Path, config: str, *more: str) -> subprocess.CompletedProcess:
    """One epoch by two processes on one sample each per step, with a configuration for several devices."""
    args = arguments(folder, cache, f"--config={CONFIG.with_name(config)}", "--trainer.max_epochs=1",
                     "--data.loading.batch_size=1", "--trainer.devices=2", *more)
    return subprocess.run([sys.executable, str(CONFIG.parents[2] / "train.py"), *args], capture_output=True, text=True,
                          env=os.environ | {"OMP_NUM_THREADS": "1"}, timeout=300)


def assert_same_curve(folder: Path, straight: Path, column: str = "loss", tolerance: float = 1e-4) -> None:
    """The logged numbers of one epoch are those of the uninterrupted one-process run, to rounding: sums are taken in
    another order, which Adam carries on."""
    expected = {step: float(value) for step, value in losses(straight, column).items() if step < 4}
    found = {step: float(value) for step, value in losses(folder, column).items()}
    assert found == pytest.approx(expected, rel=tolerance)


def test_two_processes_train_the_prior_that_one_would(tmp_path, cache, straight):
    done = two_processes(tmp_path, cache, "ddp.yaml")
    assert done.returncode == 0, done.stderr[-2000:]
    for column in ("loss", "val/rmse_hu", "val/rmse_hu_t0.5", "samples"):
        assert_same_curve(tmp_path, straight, column)
    assert_same_curve(tmp_path, straight, "val/psnr", tolerance=1e-3)  # ten calls of the network carry rounding on
    assert checkpoint(tmp_path)["phydict"]["training"] == {"steps": 4, "samples": 8}
    assert list(tmp_path.glob("logs/**/samples/*.png"))


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
def test_two_processes_with_half_the_weights_each_train_the_prior_that_one_would(tmp_path, cache, straight):
    done = two_processes(tmp_path, cache, "fsdp.yaml")
    assert done.returncode == 0, done.stderr[-2000:]
    assert_same_curve(tmp_path, straight)
    assert list(tmp_path.glob("logs/**/samples/*.png"))
    again = two_processes(tmp_path, cache, "fsdp.yaml", f"--ckpt_path={tmp_path / 'last.ckpt'}",
                          "--trainer.max_epochs=2")
    assert again.returncode == 0, again.stderr[-2000:]
    expected = {step: float(value) for step, value in losses(straight).items() if step >= 4}
    assert {step: float(value) for step, value in losses(tmp_path).items()} == pytest.approx(expected, rel=1e-3)
    main(["export", f"--checkpoint={tmp_path / 'last.ckpt'}", f"--out={tmp_path / 'prior.safetensors'}"])
    assert load_prior(tmp_path / "prior.safetensors").grid.shape == (16, 16, 16)


@pytest.mark.slow
def test_spread_weights_are_not_averaged(tmp_path, cache):
    done = two_processes(tmp_path, cache, "fsdp.yaml",
                         "--trainer.callbacks=lightning.pytorch.callbacks.EMAWeightAveraging")
    assert done.returncode != 0 and "spread weights cannot be averaged" in done.stderr, done.stderr[-2000:]


@pytest.mark.parametrize("flags, tolerance", [
    (["--model.execution.gradient_checkpointing=true"], 1e-6), (["--model.execution.channels_last=false"], 1e-4),
    (["--precision=bfloat16"], 0.03)], ids=["checkpointing", "layout", "bf16"])
def test_flags_leave_the_loss_and_their_checkpoint_goes_on_without_them(flags, tolerance, straight, cache, tmp_path):
    main(arguments(tmp_path, cache, "--trainer.max_epochs=1", "--trainer.limit_val_batches=0", *flags))
    loss, expected = losses(tmp_path), losses(straight)
    for step in range(4):
        assert float(loss[step]) == pytest.approx(float(expected[step]), rel=tolerance)
    main(arguments(tmp_path, cache, "--trainer.max_epochs=2", "--trainer.limit_val_batches=0",
                   f"--ckpt_path={tmp_path / 'last.ckpt'}"))
    assert checkpoint(tmp_path)["state_dict"].keys() == checkpoint(straight)["state_dict"].keys()
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


def test_a_dropped_report_is_none_at_all(cache):
    data = PriorData(phantoms=4, cache=str(cache), cube=Cube(16))
    batch = default_collate([data.phantoms[i] for i in range(4)])
    silent = batch | {"report": [""] * 4}
    for dropout, heard in ((0.0, True), (1.0, False)):
        task = PriorTraining(tiny_prior().network, TextSettings(reports=data.reports, dropout=dropout), cube=Cube(16))
        with torch.no_grad():
            assert (task.batch_loss(batch) != task.batch_loss(silent)) == heard


def test_training_goes_on_from_a_prior_and_refuses_one_of_another_grid(tmp_path):
    path = tmp_path / "prior.safetensors"
    first = tiny_prior()
    save_prior(first, path, dtype=torch.float32)
    task = PriorTraining(initial=str(path), cube=Cube(16), window=(-1000, 600), text=TextSettings("none"))
    x, t = torch.randn(1, 4, 16, 16, 16), torch.tensor([0.4])
    reports = ["Pleural effusion (right), 12 mm."]
    torch.testing.assert_close(task.prior(x, t, task.prior.context(reports)), first(x, t, first.context(reports)))
    for name, weight in task.prior.named_parameters():
        assert weight.requires_grad != name.startswith(("text.", "network.text_map.", "null")), name
    task = PriorTraining(initial=str(path), cube=Cube(16), window=(-1000, 600), text=TextSettings(frozen=False))
    assert all(w.requires_grad for w in task.prior.parameters())
    with pytest.raises(ValueError, match="another grid"):
        PriorTraining(initial=str(path), cube=Cube(32), window=(-1000, 600), text=TextSettings("none"))


def test_text_that_is_kept_is_taught_first_and_not_moved_by_denoising(cache):
    data = PriorData(phantoms=4, cache=str(cache), cube=Cube(16))
    for frozen in (True, False):
        text = TextSettings(reports=data.reports, pretrain_steps=2, frozen=frozen)
        task = PriorTraining(VolumeUNet(4, 2, (8, 8), (False, True), 1, 8), text, cube=Cube(16))
        untaught = {name: weight.clone() for name, weight in task.prior.state_dict().items()}
        task.learn_reports()
        taught = {name: weight.clone() for name, weight in task.prior.state_dict().items()}
        text_side = {name for name in taught if name.startswith(("text.", "network.text_map.", "null"))}
        moved = {name for name in taught if not torch.equal(taught[name], untaught[name])}
        assert moved and moved < text_side and "null" not in moved
        task.prior.network.hint.weight.data.normal_()
        task.prior.network.unfold.weight.data.normal_()
        optimizer = task.configure_optimizers()["optimizer"]
        task.batch_loss(default_collate([data.phantoms[i] for i in range(4)])).backward()
        optimizer.step()
        moved = {name for name, weight in task.prior.state_dict().items() if not torch.equal(taught[name], weight)}
        assert bool(moved & text_side) != frozen and moved - text_side


def test_a_prior_gets_a_new_text_side_and_is_the_same_without_a_report(tmp_path):
    path = tmp_path / "prior.safetensors"
    first = tiny_prior()
    torch.nn.init.zeros_(first.network.hint.weight)
    torch.nn.init.zeros_(first.network.hint.bias)
    save_prior(first, path, dtype=torch.float32)
    settings = {"initial": str(path), "cube": Cube(16), "window": (-1000, 600)}
    text = TextSettings(reports=REPORTS, pretrain_steps=2)
    kept, renewed = (PriorTraining(text=replace(text, renew=renew), **settings) for renew in (False, True))
    assert kept.prior.text.vocabulary == first.text.vocabulary and not hasattr(kept.prior.network.text_map, "kinds")
    assert renewed.prior.network.text_map.kinds == KINDS and "effusion" in renewed.prior.text.vocabulary
    x, t = torch.randn(1, 4, 16, 16, 16), torch.tensor([0.4])
    for task in (kept, renewed):
        assert torch.equal(task.prior(x, t, task.prior.context([""])), first(x, t, first.context([""])))
    before = {name: weight.clone() for name, weight in kept.prior.state_dict().items()}
    for task in (kept, renewed):
        task.learn_reports()  # a new one alone
    assert all(torch.equal(weight, before[name]) for name, weight in kept.prior.state_dict().items())
    export = tmp_path / "renewed.safetensors"
    save_prior(renewed.prior, export, dtype=torch.float32)
    again = load_prior(export)
    assert torch.equal(again.network.text_map.scores(again.context(REPORTS[:1])),
                       renewed.prior.network.text_map.scores(renewed.prior.context(REPORTS[:1])))
    with pytest.raises(ValueError, match="model.initial"):
        PriorTraining(text=replace(text, renew=True), cube=Cube(16))


def test_a_small_encoder_knows_the_words_of_a_file_of_texts(tmp_path):
    (tmp_path / "texts.txt").write_text("Hamartoma with popcorn calcification.\n")
    for texts in (None, str(tmp_path / "texts.txt")):
        task = PriorTraining(VolumeUNet(4, 2, (8, 8), (False, True), 1, 8),
                             TextSettings(reports=["Clear lungs."], texts=texts), cube=Cube(16))
        assert ("hamartoma" in task.prior.text.vocabulary) == (texts is not None)


@pytest.mark.parametrize("weight", [torch.eye(3).to_sparse(), torch.zeros(3, device="meta")], ids=["sparse", "meta"])
def test_weights_without_plain_numbers_are_refused_by_name(tmp_path, capsys, weight):
    torch.save({"phydict": {"stage": "base"}, "state_dict": {"prior.x": weight}}, tmp_path / "c.ckpt")
    said = refusal(capsys, main, ["export", "--checkpoint", str(tmp_path / "c.ckpt"), "--out",
    str(tmp_path / "p.safetensors")])
    assert "c.ckpt" in said and "prior.x holds no plain numbers" in said and not (tmp_path / "p.safetensors").exists()


def test_a_training_is_never_written_among_its_cts(tmp_path, capsys, cache):
    cts = tmp_path / "cts"
    cts.mkdir()
    nibabel.save(nibabel.Nifti1Image(np.zeros((20, 20, 20), np.float32), np.diag([10.0, 10, 10, 1])), cts / "a.nii.gz")
    for out in (cts, cts / "out"):
        said = refusal(capsys, main, arguments(out, cache, f"--data.cts={cts}"))
        assert said.endswith("give another --out") and [path.name for path in cts.iterdir()] == ["a.nii.gz"]


@pytest.mark.parametrize("option", ["--data.holdout.phantoms=-1", "--data.cache=/dev/null",
                                    "--model.text.dropout=2", "--model.text.pretrain_steps=-1",
                                    "--model.optimisation.learning_rate=-1", "--model.optimisation.warmup=-3",
                                    "--data.loading.workers=1000000", "--model.validation.preview_steps=-1",
                                    "--model.validation.views=-1",
                                    "--model.optimisation.learning_rate=1e38", "--trainer.devices=99",
                                    "--model.network.init_args.channels=[]", "--model.network.init_args.block=0"])
def test_data_that_cannot_be_are_refused_by_their_option(tmp_path, capsys, cache, option):
    said = refusal(capsys, main, arguments(tmp_path, cache, option))
    assert option.partition("=")[0].rpartition(".")[2] in said and "is now" not in said
