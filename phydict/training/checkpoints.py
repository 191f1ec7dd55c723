"""The files of a training: checkpoints that are whole, the best of them, and what a read one must hold."""

from __future__ import annotations

import errno
import reprlib
import signal
import threading
from contextlib import suppress
from pathlib import Path
from typing import Any

import lightning
import torch
from lightning.pytorch.callbacks import Checkpoint, ModelCheckpoint
from lightning.pytorch.plugins.io import TorchCheckpointIO

from phydict.prior.finite import check_finite
from phydict.prior.stage_file import STAGES
from phydict.prior.tensors import read_torch
from phydict.runtime.files import atomic_write
from phydict.runtime.progress_log import log_progress
from phydict.runtime.reading import not_written

BEST, HELD_OUT = "best.ckpt", "held_out.txt"
"""Files of a training's folder: what reconstructed the held-out cases best, and the ids of the CTs that it never
saw."""

RESUMED = ("epoch", "global_step", "loops", "optimizer_states", "lr_schedulers", "callbacks")
"""What a checkpoint must hold beside the weights for its training to resume."""

CALIBRATED_AT = "calibrated_at"
"""A checkpoint's entry, where validation calibrates the weights: the step after which it last did, None: not yet."""


def read_checkpoint(path: str | Path) -> dict:
    """A checkpoint that training wrote. Raises FileNotFoundError, or ValueError when it is truncated, holds code, is
    another's or holds weights that are not finite."""
    if not Path(path).is_file():
        beside = sorted(file.name for file in Path(path).parent.glob("*.ckpt"))
        raise FileNotFoundError(f"there is no checkpoint {path}: give a .ckpt file that training wrote" + (
            f", such as {', '.join(beside)} beside it ({BEST} is written when held-out cases are reconstructed)"
            if beside else ""))
    checkpoint = read_torch(path)
    if not isinstance(checkpoint, dict) or "phydict" not in checkpoint:
        raise ValueError(f"{path} is no checkpoint of a prior: give a .ckpt file that training wrote")
    header, weights = checkpoint["phydict"], checkpoint.get("state_dict")
    stage = header.get("stage", "base") if isinstance(header, dict) else None
    if not isinstance(stage, str) or stage not in STAGES:
        raise ValueError(f"{path} is damaged: its header is {reprlib.repr(header)}; give another checkpoint")
    if not isinstance(weights, dict) or not all(isinstance(name, str) for name in weights) or not all(
            isinstance(weight, torch.Tensor) for name, weight in weights.items()
            if name.startswith(("prior.", "text."))):
        raise ValueError(f"{path} is damaged: its weights are {reprlib.repr(weights)}; give another checkpoint")
    for state in ("state_dict", "current_model_state"):
        check_finite(checkpoint.get(state, {}), path)
    return checkpoint


def check_calibrated(checkpoint: dict, path: str | Path) -> None:
    """Raises ValueError where validation was to calibrate the weights of a checkpoint from `path`, and did not, or
    other weights; of older checkpoints, without that entry, it is not known."""
    steps = checkpoint.get("global_step")
    if (at := checkpoint.get(CALIBRATED_AT, steps)) != steps:
        calibrated = "were not calibrated" if at is None else f"were calibrated after step {at}"
        raise ValueError(f"the intervals of {path} {calibrated}, but its weights are those after step {steps}: resume "
                         "its training with --ckpt_path to its next validation, with more trainer.max_steps where it "
                         "has ended, or give the best.ckpt beside it")


class WholeCheckpoints(TorchCheckpointIO):
    """Checkpoints that take the last one's place only when they are complete, whatever stops the writing."""

    def save_checkpoint(self, checkpoint: dict, path: str | Path, storage_options: object = None) -> None:
        try:
            with atomic_write(Path(path)) as part:
                torch.save(checkpoint, part)
        except (OSError, RuntimeError) as error:
            if isinstance(error, RuntimeError):  # torch's words for a write that was cut short
                error = OSError(errno.ENOSPC, "perhaps the disk is full")
            raise not_written(f"the checkpoint {path}", error, "give another --out, and resume from the last one, if "
                              "there is one, with --ckpt_path") from error


class BestCheckpoint(ModelCheckpoint):
    """Keeps the weights with the best score so far, where validation gives one; also in a folder that was moved."""

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        here = Path(str(self.dirpath))
        if (here / Path(state_dict["best_model_path"]).name).is_file():  # else nothing of it was taken along
            best, kth = (str(here / Path(state_dict[f"{name}_model_path"]).name) for name in ("best", "kth_best"))
            scores = {str(here / Path(path).name): score for path, score in state_dict["best_k_models"].items()}
            state_dict = state_dict | {"dirpath": self.dirpath, "best_model_path": best, "kth_best_model_path": kth,
                                       "best_k_models": scores}
        super().load_state_dict(state_dict)

    def on_validation_end(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        if self.monitor in trainer.callback_metrics:
            super().on_validation_end(trainer, pl_module)


class RecentCheckpoint(ModelCheckpoint):
    """Keeps the weights of every few minutes, between steps alone: of accumulated gradients nothing is kept."""

    @property
    def state_key(self) -> str:  # that of checkpoints written before there was this class
        return super().state_key.replace(type(self).__qualname__, ModelCheckpoint.__qualname__)

    def on_train_batch_end(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule, outputs: Any,
                           batch: Any, batch_idx: int) -> None:
        if (batch_idx + 1) % trainer.accumulate_grad_batches == 0 or trainer.is_last_batch:
            super().on_train_batch_end(trainer, pl_module, outputs, batch, batch_idx)


class StopBetweenSteps(Checkpoint):
    """Lets Ctrl-C and SIGTERM end the training of one process after the step that they strike, whose weights are kept.

    A second Ctrl-C, or one during validation, ends it at once. Several processes are not stopped after the same step:
    they keep what they last wrote.

    Args:
        path: the checkpoint, which is replaced
    """

    def __init__(self, path: Path):
        self.path, self.asked, self.terminated = path, False, False
        self.before: Any = None

    def on_train_start(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        self.step = trainer.global_step
        if trainer.world_size == 1 and threading.current_thread() is threading.main_thread():
            self.before = signal.signal(signal.SIGINT, lambda *_: self._ask(trainer))

    def _ask(self, trainer: lightning.Trainer) -> None:
        if self.asked or not trainer.training:
            raise KeyboardInterrupt
        self.asked, text = True, "stopping after this step; Ctrl-C again stops at once, and loses it"
        with suppress(RuntimeError):  # it struck within a line that is being written
            log_progress(text, event="stopping", text=text)

    def on_train_batch_end(self, trainer: lightning.Trainer, *_: object) -> None:
        complete, self.step = trainer.global_step > self.step, trainer.global_step  # unless gradients are accumulated
        signals = trainer._signal_connector  # after whose SIGTERM Lightning ends with the batch
        if trainer.world_size == 1 and (signals.received_sigterm or self.terminated):
            self.terminated, signals.received_sigterm = True, complete
        if complete and (self.asked or self.terminated):
            trainer.save_checkpoint(self.path)
        if complete and self.asked:
            raise KeyboardInterrupt

    def on_train_end(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        self._give_back()

    def on_exception(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule,
                     exception: BaseException) -> None:
        if not isinstance(exception, KeyboardInterrupt):  # where Lightning ignores further ones until it has ended
            self._give_back()

    def _give_back(self) -> None:
        if self.before is not None:
            signal.signal(signal.SIGINT, self.before)
