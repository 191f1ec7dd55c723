"""Training the super-resolution stage by the same command: it learns, resumes exactly, exports, and is not mistaken."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from command_lines import SHORT, checkpoint, losses, refusal
from prior.tiny import tiny_prior, tiny_super_resolution

from phydict.cli.train import main, stage_of
from phydict.grid import Cube
from phydict.prior import LocalUNet, load_super_resolution, save_prior, save_stage
from phydict.training import SuperResolutionTraining
from phydict.training.crops import SuperResolutionData
from phydict.training.settings import Crops

CONFIG = Path(__file__).parents[1] / "configs" / "prior" / "super_resolution.yaml"
BASE_CONFIG = CONFIG.with_name("phantom.yaml")
TINY = ["--model.network.class_path=phydict.prior.LocalUNet", "--model.network.init_args.block=2",
        "--model.network.init_args.channels=[8,8]", "--model.cube.voxels=32", "--model.factor=2",
        "--model.optimisation.warmup=2", "--model.validation.preview_steps=2", "--data.phantoms=2",
        "--data.holdout.phantoms=1", "--data.crops.validation=1", "--data.crops.size=16", "--trainer.precision=32",
        *SHORT]


def arguments(folder: Path, cache: Path, *more: str) -> list[str]:
    return ["fit", f"--config={CONFIG}", *TINY, f"--data.cache={cache}", f"--out={folder}", *more]


@pytest.fixture(scope="module")
def straight(tmp_path_factory, cache) -> Path:
    """The folder of an uninterrupted run of two epochs."""
    folder = tmp_path_factory.mktemp("straight")
    main(arguments(folder, cache, "--trainer.max_epochs=2"))
    return folder


def test_the_loss_falls(tmp_path, cache):
    main(arguments(tmp_path, cache, "--trainer.max_epochs=15", "--model.optimisation.learning_rate=5e-3",
                   "--trainer.limit_val_batches=0"))
    network = checkpoint(tmp_path)["phydict"]["network"]
    tasks = [SuperResolutionTraining(LocalUNet(**network), Cube(32), 2) for _ in range(2)]
    tasks[1].load_state_dict(checkpoint(tmp_path)["current_model_state"])
    crops = SuperResolutionData(Crops(16, 2), phantoms=2, cube=Cube(32), cache=str(cache)).draws(epoch=0)
    batch = {"volume": torch.stack([crops[i]["volume"] for i in range(8)])}
    before, after = (np.mean([task.batch_loss(batch, (k,)).item() for k in range(8)]) for task in tasks)
    assert after < 0.9 * before


def test_a_resumed_run_is_the_uninterrupted_one(tmp_path, cache, straight):
    main(arguments(tmp_path, cache, "--trainer.max_epochs=1"))
    torch.manual_seed(99)
    main(arguments(tmp_path, cache, "--trainer.max_epochs=2", f"--ckpt_path={tmp_path / 'last.ckpt'}"))
    ours, theirs = checkpoint(tmp_path)["state_dict"], checkpoint(straight)["state_dict"]
    assert all(torch.equal(ours[name], weight) for name, weight in theirs.items())
    assert list(losses(tmp_path).values()) == list(losses(straight).values())[4:]


def test_validation_logs_every_noise_level_beside_what_upsampling_lacks(straight):
    log = next(straight.glob("logs/**/metrics.csv")).read_text().splitlines()[0].split(",")
    levels = {f"val/rmse_hu_t{t}" for t in (0.1, 0.3, 0.5, 0.7, 0.9)}
    assert levels | {"val/rmse_hu", "val/rmse_hu_upsampled"} <= set(log)
    assert len(list(straight.glob("logs/**/samples/*.png"))) == 2


def test_an_exported_checkpoint_is_a_stage_with_the_averaged_weights(tmp_path, straight):
    main(["export", f"--checkpoint={straight / 'last.ckpt'}", f"--out={tmp_path / 'fine.safetensors'}"])
    fine, averaged = load_super_resolution(tmp_path / "fine.safetensors"), checkpoint(straight)["state_dict"]
    for name, weight in fine.state_dict().items():
        assert torch.equal(weight, averaged[f"prior.{name}"].half().float()), name
    assert fine.grid.shape == (32, 32, 32) and fine.factor == 2 and fine.window.low == -1000


def test_what_is_learnt_is_the_detail_of_a_crop_given_its_block_means():
    task = SuperResolutionTraining(tiny_super_resolution().network, Cube(32), 2, most_noise=0.0)
    x0 = torch.rand(2, 1, 16, 16, 16)
    upsampled, level = task._condition({"volume": x0}, x0, _draws())
    assert torch.equal(upsampled, task.prior.upsample(torch.nn.functional.avg_pool3d(x0, 2))) and not level.any()
    noisy = SuperResolutionTraining(tiny_super_resolution().network, Cube(32), 2, most_noise=0.4)
    upsampled, level = noisy._condition({"volume": x0}, x0, _draws())
    coarse, draws = torch.nn.functional.avg_pool3d(x0, 2), _draws()
    torch.testing.assert_close(level, torch.cat([0.4 * torch.rand(1, generator=draw) for draw in draws]))
    added = torch.stack([torch.randn(coarse.shape[1:], generator=draw) for draw in draws]) * level.view(-1, 1, 1, 1, 1)
    torch.testing.assert_close(upsampled, noisy.prior.upsample(coarse + added))
    assert level.min() > 0 and level.max() <= 0.4 and level[0] != level[1]


def _draws() -> list[torch.Generator]:
    return [torch.Generator().manual_seed(seed) for seed in (0, 1)]


def test_a_checkpoint_of_the_other_stage_is_one_sentence(straight, cache, tmp_path, capsys):
    args = ["fit", f"--config={BASE_CONFIG}", "--model.network.class_path=phydict.prior.VolumeUNet",
            "--model.network.init_args.channels=[8,8]", "--model.network.init_args.attention=[false,true]",
            "--model.network.init_args.head_channels=8", "--model.cube.voxels=16",
            "--model.text.encoder=none", "--data.phantoms=2", "--data.holdout.phantoms=0",
            "--trainer.accelerator=cpu", "--trainer.devices=1", "--trainer.precision=32",
            f"--data.cache={cache}", f"--out={tmp_path / 'base'}"]
    said = refusal(capsys, main, [*args, f"--ckpt_path={straight / 'last.ckpt'}"])
    assert "super-resolution stage" in said and "base prior is needed" in said


@pytest.mark.parametrize("change, words", [
    (["--data.crops.size=15"], ["data.crops.size", "15"]),
    (["--data.crops.size=18"], ["data.crops.size", "a multiple of 4", "18"]),
    (["--model.factor=0"], ["model.factor", "1 or more", "0"]),
    (["--data.crops.validation=-1"], ["crops.validation", "-1"]),
    (["--model.cube.voxels=34"], ["34", "divisible"]), (["--model.most_noise=2"], ["most_noise"]),
    (["--model.detail_std=0"], ["detail_std", "0.001"]),
    (["--stage=fine"], ["fine"]), (["--model.text.encoder=none"], ["model.text.encoder"]),
    (["--model.initial={base}"], ["base prior"])],
    ids=lambda value: value[0].split("=")[0].strip("-") if value[0].startswith("-") else "")
def test_bad_input_is_one_sentence(change, words, cache, tmp_path, capsys):
    save_prior(tiny_prior(False), tmp_path / "base.safetensors")
    change = [text.format(base=tmp_path / "base.safetensors") for text in change]
    said = refusal(capsys, main, arguments(tmp_path / "run", cache, "--trainer.max_epochs=1", *change))
    assert all(word in said for word in words), said
    assert not list((tmp_path / "run").glob("*.ckpt"))


def test_training_goes_on_from_a_stage_and_refuses_one_of_another_grid(tmp_path):
    path, first = tmp_path / "fine.safetensors", tiny_super_resolution()
    save_stage(first, path, dtype=torch.float32)
    task = SuperResolutionTraining(initial=str(path), cube=Cube(32), factor=2, window=(-1000, 600))
    assert all(torch.equal(weight, first.state_dict()[name]) for name, weight in task.prior.state_dict().items())
    assert all(weight.requires_grad for weight in task.prior.parameters())
    with pytest.raises(ValueError, match="another grid"):
        SuperResolutionTraining(initial=str(path), cube=Cube(64), factor=2, window=(-1000, 600))
    with pytest.raises(ValueError, match="model.network has block 4, but the stage"):
        SuperResolutionTraining(LocalUNet(), initial=str(path), cube=Cube(32), factor=2, window=(-1000, 600))


def test_a_stage_keeps_its_own_detail_and_another_is_refused_beside_it(tmp_path):
    first, given = tiny_super_resolution(), {"cube": Cube(32), "factor": 2, "window": (-1000, 600)}
    first.detail_std = 0.3
    save_stage(first, tmp_path / "fine.safetensors")
    given["initial"] = str(tmp_path / "fine.safetensors")
    for same in ({}, {"detail_std": 0.3}):
        assert SuperResolutionTraining(**given, **same).prior.detail_std == 0.3
    with pytest.raises(ValueError, match="model.detail_std is 0.08, but the stage .* has 0.3: leave it out"):
        SuperResolutionTraining(**given, detail_std=0.08)


def test_the_stage_is_the_command_lines_or_the_last_configurations(tmp_path):
    assert stage_of(["fit", "-c", str(CONFIG)]) == "super_resolution"
    assert stage_of(["fit", f"--config={BASE_CONFIG}"]) == stage_of([]) == "base"
    assert stage_of(["fit", "-c", str(CONFIG), "--stage=base"]) == "base"
    assert stage_of(["fit", "-c", str(CONFIG), "-c", str(BASE_CONFIG)]) == "super_resolution"
    assert stage_of(["fit", "-c", str(CONFIG), "-c", "{stage: lifted, out: run}"]) == "lifted"
    with pytest.raises(ValueError, match="base, super_resolution, refiner, .*, but 'third'"):
        stage_of(["--stage", "third"])
