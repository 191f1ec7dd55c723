"""Checkpoints, priors and folders of a training: whole, resumed as what they are, and never replaced unasked."""

from __future__ import annotations

import os
import resource
import signal
from pathlib import Path

import nibabel
import numpy as np
import pytest
import torch
from command_lines import arguments, checkpoint, losses, refusal
from prior.medsyn_files import entries, text_unet, write
from prior.tiny import tiny_prior
from processes import Python

from phydict.cli.train import main
from phydict.prior import load_prior, save_prior
from phydict.runtime.files import alone_in
from phydict.training import PriorTraining


class Code:
    """What runs a command when it is unpickled."""

    def __reduce__(self):
        return os.system, ("exit 1",)


@pytest.mark.parametrize("validated", [True, False])
def test_weights_that_are_not_finite_never_replace_a_checkpoint(tmp_path, cache, capsys, monkeypatch, validated):
    def spoil(task: PriorTraining, *_) -> None:
        if task.global_step == 4:
            task.prior.null.data.view(-1)[3] = float("nan")

    monkeypatch.setattr(PriorTraining, "on_train_batch_end", spoil)
    more = [] if validated else ["--trainer.limit_val_batches=0"]
    said = refusal(capsys, main, arguments(tmp_path, cache, "--trainer.max_epochs=3", "--data.loading.epoch_size=4",
                                           *more))
    assert "the weights are not finite after 4 steps (prior.null has 1 NaN" in said and "last.ckpt" in said
    assert checkpoint(tmp_path)["global_step"] == 2
    assert not validated or torch.load(tmp_path / "best.ckpt", weights_only=True)["global_step"] == 2


@pytest.fixture
def spoilt(trained, tmp_path) -> Path:
    """A checkpoint of which one weight is NaN."""
    content = checkpoint(trained)
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


def test_an_exported_checkpoint_is_a_prior_with_the_averaged_weights(tmp_path, trained, capsys):
    file = tmp_path / "prior" / "tiny.safetensors"
    main(["export", f"--checkpoint={trained / 'last.ckpt'}", "--out", str(file)])
    assert str(file) in capsys.readouterr().out
    assert file.stat().st_mode == (trained / "last.ckpt").stat().st_mode  # whoever reads the one reads the other
    prior = load_prior(file)
    averaged = checkpoint(trained)["state_dict"]
    for name, weight in prior.state_dict().items():
        assert torch.equal(weight, averaged[f"prior.{name}"].half().float()), name
    assert prior.grid.shape == (16, 16, 16) and prior.window.low == -1000
    prior.bind("Large left pleural effusion.")  # loads the text encoder
    for name, weight in prior.text.state_dict().items():
        assert torch.equal(weight, averaged[f"prior.text.{name}"].half().float()), name


def test_the_checkpoint_that_reconstructs_best_is_kept(tmp_path, cache, monkeypatch):
    scores = iter((10.0, 30.0, 20.0))
    monkeypatch.setattr("phydict.training.prior.reconstruction_scores",
                        lambda *_: {"psnr": next(scores), "ssim": 0.5})
    main(arguments(tmp_path, cache, "--trainer.max_epochs=3", "--data.loading.epoch_size=4"))
    best = torch.load(tmp_path / "best.ckpt", map_location="cpu", weights_only=True)
    assert best["global_step"] == 4 and checkpoint(tmp_path)["global_step"] == 6
    assert {step: float(value) for step, value in losses(tmp_path, "val/psnr").items()} == {1: 10, 3: 30, 5: 20}
    assert [float(value) for value in losses(tmp_path, "samples").values()] == [4, 8, 12]
    main(["export", f"--checkpoint={tmp_path / 'best.ckpt'}", f"--out={tmp_path / 'prior.safetensors'}"])
    assert load_prior(tmp_path / "prior.safetensors").grid.shape == (16, 16, 16)


def test_a_moved_training_that_resumes_keeps_its_best_weights(tmp_path, cache, monkeypatch):
    scores = iter((30.0, 10.0, 40.0))
    monkeypatch.setattr("phydict.training.prior.reconstruction_scores",
                        lambda *_: {"psnr": next(scores), "ssim": 0.5})
    one_step = "--data.loading.epoch_size=2"
    main(arguments(tmp_path / "there", cache, "--trainer.max_epochs=1", one_step))
    (tmp_path / "there").rename(run := tmp_path / "here")
    for epochs, best in ((2, 1), (3, 3)):
        main(arguments(run, cache, f"--trainer.max_epochs={epochs}", "--ckpt_path=last", one_step))
        assert torch.load(run / "best.ckpt", map_location="cpu", weights_only=True)["global_step"] == best
        assert checkpoint(run)["global_step"] == epochs and sorted(run.glob("*.ckpt")) == [
            run / "best.ckpt", run / "last.ckpt"]


@pytest.mark.parametrize("every, expected", [(1, {1: 10, 2: 20}), (5, {2: 10})])
def test_the_last_weights_are_validated_wherever_a_training_ends(tmp_path, cache, monkeypatch, every, expected):
    scores = iter((10.0, 20.0))
    monkeypatch.setattr("phydict.training.prior.reconstruction_scores",
                        lambda *_: {"psnr": next(scores), "ssim": 0.5})
    main(arguments(tmp_path, cache, "--trainer.max_steps=3", "--data.loading.epoch_size=4",
                   f"--trainer.check_val_every_n_epoch={every}"))
    assert {step: float(value) for step, value in losses(tmp_path, "val/psnr").items()} == expected
    assert torch.load(tmp_path / "best.ckpt", map_location="cpu", weights_only=True)["global_step"] == 3
    assert checkpoint(tmp_path)["global_step"] == 3


def test_a_second_training_never_overwrites_a_first(trained, cache, capsys):
    before = (trained / "last.ckpt").read_bytes()
    said = refusal(capsys, main, arguments(trained, cache, "--trainer.max_epochs=1"))
    assert str(trained) in said and "--ckpt_path" in said and "--out" in said
    assert (trained / "last.ckpt").read_bytes() == before


@pytest.mark.parametrize("name", ["last.ckpt", "best.ckpt"])
def test_a_training_that_goes_on_elsewhere_overwrites_no_other(trained, cache, tmp_path, capsys, name):
    (tmp_path / name).write_bytes(b"another's")
    for more in ([], [f"--ckpt_path={trained / 'last.ckpt'}"]):
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
    run = Python(code, tmp_path)
    run.wait_for(lambda: run.out.endswith("\n"))
    loader = int(run.out)
    with pytest.raises(ValueError, match="another run"), alone_in(tmp_path, "--out"):
        pass
    run.process.kill()
    run.wait(60)
    with alone_in(tmp_path, "--out"):
        os.kill(loader, signal.SIGKILL)  # was alive until now


def test_a_folder_stays_where_it_was_there_or_something_was_written_to_it(tmp_path):
    (tmp_path / "mine").mkdir()
    for name, writes, stays in (("refused", False, False), ("deep/refused", False, False), ("begun", True, True),
                                ("mine", False, True)):
        with pytest.raises(KeyboardInterrupt), alone_in(tmp_path / name, "--out"):
            if writes:
                (tmp_path / name / "held_out.txt").touch()
            raise KeyboardInterrupt
        assert (tmp_path / name).exists() == stays


def test_a_list_of_someone_elses_is_not_replaced(cts, cache, tmp_path, capsys):
    (tmp_path / "held_out.txt").write_text("mine\n")
    said = refusal(capsys, main, arguments(tmp_path, cache, "--trainer.max_epochs=1", f"--data.cts={cts}",
                                     "--data.holdout.ids=[patient1]"))
    assert "held_out.txt is there already" in said and (tmp_path / "held_out.txt").read_text() == "mine\n"


def test_an_export_replaces_a_prior_when_asked_and_nothing_else_ever(trained, tmp_path, capsys):
    file = tmp_path / "prior.safetensors"
    args = ["export", f"--checkpoint={trained / 'last.ckpt'}", f"--out={file}"]
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
def test_a_checkpoint_is_resumed_only_as_what_it_is(change, key, trained, cache, tmp_path, capsys):
    resumed = ["--trainer.max_epochs=3", f"--ckpt_path={trained / 'last.ckpt'}"]
    said = refusal(capsys, main, arguments(tmp_path, cache, *resumed, *change))
    assert f"'{key}'" in said and not (tmp_path / "last.ckpt").exists()


@pytest.mark.parametrize("spoil, words", [
    (lambda file, whole: file.write_bytes(whole[:-1000]), ["truncated"]),
    (lambda file, whole: torch.save({"state_dict": {}}, file), ["no checkpoint of a prior"]),
    (lambda file, whole: torch.save({"phydict": {}, "code": Code()}, file), ["asks for code (posix.system)"]),
    (lambda file, whole: None, ["there is no checkpoint"]),
])
def test_what_cannot_be_exported_is_one_sentence(spoil, words, trained, tmp_path, capsys):
    file, out = tmp_path / "spoilt.ckpt", tmp_path / "out.safetensors"
    spoil(file, (trained / "last.ckpt").read_bytes())
    said = refusal(capsys, main, ["export", f"--checkpoint={file}", f"--out={out}"])
    assert all(word in said for word in [*words, "spoilt.ckpt"]), said
    assert not out.exists()


def test_a_checkpoint_that_is_not_there_is_answered_with_those_beside_it(trained, tmp_path, capsys):
    missing = trained / "better.ckpt"
    said = refusal(capsys, main, ["export", f"--checkpoint={missing}", f"--out={tmp_path / 'out.safetensors'}"])
    assert "last.ckpt" in said and "better.ckpt" in said


def test_inspecting_tells_what_training_and_medsyn_left(trained, tmp_path, capsys):
    main(["inspect-prior", str(trained / "last.ckpt")])
    told = capsys.readouterr().out
    assert told.startswith(f"{trained / 'last.ckpt'}\n  kind: phydict training checkpoint") and "16 x 16 x 16" in told
    write(tmp_path / "5_ckpt" / "model.safetensors", entries(text_unet()))
    main(["inspect-prior", str(tmp_path)])
    assert "kind: MedSyn's 64^3 stage" in capsys.readouterr().out
    assert "nowhere" in refusal(capsys, main, ["inspect-prior", str(tmp_path / "nowhere")])


@pytest.mark.parametrize("out", ["folder.safetensors", "file/prior.safetensors"])
def test_an_export_that_cannot_be_written_leaves_nothing(out, trained, tmp_path, capsys):
    (tmp_path / "folder.safetensors").mkdir()
    (tmp_path / "file").write_text("")
    said = refusal(capsys, main, ["export", f"--checkpoint={trained / 'last.ckpt'}", f"--out={tmp_path / out}"])
    assert out in said and "--out" in said
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["file", "folder.safetensors"]


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
