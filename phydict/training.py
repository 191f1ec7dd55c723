"""Training a prior with Lightning: pairs with train.py."""

from __future__ import annotations

import sys
import time
import warnings
from pathlib import Path

import lightning
import torch
from jsonargparse import auto_cli
from lightning.pytorch.callbacks import ModelCheckpoint
from lightning.pytorch.cli import LightningCLI
from lightning.pytorch.loggers import CSVLogger
from lightning.pytorch.utilities import rank_zero_only
from lightning.pytorch.utilities.exceptions import MisconfigurationException
from torch import Tensor

from phydict.command_line import check_writable, one_sentence_errors, quiet
from phydict.datamodule import PriorData
from phydict.diffusion import renoise
from phydict.evaluation import method_panel
from phydict.grid import Grid
from phydict.posterior import descend
from phydict.prior import Prior, TextEncoder, VolumeUNet, describe, learn_vocabulary, load_prior, save_prior
from phydict.prior.checkpoint import build_prior, build_text
from phydict.prior.pretrained import inspect_prior, read_torch
from phydict.prior.report_training import learn_findings, learn_sketch
from phydict.units import HUWindow

CHECKPOINT, HELD_OUT = "last.ckpt", "held_out.txt"
"""Files of a training's folder: what it can be resumed from, and the ids of the CTs that it never saw."""

NOISE_LEVELS = (0.1, 0.3, 0.5, 0.7, 0.9)
"""Times t at which validation measures the denoising error."""


class PriorTraining(lightning.LightningModule):
    """Learns a Prior by denoising: squared error of x0 at all noise levels, up to four times heavier at the low ones.

    Args:
        network: the UNet; none given: the default VolumeUNet
        text: "small" for a BERT that learns reports first (none where the data have no reports), a folder or hub id
            for a frozen one, "none" for a prior without text
        reports: texts that the small BERT's vocabulary is learnt from (taken from the data)
        voxels: voxels along each side of the cube
        side: side of the cube in mm
        window: HU that the prior's range [-1, 1] stands for
        sigma_data: standard deviation of the data in the prior's range
        text_dropout: share of reports replaced by the null context, in [0, 1]
        mask_weight: weight of the anatomy masks' error beside the CT's
        learning_rate: of AdamW
        weight_decay: of AdamW
        warmup: steps over which the learning rate rises
        decay_from: step at which a linear decay of the learning rate to zero begins
        decay_steps: length of that decay in steps; 0: no decay
        text_steps: steps of each task by which a small BERT learns reports before denoising begins; 0: it learns by
            denoising
        montage_steps: noise levels of the samples that validation paints; 0: none
        initial: a prior's file to go on from, which then decides network and text
        seed: of times, noise and text dropout
    """

    def __init__(self, network: VolumeUNet | None = None, text: str = "small", reports: list[str] | None = None,
                 voxels: int = 64, side: float = 384.0, window: tuple[float, float] = (-1000.0, 1000.0),
                 sigma_data: float = 0.5, text_dropout: float = 0.1, mask_weight: float = 0.1,
                 learning_rate: float = 5e-4, weight_decay: float = 0.01, warmup: int = 100, decay_from: int = 0,
                 decay_steps: int = 0, text_steps: int = 600, montage_steps: int = 16, initial: str | None = None,
                 seed: int = 0):
        super().__init__()
        network = network or VolumeUNet()
        encoder = None
        if text == "small" and not reports:
            warnings.warn("the data have no reports: this prior will know no text")
        elif text == "small":
            encoder = TextEncoder.small(learn_vocabulary(reports), network.context_dim)
        elif text != "none":
            encoder = TextEncoder.pretrained(text)
        self.prior = Prior(network, Grid.cube(voxels, side), HUWindow(*window), encoder, sigma_data=sigma_data)
        if initial:
            self._start_from(load_prior(initial), initial)
        self.text_dropout, self.mask_weight, self.montage_steps = text_dropout, mask_weight, montage_steps
        self.learning_rate, self.weight_decay = learning_rate, weight_decay
        self.warmup, self.decay_from, self.decay_steps = warmup, decay_from, decay_steps
        self.text_steps = text_steps
        self.seed, self.last_step_at, self.samples = seed, None, 0

    def _start_from(self, prior: Prior, path: str) -> None:
        if not isinstance(prior, Prior):
            raise ValueError(f"training goes on from priors of phydict's own, but {path} is MedSyn's: leave out "
                             "model.initial")
        if not prior.grid.same_as(self.prior.grid) or prior.window != self.prior.window:
            raise ValueError(f"the prior {path} has another grid or HU window than this training: "
                             "set model.voxels, model.side and model.window to its own")
        if prior.load_text is not None:
            prior.text = prior.load_text()
            prior.text.trainable = prior.text.source is None
        self.prior = prior.train().requires_grad_(True)
        if prior.text is not None:
            prior.text.requires_grad_(prior.text.trainable)

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
        unit = self.prior.preconditioning(t)[1].clamp(min=0.25) ** -2
        loss = (unit * weight * error).sum() / (weight.expand_as(error).sum())
        self._log_speed(n)
        self.samples += n * self.trainer.world_size
        self.log("loss", loss, prog_bar=True, batch_size=n)
        return loss

    def learn_reports(self, data: PriorData) -> None:
        """Teaches a small report encoder and the text map, once, before the first denoising step.

        It belongs before `fit`, since distributed training watches every backward pass from there on.
        """
        text = self.prior.text
        if text is None or not text.trainable or not self.text_steps:
            return
        reports, labels = data.labelled_reports()
        if reports:
            losses = learn_findings(text, reports, labels, self.text_steps, self.seed)
            _tell(f"report encoder learns findings: loss {losses[0]:.3f} -> {losses[-1]:.3f}")
        _tell("preparing what reports imply")
        reports, maps = data.sketches(self.prior.network.text_map.cells)
        if reports:
            losses = learn_sketch(self.prior, reports, maps, self.text_steps, self.seed)
            _tell(f"text map learns what reports imply: squared error {losses[0]:.3f} -> {losses[-1]:.3f} of its variance")

    def on_fit_start(self) -> None:
        if self.prior.text is not None and self.text_steps:
            self.prior.text.trainable = False  # what it learnt stays, while the UNet learns to use it

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
            self.log("samples_per_s", samples * self.trainer.world_size / (now - self.last_step_at), prog_bar=True,
                     batch_size=samples)
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
            self.log(f"val/rmse_hu_t{t}", errors[-1], sync_dist=True, batch_size=len(x0))
        self.log("val/rmse_hu", torch.stack(errors).mean(), prog_bar=True, sync_dist=True, batch_size=len(x0))
        folder = Path(self.trainer.log_dir or self.trainer.default_root_dir) / "samples"  # asks every process
        if index < 2 and self.montage_steps and self.trainer.is_global_zero:
            sample = descend(denoiser, noise, self.montage_steps)
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
        seen = {"steps": self.trainer.global_step, "samples": self.samples}
        checkpoint["phydict"] = describe(self.prior) | {"training": seen}

    def on_load_checkpoint(self, checkpoint: dict) -> None:
        theirs, ours = checkpoint["phydict"], describe(self.prior)
        for key, own in ours.items():
            if theirs[key] != own:
                raise ValueError(f"the checkpoint's prior and this training's differ in '{key}': give the settings and "
                                 "data that the checkpoint was trained with, or start anew with model.initial")
        self.samples = checkpoint["phydict"].get("training", {}).get("samples", 0)


@rank_zero_only
def _tell(message: str) -> None:
    print(message, file=sys.stderr)


def read_checkpoint(path: str | Path) -> dict:
    """A checkpoint that training wrote. Raises FileNotFoundError, or ValueError when it is truncated, holds code or is
    another's."""
    if not Path(path).is_file():
        raise FileNotFoundError(f"there is no checkpoint {path}: give a .ckpt file that training wrote")
    checkpoint = read_torch(path)
    if not isinstance(checkpoint, dict) or "phydict" not in checkpoint:
        raise ValueError(f"{path} is no checkpoint of a prior: give a .ckpt file that training wrote")
    return checkpoint


def export_prior(checkpoint: str, out: str) -> None:
    """Write the averaged weights of a training checkpoint as a prior for reconstruction.

    Args:
        checkpoint: the .ckpt file that training wrote
        out: the .safetensors file to write
    """
    if Path(out).suffix != ".safetensors":
        raise ValueError(f"a prior is a .safetensors file, but {out} was given: give a name with that ending")
    check_writable(Path(out), "--out", file=True)
    content = read_checkpoint(checkpoint)
    header = content["phydict"]
    weights = {k.removeprefix("prior."): w for k, w in content["state_dict"].items() if k.startswith("prior.")}
    prior = build_prior(header, weights)
    if header["text"]:
        prior.text = build_text(header["text"], {k: w for k, w in weights.items() if k.startswith("text.")})
    save_prior(prior, out, header.get("training", {"steps": content["global_step"]}))
    print(f"prior in {out}")


def print_prior(path: str) -> None:
    """Tell what a file or folder is: a prior, a checkpoint of its training, or one of MedSyn's networks, and whether
    it is whole.

    Args:
        path: the file or folder
    """
    for file, properties in inspect_prior(path).items():
        print(file, *(f"  {name}: {value}" for name, value in properties.items()), sep="\n")


class PriorCLI(LightningCLI):
    """fit and validate; ties the data's grid and HU window to the model's, and writes everything below `out`."""

    @staticmethod
    def subcommands() -> dict[str, set[str]]:
        return {name: LightningCLI.subcommands()[name] for name in ("fit", "validate")}

    def add_arguments_to_parser(self, parser) -> None:
        parser.add_argument("--out", default="runs/prior", help="folder for checkpoint, logs and samples")
        parser.add_lightning_class_args(ModelCheckpoint, "checkpoint")
        parser.set_defaults({"checkpoint.filename": "last", "checkpoint.enable_version_counter": False,
                             "checkpoint.every_n_epochs": 1, "checkpoint.save_on_train_epoch_end": True})
        parser.link_arguments("out", "checkpoint.dirpath")
        parser.link_arguments("out", "trainer.default_root_dir")
        for name in ("voxels", "side", "window"):
            parser.link_arguments(f"model.{name}", f"data.{name}")
        parser.link_arguments("data.reports", "model.reports", apply_on="instantiate")

    def instantiate_trainer(self, **kwargs) -> lightning.Trainer:
        return super().instantiate_trainer(logger=CSVLogger(self._get(self.config, "out"), name="logs"), **kwargs)

    def before_fit(self) -> None:
        out = Path(self.config.fit.out)
        if self.config.fit.ckpt_path:
            return
        if (out / CHECKPOINT).exists():
            raise ValueError(f"{out} holds a training already: go on with --ckpt_path {out / CHECKPOINT}, or give "
                             "another folder with --out")
        if self.trainer.is_global_zero and self.datamodule.held_out:
            out.mkdir(parents=True, exist_ok=True)
            (out / HELD_OUT).write_text("".join(f"{case}\n" for case in self.datamodule.held_out))
        self.model.learn_reports(self.datamodule)

    def before_validate(self) -> None:
        if not (self.config.validate.ckpt_path or self.config.validate.model.initial):
            raise ValueError("validate needs trained weights: give --ckpt_path, or a prior's file as model.initial")

    def parse_arguments(self, parser, args) -> None:
        super().parse_arguments(parser, args)
        command = self.config.get("subcommand")  # none where nothing is run
        if not command:
            return
        check_writable(Path(self.config[command].out), "--out")
        checkpoint = self.config[command].ckpt_path
        if checkpoint and checkpoint not in ("last", "best"):
            read_checkpoint(checkpoint)


def main(args: list[str] | None = None) -> None:
    """Command line of training: fit, validate, export, inspect-prior. A bad input ends in one sentence and code 2."""
    given = sys.argv[1:] if args is None else args
    with one_sentence_errors(MisconfigurationException, to_go_on="add --ckpt_path and the run's last.ckpt"), quiet():
        if given[:1] == ["export"]:
            auto_cli(export_prior, args=given[1:], as_positional=False, exit_on_error=False)
        elif given[:1] == ["inspect-prior"]:
            auto_cli(print_prior, args=given[1:], exit_on_error=False)
        else:
            PriorCLI(PriorTraining, PriorData, args=args, seed_everything_default=0,
                     save_config_kwargs={"overwrite": True}, parser_kwargs={"exit_on_error": False, "description": (
                         "Train a prior of chest CT. Two more commands: `train.py export --checkpoint <last.ckpt> "
                         "--out <prior.safetensors>` writes what a training learnt as a prior for reconstruction, and "
                         "`train.py inspect-prior <path>` tells what a file or folder is.")})
