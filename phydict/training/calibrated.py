"""What the trainings of uncertainty share: the likelihood of errors, and validation that calibrates."""

from __future__ import annotations

from typing import Any

from torch import Tensor
from torchmetrics.functional import spearman_corrcoef

from phydict.prior import CorrectionNetwork, Refiner
from phydict.training.checkpoints import CALIBRATED_AT
from phydict.training.settings import Optimisation
from phydict.training.stage import StageTraining


class CalibratedTraining(StageTraining):
    """Learns the uncertainty of a network by the likelihood of a Laplace distribution; each validation calibrates it.

    body_weight: how many times more a voxel of the body counts than one of air, plus 1. held_out: of each held-out
    case, what calibrates. calibrated_at: the step after which validation last calibrated, None: not yet.
    """

    prior: Any  # with uncertainty
    calibrated_at: int | None = None

    def __init__(self, prior: Refiner | CorrectionNetwork, optimisation: Optimisation, seed: int, initial: str,
                 body_weight: float):
        super().__init__(prior, optimisation, seed, initial)
        self.body_weight = body_weight
        self.held_out: list[tuple[Tensor, ...]] = []

    def error_loss(self, log_scale: Tensor, error: Tensor, body: Tensor) -> Tensor:
        """The mean of log b + e / b over voxels with errors e, of which those where `body` is true weigh more."""
        weight = 1 + self.body_weight * body
        return (weight * (log_scale + error / log_scale.exp())).sum() / weight.sum()

    def log_rank(self, index: int, log_scale: Tensor, error: Tensor, body: Tensor) -> None:
        """Logs how well a held-out case's scales rank the errors in the body."""
        self.log_case(index, "val/rank", spearman_corrcoef(log_scale[body].float(), error[body]), prog_bar=True)

    def hold_out(self, *values: Tensor) -> None:
        """Keeps what a held-out case gives to calibrate from."""
        self.held_out.append(values)
        self.log("samples", float(self.samples), rank_zero_only=True, batch_size=1)

    def on_fit_start(self) -> None:
        super().on_fit_start()
        if not len(self.trainer.datamodule.validation):  # type: ignore[attr-defined]
            raise ValueError("validation calibrates the intervals, but nothing is held out: name CTs by "
                             "data.holdout.ids, or give a share of them as data.holdout.fraction")
        if not self.trainer.limit_val_batches:
            raise ValueError("validation calibrates the intervals, but trainer.limit_val_batches is "
                             f"{self.trainer.limit_val_batches}: leave it out")
        for callback in self.averaging():
            raise ValueError("weights that validation calibrates cannot be averaged: train without "
                             f"{type(callback).__name__} (trainer.callbacks: null)")

    def on_validation_start(self) -> None:
        super().on_validation_start()
        self.held_out = []

    def on_validation_epoch_end(self) -> None:
        if self.held_out:
            self.prior.uncertainty.calibrate(*self.of_all_processes(self.held_out))
            self.calibrated_at = self.trainer.global_step

    def on_save_checkpoint(self, checkpoint: dict) -> None:
        super().on_save_checkpoint(checkpoint)
        checkpoint[CALIBRATED_AT] = self.calibrated_at

    def on_load_checkpoint(self, checkpoint: dict) -> None:
        super().on_load_checkpoint(checkpoint)
        self.calibrated_at = checkpoint.get(CALIBRATED_AT)
