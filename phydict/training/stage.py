"""What the training of every stage shares: steps that stop at a loss that is not finite, optimiser, checkpoints."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path

import lightning
import numpy as np
import torch
from lightning.pytorch.callbacks import WeightAveraging
from lightning.pytorch.utilities.types import OptimizerLRSchedulerConfig
from torch import Tensor

from phydict.grid import Grid
from phydict.prior import CorrectionNetwork, Prior, Refiner, SuperResolution
from phydict.prior.files import held_out_of
from phydict.prior.finite import not_finite
from phydict.prior.stage_file import check_stage
from phydict.rivals import Rival
from phydict.runtime.seeds import check_seed
from phydict.training.data import PriorData
from phydict.training.settings import Optimisation
from phydict.units import HUWindow

CHECKPOINT = "last.ckpt"
"""The file of a training's folder that it can be resumed from."""


def check_continues(kind: str, file: str, stage: Prior | Refiner | CorrectionNetwork, grid: Grid,
                    window: HUWindow) -> None:
    """Raises ValueError unless the stage that a training continues from, a `kind` in `file`, is of the training's own
    grid and HU window."""
    if not stage.grid.same_as(grid) or stage.window != window:
        raise ValueError(f"the {kind} {file} has another grid or HU window than this training: set model.cube and "
                         "model.window to its own")


def check_network(kind: str, file: str, own: dict, requested: dict, part: str = "network") -> None:
    """Raises ValueError unless the network that was requested for a training, as model.`part`, has the settings of the
    one that it continues from, of a `kind` in `file`."""
    if name := next((name for name in requested if requested[name] != own.get(name)), None):
        raise ValueError(f"model.{part} has {name} {requested[name]}, but the {kind} {file} that training continues "
                         f"from has {own.get(name)}: leave model.{part} out, give it all of that {kind}'s settings, "
                         "or leave model.initial out")


def _average(mean: Callable[[Tensor, Tensor, Tensor | int], Tensor], average: Tensor, current: Tensor,
             averaged: Tensor | int) -> Tensor:
    """The next average of weights; whole numbers, such as tokens' places, stay as they are: a mean of them is rounded
    down."""
    return mean(average, current, averaged) if current.is_floating_point() else current


class StageTraining(lightning.LightningModule, ABC):
    """Learns one stage, its network `self.prior`, by the loss of a batch (`batch_loss`).

    calls: of the network, forward and backward, that a sample costs. initial: the file that training starts from, if
    any.
    """

    calls = 1

    def __init__(self, prior: Prior | SuperResolution | Refiner | CorrectionNetwork | Rival,
                 optimisation: Optimisation, seed: int, initial: str | None = None):
        super().__init__()
        check_seed(seed, "model.seed")
        self.prior, self.optimisation, self.seed, self.samples = prior, optimisation, seed, 0
        self.initial, self.held_out_before = initial, held_out_of(initial) if initial else None
        self.before: dict[str, int] = {}
        """Steps and samples that the weights had learnt from when this training was given them, where known."""

    @abstractmethod
    def batch_loss(self, batch: dict, key: tuple[int, ...] = (0,), rank: int = 0, processes: int = 1) -> Tensor:
        """The loss of one batch.

        All that is random follows from `key` and each sample's place in the batch that all `processes` share in turns,
        so that a resumed run repeats an uninterrupted one, and several processes do what one would.
        """

    def drawn(self, batch: dict, key: tuple[int, ...], rank: int, processes: int
              ) -> Iterator[tuple[dict, np.random.Generator]]:
        """Each case of a batch, as a batch of its own, and what its scene is drawn from."""
        for n in range(len(batch["volume"])):
            yield ({name: value[n:n + 1] for name, value in batch.items()},
                   np.random.default_rng((*key, rank + n * processes)))

    def learn_reports(self) -> None:
        """Teaches the text part, where there is one, before the first denoising step."""

    def averaging(self) -> list[WeightAveraging]:
        """The trainer's callbacks that average weights."""
        return [one for one in self.trainer.callbacks if isinstance(one, WeightAveraging)]  # type: ignore[attr-defined]

    def setup(self, stage: str) -> None:
        if isinstance(data := self.trainer.datamodule, PriorData):  # type: ignore[attr-defined]
            data.check_unseen(self.held_out_before, f"the training of {self.initial}")

    def configure_model(self) -> None:
        if self.device_mesh is not None:  # only of a strategy that shards the weights
            raise ValueError("this stage is too small to be sharded over devices: train it with "
                             "configs/prior/ddp.yaml instead of fsdp.yaml")

    def on_fit_start(self) -> None:
        self.optimisation.check_end(self.trainer.max_steps)
        for callback in self.averaging():
            if callback._average_model is not None:
                callback._average_model.to(self.device)  # made before the weights came there; each step would copy them
                if (mean := callback._average_model.avg_fn) is not None:
                    callback._average_model.avg_fn = partial(_average, mean)

    def on_train_start(self) -> None:
        for schedule in (config.scheduler for config in self.trainer.lr_scheduler_configs):  # type: ignore[attr-defined]
            settings, groups = self.optimisation, schedule.optimizer.param_groups  # perhaps a checkpoint's
            schedule.base_lrs = [settings.learning_rate] * len(groups)
            for group in groups:
                group.update(initial_lr=settings.learning_rate, weight_decay=settings.weight_decay,
                             lr=settings.learning_rate * settings.factor(schedule.last_epoch))

    def training_step(self, batch: dict, index: int) -> Tensor:
        loss = self.batch_loss(batch, (self.seed, self.global_step, index), self.global_rank, self.trainer.world_size)
        mean = self.trainer.strategy.reduce(loss.detach().clone(), reduce_op="mean")  # so that every process stops
        if not mean.isfinite():
            raise FloatingPointError(f"the loss is {float(mean)} after {self.global_step} steps: {self._way_back()}")
        self.samples += len(batch["volume"]) * self.trainer.world_size
        self.log("loss", mean, prog_bar=True, batch_size=len(batch["volume"]))
        return loss

    def validation_number(self, index: int) -> int:
        """The number of the held-out case that is this process's `index`-th, which decides what is drawn for it:
        processes take turns, and begin anew until each has as many."""
        return (index * self.trainer.world_size + self.trainer.global_rank) % self._held_out_cases()

    def log_case(self, index: int, name: str, value: Tensor | float, prog_bar: bool = False) -> None:
        """Logs a number of this process's `index`-th held-out case for the mean over cases; one that is begun anew
        counts nothing."""
        cases, processes = self._held_out_cases(), self.trainer.world_size
        counts = index * processes + self.trainer.global_rank < cases
        # Lightning takes the mean of these whole numbers over processes, rounded: multiples of their number stay right.
        self.log(name, value, prog_bar=prog_bar, sync_dist=True, batch_size=processes * counts)

    def of_all_processes(self, given: Sequence[tuple[Tensor, ...]]) -> list[Tensor]:
        """What each of this process's held-out cases gave, (n,) of each kind, and what those of the others gave: one
        row of each kind, each case once and in order."""
        rows = []
        for values in zip(*given):
            everywhere = self.all_gather(torch.stack(values))
            shaped = everywhere.reshape(self.trainer.world_size, len(values), -1)  # type: ignore[union-attr]
            rows.append(shaped.transpose(0, 1).flatten(0, 1)[:self._held_out_cases()].flatten())
        return rows

    def _held_out_cases(self) -> int:
        return len(self.trainer.val_dataloaders.dataset)  # type: ignore[union-attr, arg-type]  # one loader

    def on_train_batch_end(self, outputs: object, batch: object, index: int) -> None:
        if self.global_step == self.trainer.max_steps:  # Lightning then validates, whichever epoch it is
            self.trainer.should_stop = True
            if self.trainer.check_val_every_n_epoch:
                self.trainer.check_val_every_n_epoch = 1

    def on_validation_start(self) -> None:
        if self.device_mesh is None:  # the parts of sharded weights are looked at when they are put together
            self._check_weights(self.state_dict())

    def _check_weights(self, *states: Mapping[str, Tensor]) -> None:
        """Raises FloatingPointError in every process where the weights of one are not finite."""
        broken = next(filter(None, map(not_finite, states)), "")
        anywhere = torch.tensor(float(bool(broken)), device=self.device)
        if self.trainer.strategy.reduce(anywhere, reduce_op="sum"):
            raise FloatingPointError(f"the weights are not finite after {self.global_step} steps "
                                     f"({broken or 'those of another process'}): {self._way_back()}")

    def _way_back(self) -> str:
        """What to do where a training has come to nothing."""
        file = Path(self.trainer.default_root_dir) / CHECKPOINT
        last = file if file.is_file() else self.trainer.ckpt_path
        anew = "start anew with a lower model.optimisation.learning_rate"
        if not last:
            return f"no checkpoint had been written, so {anew}"
        return f"the last good checkpoint is {last}, so resume from it with --ckpt_path, or {anew}"

    def configure_optimizers(self) -> OptimizerLRSchedulerConfig:
        weights = [w for w in self.parameters() if w.requires_grad]
        optimizer = torch.optim.AdamW(weights, self.optimisation.learning_rate,
                                      weight_decay=self.optimisation.weight_decay)
        schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, self.optimisation.factor)
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}

    def on_save_checkpoint(self, checkpoint: dict) -> None:
        self._check_weights(checkpoint["state_dict"], checkpoint.get("current_model_state", {}))
        progress = {"steps": self.trainer.global_step, "samples": self.samples}
        progress = {name: count + self.before.get(name, 0) for name, count in progress.items()}
        held_out = self._held_out()
        known = {} if held_out is None else {"held_out": held_out}
        checkpoint["phydict"] = self.prior.describe() | {"training": progress | known}

    def _held_out(self) -> list[str] | None:
        """The held-out CTs that the weights never learnt from, not before this training either; None where no training
        on CTs is known."""
        data, before = self.trainer.datamodule, self.held_out_before  # type: ignore[attr-defined]
        if not isinstance(data, PriorData) or not len(data.cts):
            return before
        return [id for id in data.held_out if before is None or id in before]

    def on_load_checkpoint(self, checkpoint: dict) -> None:
        resumed, current = {"stage": "base"} | checkpoint["phydict"], self.prior.describe()
        check_stage(resumed, (current["stage"],), "the checkpoint")
        for key in resumed | current:
            if key != "training" and resumed.get(key) != current.get(key):
                raise ValueError(f"the checkpoint's prior and this training's differ in '{key}': give the settings and "
                                 "data that the checkpoint was trained with, or start anew with model.initial")
        training = checkpoint["phydict"].get("training", {})
        self.samples = training.get("samples", 0) - self.before.get("samples", 0)
        if "steps" in training:  # those of the file that it began from may not be given again
            self.before["steps"] = training["steps"] - checkpoint["global_step"]
        if (known := training.get("held_out")) is not None:
            before = self.held_out_before
            self.held_out_before = [id for id in known if before is None or id in before]
