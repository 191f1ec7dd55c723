"""Training a prior with Lightning: pairs with train.py."""

from __future__ import annotations

import time
from pathlib import Path

import lightning
import torch
from lightning.pytorch.cli import LightningCLI
from torch import Tensor

from phydict.datamodule import PriorData
from phydict.diffusion import renoise
from phydict.evaluation import method_panel
from phydict.grid import Grid
from phydict.posterior import descend
from phydict.prior import Prior, TextEncoder, VolumeUNet, describe, learn_vocabulary
from phydict.units import HUWindow

NOISE_LEVELS = (0.1, 0.3, 0.5, 0.7, 0.9)
"""Times t at which validation measures the denoising error."""


class PriorTraining(lightning.LightningModule):
    """Learns a Prior by denoising: squared error of x0, weighted to unit variance at every noise level.

    network: the UNet (None: the default VolumeUNet); text: "small" for a BERT that learns with the prior, a folder
    or hub id for a frozen one, "none" for a prior without text; reports: texts the small BERT's vocabulary is learnt
    from; text_dropout: share of reports replaced by the null context; mask_weight: weight of the anatomy masks'
    error beside the CT's; warmup: steps over which the learning rate rises; decay_from, decay_steps: the step at
    which a linear decay to zero begins, and its length (0: no decay).
    """

    def __init__(self, network: VolumeUNet | None = None, text: str = "small", reports: list[str] | None = None,
                 voxels: int = 64, side: float = 384.0, window: tuple[float, float] = (-1000.0, 1000.0), sigma_data: float = 0.5,
                 text_dropout: float = 0.1, mask_weight: float = 0.1, learning_rate: float = 5e-4,
                 weight_decay: float = 0.01, warmup: int = 100, decay_from: int = 0, decay_steps: int = 0,
                 montage_steps: int = 16, seed: int = 0):
        super().__init__()
        network = network or VolumeUNet()
        encoder = None
        if text == "small":
            if not reports:
                raise ValueError("a small text encoder learns its vocabulary from reports, but the data have none: "
                                 "give data with reports, or set model.text to none")
            encoder = TextEncoder.small(learn_vocabulary(reports), network.context_dim)
        elif text != "none":
            encoder = TextEncoder.pretrained(text)
        self.prior = Prior(network, Grid.cube(voxels, side), HUWindow(*window), encoder, sigma_data=sigma_data)
        self.text_dropout, self.mask_weight, self.montage_steps = text_dropout, mask_weight, montage_steps
        self.learning_rate, self.weight_decay = learning_rate, weight_decay
        self.warmup, self.decay_from, self.decay_steps = warmup, decay_from, decay_steps
        self.seed, self.last_step_at = seed, None

    def training_step(self, batch: dict, _) -> Tensor:
        # Times and noise follow from seed and step alone, so that a resumed run repeats an uninterrupted one.
        draw = torch.Generator().manual_seed(hash((self.seed, self.global_step, self.global_rank)) % 2**31)
        x0, weight = self._state(batch)
        n = len(x0)
        t = ((torch.arange(n) + torch.rand(n, generator=draw)) / n).to(self.device)
        noise = torch.randn(x0.shape, generator=draw).to(self.device)
        reports = batch["report"] if self.prior.text is not None else [""] * n
        keep = torch.rand(n, generator=draw) >= self.text_dropout
        context = self.prior.context([r if k else "" for r, k in zip(reports, keep)])
        a, s = (w.float().view(-1, 1, 1, 1, 1) for w in self.prior.schedule.scales(t.double()))
        error = (self.prior(a * x0 + s * noise, t, context) - x0).square()
        unit = (s**2 + (a * self.prior.sigma_data) ** 2) / (s * self.prior.sigma_data) ** 2
        loss = (unit * weight * error).sum() / (weight.expand_as(error).sum())
        self._log_speed(n)
        self.log("loss", loss, prog_bar=True)
        return loss

    def _state(self, batch: dict) -> tuple[Tensor, Tensor]:
        """The clean state (B, C, X, Y, Z) of a batch and the weight of each channel's error (B, C, 1, 1, 1)."""
        channels = self.prior.network.state_channels
        x0 = torch.cat([batch["volume"], 2 * batch["masks"] - 1], 1)[:, :channels]
        known = self.mask_weight * batch["has_masks"].float()
        weight = torch.cat([torch.ones_like(known[:, :1]), known], 1)[:, :channels]
        return x0, weight[..., None, None, None]

    def _log_speed(self, samples: int) -> None:
        now = time.perf_counter()
        if self.last_step_at is not None:
            self.log("samples_per_s", samples * self.trainer.world_size / (now - self.last_step_at), prog_bar=True)
        self.last_step_at = now

    def validation_step(self, batch: dict, index: int) -> None:
        x0, _ = self._state(batch)
        draw = torch.Generator().manual_seed(index)
        noise = torch.randn(x0.shape, generator=draw).to(self.device)
        errors = []
        for t in NOISE_LEVELS:
            denoiser = self.prior.bind(batch["report"][0] if self.prior.text is not None else "")
            estimate = denoiser.denoise(renoise(self.prior.schedule, x0, t, noise), t)
            errors.append((estimate - x0)[:, 0].square().mean().sqrt() * self.prior.window.half_width)
            self.log(f"val/rmse_hu_t{t}", errors[-1], sync_dist=True)
        self.log("val/rmse_hu", torch.stack(errors).mean(), prog_bar=True, sync_dist=True)
        if index < 4 and self.montage_steps and self.trainer.is_global_zero:
            sample = descend(denoiser, noise, self.montage_steps)
            folder = Path(self.trainer.log_dir or self.trainer.default_root_dir) / "samples"
            window = self.prior.window
            method_panel(folder / f"step{self.global_step:06d}_{index}.png",
                         {"prior sample": window.to_hu(sample[0, 0].cpu())}, window.to_hu(x0[0, 0].cpu()),
                         self.prior.grid, title=batch["report"][0][:80] or "no report")

    def configure_optimizers(self) -> dict:
        def factor(step: int) -> float:
            rise = min(1.0, (step + 1) / self.warmup) if self.warmup else 1.0
            past = step - self.decay_from
            return rise * (max(0.0, 1 - past / self.decay_steps) if self.decay_steps and past > 0 else 1.0)

        weights = [w for w in self.parameters() if w.requires_grad]
        optimizer = torch.optim.AdamW(weights, self.learning_rate, weight_decay=self.weight_decay)
        schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, factor)
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}

    def on_save_checkpoint(self, checkpoint: dict) -> None:
        checkpoint["phydict"] = describe(self.prior)


class PriorCLI(LightningCLI):
    """Ties the data's grid and HU window to the model's."""

    def add_arguments_to_parser(self, parser) -> None:
        for name in ("voxels", "side", "window"):
            parser.link_arguments(f"model.{name}", f"data.{name}")
        parser.link_arguments("data.reports", "model.reports", apply_on="instantiate")


def main(args: list[str] | None = None) -> None:
    """Command line of training: fit, validate."""
    PriorCLI(PriorTraining, PriorData, args=args, seed_everything_default=0,
             save_config_kwargs={"overwrite": True},
             parser_kwargs={"default_env": False})
