"""What a training refuses, in one sentence."""

from __future__ import annotations

from contextlib import nullcontext

import numpy as np
import pytest
import torch
from command_lines import TINY, arguments, refusal
from ct_files import save_ct

from phydict.cli.train import main
from phydict.grid import Cube
from phydict.rivals import X2CTNetwork
from phydict.training.crops import SuperResolutionData
from phydict.training.finer_uncertainty import FinerUncertaintyTraining
from phydict.training.refinement import RefinementTraining
from phydict.training.refiner import RefinerTraining
from phydict.training.rivals import LiftedTraining, OrbitScenes
from phydict.training.settings import Crops
from phydict.training.uncertainty import UncertaintyTraining
from phydict.training.x2ct import Adversary, X2CTTraining


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
    (["--model.window=[-900,600]"], ["model.window begins at -900 HU", "air"]),
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


def test_a_refused_training_leaves_no_folder_behind(tmp_path):
    with pytest.raises(ValueError, match="data.crops.size is a multiple"):
        SuperResolutionData(Crops(size=15), phantoms=1, cache=str(tmp_path / "cache"), cube=Cube(16))
    assert not list(tmp_path.iterdir())


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
                                    "--trainer.precision=16-true", "--trainer.limit_train_batches=0",
                                    "--model.optimisation.mask_weight=-1", "--model.optimisation.mask_weight=.inf"])
def test_data_that_cannot_be_are_refused_by_their_option(tmp_path, capsys, cache, option):
    said = refusal(capsys, main, arguments(tmp_path, cache, option))
    assert option.partition("=")[0].rpartition(".")[2] in said


def test_the_headers_of_the_cts_are_checked_before_reports_are_learnt(cts, tmp_path, cache, capsys, monkeypatch):
    monkeypatch.setattr("phydict.training.prior.PriorTraining.learn_reports", lambda self: pytest.fail("learnt first"))
    save_ct(tmp_path / "cts" / "scout.nii.gz", np.zeros((20, 20, 5), np.int16))
    said = refusal(capsys, main, arguments(tmp_path / "run", cache, "--trainer.max_epochs=1",
                                           f"--data.cts={tmp_path / 'cts'}"))
    assert "scout.nii.gz has 5 slices" in said and "data.source.exclude" in said


@pytest.mark.parametrize("stage, weight", [
    (RefinerTraining, "body_weight"), (RefinerTraining, "mask_weight"), (UncertaintyTraining, "body_weight"),
    (FinerUncertaintyTraining, "body_weight"), (RefinementTraining, "body_weight"), (LiftedTraining, "body_weight")])
@pytest.mark.parametrize("value", [-1.0, float("nan"), float("inf")])
def test_no_part_of_a_loss_weighs_less_than_nothing_or_beyond_all_bounds(stage, weight, value):
    with pytest.raises(ValueError, match=f"^model.{weight} is a finite number, 0 or more, but {value}"):
        stage(**{weight: value})


@pytest.mark.parametrize("setting, value", [("views", 0), ("views", 1.5), ("arc_degrees", 0.0), ("arc_degrees", 361.0),
                                            ("arc_degrees", float("nan"))])
def test_an_orbit_that_cannot_be_is_refused_by_its_option(setting, value):
    with pytest.raises(ValueError, match=f"^model.scenes.{setting} "):
        OrbitScenes(**{setting: value})


def test_a_discriminator_has_no_more_layers_than_halve_the_grid():
    for layers in (3, 4):
        made = pytest.raises(ValueError, match="model.adversary.layers lies between 1 and 3, but 4 was given") \
            if layers == 4 else nullcontext()
        with made:
            task = X2CTTraining(X2CTNetwork(8, 4, (2, 2), (4, 8, 8)), OrbitScenes(views=2), Cube(16), (-1000, 600),
                                adversary=Adversary(width=4, layers=layers))
            judged = task.discriminator(torch.rand(1, 1, 16, 16, 16), torch.rand(1, 2, 16, 16, 16))
            assert judged.isfinite().all()
