"""What a training refuses, in one sentence."""

from __future__ import annotations

import pytest
from command_lines import TINY, arguments, refusal

from phydict.cli.train import main


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
    (["--data.loading.simulation_voxels=32"], ["learns from no X-rays", "32"]),
    (["--data.loading.epoch_size=1"], ["epoch_size", "batch"]),
    (["--data.lungs=2"], ["data.lungs"]),
    (["--data.augmentation.shift=-5"], ["shift", "-5"]),
    (["--throughput.peak=0"], ["throughput.peak"]),
    (["--model.cube.voxels=15"], ["15", "divisible"]), (["--model.cube.voxels=0"], ["0 was given"]),
    (["--ckpt_path=/nowhere/last.ckpt"], ["/nowhere/last.ckpt"]),
    (["--ckpt_path={cut}"], ["cut.ckpt", "truncated"]),
], ids=lambda value: value[0].split("=")[0].strip("-") if isinstance(value, list) and value[0][0] == "-" else "")
def test_bad_input_is_one_sentence(change, words, cts, trained, cache, tmp_path, capsys):
    whole = (trained / "last.ckpt").read_bytes()
    (tmp_path / "cut.ckpt").write_bytes(whole[:len(whole) // 2])
    change = [text.format(cts=cts, cut=tmp_path / "cut.ckpt") for text in change]
    said = refusal(capsys, main, arguments(tmp_path / "run", cache, "--trainer.max_epochs=1", *change))
    assert all(word in said for word in words), said
    assert not list((tmp_path / "run").glob("*.ckpt"))


@pytest.mark.parametrize("command", ["fit", "validate"])
def test_a_missing_configuration_says_which_to_give(command, cache, tmp_path, capsys):
    args = [command, *TINY, "--trainer.max_epochs=1", f"--data.cache={cache}", f"--out={tmp_path / 'run'}"]
    assert "no configuration file was given: add -c <file>, such as -c configs/prior/phantom.yaml" in refusal(
        capsys, main, args)
    assert not (tmp_path / "run").exists()


def test_validation_needs_trained_weights(cache, tmp_path, capsys):
    args = [arg for arg in arguments(tmp_path, cache)[1:] if "max_steps" not in arg]
    assert "--ckpt_path" in refusal(capsys, main, ["validate", *args])


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


@pytest.mark.parametrize("option", ["--data.holdout.phantoms=-1", "--data.cache=/dev/null",
                                    "--model.text.dropout=2", "--model.text.pretrain_steps=-1",
                                    "--model.optimisation.learning_rate=-1", "--model.optimisation.warmup=-3",
                                    "--data.loading.workers=1000000", "--model.validation.preview_steps=-1",
                                    "--model.validation.views=-1",
                                    "--model.optimisation.learning_rate=1e38", "--trainer.devices=99",
                                    "--model.network.init_args.channels=[]", "--model.network.init_args.block=0",
                                    "--model.network.init_args.state_channels=6", "--data.phantoms=1000001",
                                    "--model.optimisation.sigma_data=0", "--model.seed=-1",
                                    "--trainer.check_val_every_n_epoch=0", "--trainer.accumulate_grad_batches=0",
                                    "--trainer.precision=16-true"])
def test_data_that_cannot_be_are_refused_by_their_option(tmp_path, capsys, cache, option):
    said = refusal(capsys, main, arguments(tmp_path, cache, option))
    assert option.partition("=")[0].rpartition(".")[2] in said
