"""Training one stage of a cascade by denoising, whatever the stage is."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from pathlib import Path

import lightning
import torch
from torch import Tensor

from phydict.diffusion import Denoiser, renoise
from phydict.posterior import ddim_sample
from phydict.prior import Prior, SuperResolution
from phydict.prior.files import check_stage
from phydict.prior.finite import not_finite
from phydict.training.data import PriorData
from phydict.training.settings import Optimisation
from phydict.units import HUWindow

CHECKPOINT = "last.ckpt"
"""The file of a training's folder that it can be resumed from."""

NOISE_LEVELS = (0.1, 0.3, 0.5, 0.7, 0.9)
"""Times t at which validation measures the denoising error."""


class StageTraining(lightning.LightningModule, ABC):
    """Learns one stage by denoising: squared error of x0 at all noise levels, up to four times heavier at the low ones.

    A stage says what a batch's clean state is (`_clean_state`), what its network is told beside it (`_condition`), and
    what denoises a held-out case (`_denoiser`). Its network is `self.prior`.
    """

    def __init__(self, prior: Prior | SuperResolution, typical_std: float, optimisation: Optimisation,
                 preview_steps: int, seed: int, mask_weight: float = 0.0):
        super().__init__()
        self.prior, self.typical_std, self.preview_steps = prior, typical_std, preview_steps
        self.optimisation, self.seed, self.mask_weight, self.samples = optimisation, seed, mask_weight, 0

    @abstractmethod
    def _clean_state(self, batch: dict) -> tuple[Tensor, Tensor]:
        """The clean state (B, C, X, Y, Z) of a batch and the weight of each channel's error (B, C, 1, 1, 1)."""

    @abstractmethod
    def _condition(self, batch: dict, x0: Tensor, generators: list[torch.Generator]) -> tuple[Tensor, ...]:
        """What the network is told beside the noisy state and its time; one source of randomness per sample."""

    @abstractmethod
    def _denoiser(self, batch: dict, x0: Tensor) -> Denoiser:
        """The denoiser of a held-out case."""

    @abstractmethod
    def _describe(self) -> dict:
        """What the stage is, as plain JSON values."""

    def learn_reports(self, data: PriorData) -> None:
        """Teaches the text part, where there is one, before the first denoising step."""

    def training_step(self, batch: dict, index: int) -> Tensor:
        loss = self.denoising_loss(batch, (self.seed, self.global_step, index), self.global_rank,
                                   self.trainer.world_size)
        mean = self.trainer.strategy.reduce(loss.detach().clone(), reduce_op="mean")  # so that every process stops
        if not mean.isfinite():
            raise FloatingPointError(f"the loss is {float(mean)} after {self.global_step} steps: {self._way_back()}")
        self.samples += len(batch["volume"]) * self.trainer.world_size
        self.log("loss", mean, prog_bar=True, batch_size=len(batch["volume"]))
        return loss

    def denoising_loss(self, batch: dict, key: tuple[int, ...] = (0,), rank: int = 0, processes: int = 1) -> Tensor:
        """Weighted squared error of one batch's clean estimates.

        Times, noise and what else is random follow from `key` and each sample's place in the batch that all `processes`
        share in turns, so that a resumed run repeats an uninterrupted one, and several processes do what one would.
        """
        x0, weight = self._clean_state(batch)
        places = range(rank, len(x0) * processes, processes)
        generators = [torch.Generator().manual_seed(hash((*key, place)) % 2**31) for place in places]
        u = torch.cat([torch.rand(1, generator=generator) for generator in generators])
        t = ((torch.tensor(places) + u) / (len(x0) * processes)).to(self.device)
        noise = torch.stack([torch.randn(x0.shape[1:], generator=g) for g in generators]).to(self.device)
        told = self._condition(batch, x0, generators)
        a, s = (w.float().view(-1, 1, 1, 1, 1) for w in self.prior.schedule.scales(t.double()))
        error = (self.prior(a * x0 + s * noise, t, *told) - x0).square()
        unit = self.prior.preconditioning(t)[1].clamp(min=self.typical_std / 2) ** -2
        return (unit * weight * error).mean() * x0.shape[1] / (1 + self.mask_weight * (x0.shape[1] - 1))

    def on_validation_start(self) -> None:
        if self.device_mesh is None:  # the parts of spread weights are looked at when they are put together
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
        return f"the last good checkpoint is {last}, so go on from it with --ckpt_path, or {anew}"

    def validation_step(self, batch: dict, index: int) -> None:
        x0, _ = self._clean_state(batch)
        generator = torch.Generator().manual_seed(index)
        noise = torch.randn(x0.shape, generator=generator).to(self.device)
        denoiser = self._denoiser(batch, x0)
        errors = denoising_errors(denoiser, x0, noise, self.prior.window)
        for t, error in errors.items():
            self.log(f"val/rmse_hu_t{t}", error, sync_dist=True, batch_size=len(x0))
        mean = torch.stack([*errors.values()]).mean()
        self.log("val/rmse_hu", mean, prog_bar=True, sync_dist=True, batch_size=len(x0))
        self.log("samples", float(self.samples), rank_zero_only=True, batch_size=len(x0))
        folder = Path(self.trainer.log_dir or self.trainer.default_root_dir) / "samples"  # asks every process
        painted = index < 2 and self.preview_steps
        if painted and (self.trainer.is_global_zero or self.device_mesh):  # spread weights need every process's help
            sample = ddim_sample(denoiser, noise, self.preview_steps)
        if painted and self.trainer.is_global_zero:
            self._write_preview(folder / f"step{self.global_step:06d}_{index}.png", batch, x0, sample)

    @abstractmethod
    def _write_preview(self, file: Path, batch: dict, x0: Tensor, sample: Tensor) -> None:
        """Writes a picture of a held-out case and a sample."""

    def configure_optimizers(self) -> dict:
        weights = [w for w in self.parameters() if w.requires_grad]
        optimizer = torch.optim.AdamW(weights, self.optimisation.learning_rate,
                                      weight_decay=self.optimisation.weight_decay)
        schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, self.optimisation.factor)
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}

    def on_save_checkpoint(self, checkpoint: dict) -> None:
        self._check_weights(checkpoint["state_dict"], checkpoint.get("current_model_state", {}))
        seen = {"steps": self.trainer.global_step, "samples": self.samples}
        checkpoint["phydict"] = self._describe() | {"training": seen}

    def on_load_checkpoint(self, checkpoint: dict) -> None:
        theirs, ours = {"stage": "base"} | checkpoint["phydict"], self._describe()
        check_stage(theirs, ours["stage"], "the checkpoint")
        for key, own in ours.items():
            if theirs[key] != own:
                raise ValueError(f"the checkpoint's prior and this training's differ in '{key}': give the settings and "
                                 "data that the checkpoint was trained with, or start anew with model.initial")
        self.samples = checkpoint["phydict"].get("training", {}).get("samples", 0)


def denoising_errors(denoiser: Denoiser, x0: Tensor, noise: Tensor, window: HUWindow) -> dict[float, Tensor]:
    """RMSE of the CT in HU, by time t of NOISE_LEVELS, of a denoiser's estimates of the state x0 (B, C, X, Y, Z) from
    x0 renoised with `noise`, of x0's shape."""
    errors = {}
    for t in NOISE_LEVELS:
        estimate = denoiser.denoise(renoise(denoiser.schedule, x0, t, noise), t)
        errors[t] = (estimate - x0)[:, 0].square().mean().sqrt() * window.half_width
    return errors
