"""The command lines in tests: what they refuse, and what trainings small enough for them leave behind."""

from __future__ import annotations

import csv
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

CONFIG = Path(__file__).parents[1] / "configs" / "prior" / "phantom.yaml"

SHORT = ["--data.loading.epoch_size=8", "--data.loading.batch_size=2", "--trainer.accelerator=cpu",
         "--trainer.devices=1", "--trainer.max_steps=-1", "--trainer.log_every_n_steps=1",
         "--trainer.check_val_every_n_epoch=1", "--trainer.enable_progress_bar=false",
         "--trainer.enable_model_summary=false"]
"""Options of a training of a few steps."""

TINY = ["--model.network.class_path=phydict.prior.VolumeUNet", "--model.network.init_args.channels=[8,8]",
        "--model.network.init_args.attention=[false,true]", "--model.network.init_args.head_channels=8",
        "--model.cube.voxels=16", "--model.text.pretrain_steps=2", "--model.optimisation.warmup=2",
        "--model.validation.preview_steps=2", "--data.phantoms=4", "--data.holdout.phantoms=1", "--precision=float32",
        *SHORT]
"""Options of a short training of a tiny base stage."""


def arguments(folder: Path, cache: Path, *more: str) -> list[str]:
    """`fit` of a tiny network on four phantoms, everything written below `folder`."""
    return ["fit", f"--config={CONFIG}", *TINY, f"--data.cache={cache}", f"--out={folder}", *more]


def stage_arguments(config: Path, folder: Path, cache: Path, *more: str, voxels: int = 16, phantoms: int = 3
                    ) -> list[str]:
    """`fit` by a configuration, of epochs of two draws of a few phantoms, everything written below `folder`."""
    return ["fit", f"--config={config}", f"--model.cube.voxels={voxels}", "--model.window=[-1000,600]",
            f"--data.phantoms={phantoms}", "--data.holdout.phantoms=1", "--data.loading.epoch_size=2",
            "--trainer.accelerator=cpu", "--trainer.log_every_n_steps=1", "--precision=float32",
            "--trainer.max_steps=-1", f"--data.cache={cache}", f"--out={folder}", *more]


def refiner_arguments(config: Path, folder: Path, cache: Path, initial: str, *more: str) -> list[str]:
    """`stage_arguments` of a tiny refiner's stages."""
    return stage_arguments(config, folder, cache, "--model.scenes.most_views=4", f"--model.initial={initial}", *more)


def refinement_arguments(config: Path, folder: Path, cache: Path, refiner: str, *more: str) -> list[str]:
    """`stage_arguments` of stages that learn from a tiny refiner's reconstructions on finer voxels."""
    return stage_arguments(
        config, folder, cache, "--data.loading.batch_size=1", "--data.made.reconstructions=3",
        "--data.made.validation=1", "--data.made.crop=16", "--data.scenes.most_views=3", f"--data.initial={refiner}",
        *more, voxels=32, phantoms=2)


def refusal(capsys, main: Callable[[list[str]], None], args: list[str]) -> str:
    """The one sentence on stderr with which a command line refuses `args`."""
    capsys.readouterr()
    with pytest.raises(SystemExit) as stopped:
        main(args)
    assert stopped.value.code == 2
    shown = capsys.readouterr().err
    assert "Traceback" not in shown and "usage:" not in shown
    lines = [line for line in shown.splitlines() if line.startswith("error: ")]
    assert lines == shown.splitlines()[-1:], shown
    return lines[0]


def resumed_as_uninterrupted(main: Callable[[list[str]], None], fit: Callable[..., list[str]], folder: Path) -> Path:
    """The checkpoint of two epochs of two steps, after checking that one that stops and resumes between them has the
    same weights; fit: the arguments of a training into a folder, with more behind."""
    straight, halved = folder / "straight", folder / "halved"
    main(fit(straight, "--trainer.max_epochs=2"))
    main(fit(halved, "--trainer.max_epochs=1"))
    main(fit(halved, "--trainer.max_epochs=2", f"--ckpt_path={halved / 'last.ckpt'}"))
    assert set(losses(straight)) == {0, 1, 2, 3} and {2, 3} <= set(losses(halved))
    one, other = (checkpoint(run)["state_dict"] for run in (straight, halved))
    assert one.keys() == other.keys() and all(torch.equal(one[name], other[name]) for name in one)
    return straight / "last.ckpt"


def losses(folder: Path, column: str = "loss") -> dict[int, str]:
    """Step -> loss as logged, from the last log that the run in `folder` wrote."""
    log = max(folder.glob("logs/**/metrics.csv"), key=lambda path: path.stat().st_mtime_ns)
    with log.open() as file:
        return {int(row["step"]): row[column] for row in csv.DictReader(file) if row[column]}


def checkpoint(folder: Path) -> dict:
    return torch.load(folder / "last.ckpt", map_location="cpu", weights_only=True)
