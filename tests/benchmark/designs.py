"""Designs of the prior's network and of its training, compared after equal training effort.

    python tests/benchmark/designs.py <folder of training CTs> [--out runs/designs] [--seconds 360] [--designs ...]

Each design learns from the same draws, for the same CPU time of one thread, which other work on the machine does not
change; noise and times are the same too where the batches are. The learning rate rises over 30 steps and falls to zero
over the second half of the time; the weights are averaged. LIDC-IDRI-0004 and the phantoms from seed 1,000,000 on are
held out. A training that was stopped resumes from its last checkpoint in --out; a design that designs.csv holds already
is not run again.

Writes designs.csv beside this file, one row per design and held-out case: denoising error (RMSE of the CT in HU) at
each noise level, and SSIM, PSNR and MAE of phydict_fast's reconstruction from four ideal views; CPU seconds of one
call of the denoiser relative to the default VolumeUNet's, measured in turns on one thread.
"""

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from statistics import mean

import lightning
import torch
from lightning.pytorch.callbacks import EMAWeightAveraging, ModelCheckpoint
from torch import nn
from torch.nn.functional import avg_pool3d
from torch.utils.data import Dataset

from phydict.datasets.cts.cache import kept_case
from phydict.evaluation import read_csv, write_csv
from phydict.prior import Prior, VolumeUNet
from phydict.runtime.console import quiet
from phydict.runtime.precision import trainer_precision
from phydict.training.data import PriorData
from phydict.training.denoising import denoising_errors
from phydict.training.prior import PriorTraining
from phydict.training.scores import reconstruction_scores
from phydict.training.settings import HoldOut, Loading, PriorOptimisation, TextSettings
from phydict.training.stage import CHECKPOINT

FILE = Path(__file__).with_suffix(".csv")
HELD_OUT_CT = "LIDC-IDRI-0004"
VIEWS = 4
WARMUP = 30


@dataclass(frozen=True)
class Design:
    """What differs from VolumeUNet's defaults, and how Prior and StageTraining use the network.

    middle_attention: attention between encoder and decoder. weighting: of the error of x0 against noise, one of
    WEIGHTINGS. seed: of initial weights, times and noise. batch: draws at a step. learning_rate: its largest. average:
    decay of the averaged weights. coarse: share of the time in which it learns from voxels of twice the side.
    """

    network: dict = field(default_factory=dict)
    middle_attention: bool = True
    weighting: str = "clamped"
    seed: int = 0
    batch: int = 2
    learning_rate: float = 1e-3
    average: float = 0.99
    coarse: float = 0.0


DESIGNS = {
    "block 2, 32-64-128": Design(),
    "the same, another seed": Design(seed=1),
    "the same, again": Design(),
    "block 4, 128-192": Design({"block": 4, "channels": (128, 192), "attention": (False, True)}),
    "without attention": Design({"attention": (False,) * 3}, middle_attention=False),
    "narrow, 24-48-96": Design({"channels": (24, 48, 96), "head_channels": 24}),
    "even weights": Design(weighting="even"),
    "weights of v": Design(weighting="v"),
    "min-SNR 5": Design(weighting="min-SNR 5"),
    "batch 1": Design(batch=1),
    "batch 4": Design(batch=4),
    "rate 5e-4": Design(learning_rate=5e-4),
    "rate 2e-3": Design(learning_rate=2e-3),
    "averaged by 0.9": Design(average=0.9),
    "coarse first": Design(coarse=0.4),
}

WEIGHTINGS: dict[str, Callable[[torch.Tensor, torch.Tensor], torch.Tensor]] = {
    "clamped": lambda snr, scale: scale.clamp(min=0.25) ** -2,
    "even": lambda snr, scale: torch.ones_like(snr),
    "v": lambda snr, scale: 1 + snr,
    "min-SNR 5": lambda snr, scale: snr.clamp(max=5),
}
"""Of the squared error of x0, by the signal-to-noise ratio and the size of what the network adds (`preconditioning`):
the training's own; one weight for all; that of an error of v (Salimans and Ho, arXiv:2202.00512); min-SNR (Hang et al.,
arXiv:2303.09556)."""


class Weighted(PriorTraining):
    """PriorTraining by one of WEIGHTINGS, scaled so that an error of the network's own size costs as much on average:
    the clipped gradient and the learning rate then mean the same for each."""

    def __init__(self, design: Design):
        super().__init__(VolumeUNet(**design.network), TextSettings("none"), seed=design.seed,
                         optimisation=PriorOptimisation(learning_rate=design.learning_rate, warmup=0))
        self.weighting, self.scale = WEIGHTINGS[design.weighting], 1.0
        times = torch.linspace(0.0005, 0.9995, 1000)
        size = self.prior.preconditioning(times)[1].square()
        self.scale = float((super().time_weight(times) * size).mean() / (self.time_weight(times) * size).mean())

    def time_weight(self, t: torch.Tensor) -> torch.Tensor:
        sigma = self.prior.schedule.sigma(t.double()).float().view(-1, 1, 1, 1, 1)
        return self.scale * self.weighting(sigma**-2, self.prior.preconditioning(t)[1])


class NoAttention(nn.Module):
    """Stands where MONAI's network has attention, and changes nothing."""

    def forward(self, x: torch.Tensor, context: torch.Tensor) -> torch.Tensor:
        return x


class CachedDraws(Dataset):
    """Draws of one epoch, each kept as a file when it was first made."""

    def __init__(self, draws: Dataset, folder: Path):
        self.draws, self.folder = draws, folder

    def __len__(self) -> int:
        return len(self.draws)

    def __getitem__(self, i: int) -> dict:
        parts = ("volume", "masks", "has_masks")
        return kept_case(self.folder / f"{i:04d}.npz", lambda: self.draws[i], parts) | {"report": ""}


class Draws(PriorData):
    """PriorData whose deformed draws are kept, so that every design learns from them and only one waits for them."""

    def draws(self, epoch: int) -> Dataset:
        return CachedDraws(super().draws(epoch), self.folder / f"epoch{epoch:04d}")


class Effort(lightning.Callback):
    """Ends a training after `seconds` of CPU time in its steps, and sets the learning rate by the share that is
    spent; over the first `coarse` of them, batches are means over blocks of 2^3 voxels."""

    def __init__(self, seconds: float, coarse: float):
        self.seconds, self.coarse, self.spent = seconds, coarse, 0.0

    def on_train_batch_start(self, trainer, module, batch, index) -> None:
        if self.spent < self.coarse * self.seconds:
            batch |= {key: avg_pool3d(batch[key], 2) for key in ("volume", "masks")}
        rate = min(1.0, (trainer.global_step + 1) / WARMUP) * min(1.0, max(0.0, 2 - 2 * self.spent / self.seconds))
        for group in trainer.optimizers[0].param_groups:
            group["lr"] = rate * module.optimisation.learning_rate
        self.begun = time.process_time()

    def on_train_batch_end(self, trainer, module, outputs, batch, index) -> None:
        self.spent += time.process_time() - self.begun
        trainer.should_stop = self.spent >= self.seconds

    def state_dict(self) -> dict:
        return {"spent": self.spent}

    def load_state_dict(self, state: dict) -> None:
        self.spent = state["spent"]


def learnt(design: Design, data: PriorData, seconds: float, folder: Path) -> tuple[Prior, int]:
    """The prior that a design becomes, and the samples that it saw."""
    torch.manual_seed(design.seed)
    training = Weighted(design)
    if not design.middle_attention:
        training.prior.network.unet.middle_block.attention = NoAttention()
    last = folder / CHECKPOINT
    callbacks = [Effort(seconds, design.coarse), EMAWeightAveraging(decay=design.average), ModelCheckpoint(
        folder, "last", every_n_epochs=1, save_on_train_epoch_end=True, enable_version_counter=False)]
    trainer = lightning.Trainer(
        accelerator="cpu", devices=1, precision=trainer_precision("auto", torch.device("cpu")), gradient_clip_val=1.0,
        max_epochs=-1, logger=False, limit_val_batches=0, reload_dataloaders_every_n_epochs=1, callbacks=callbacks,
        enable_model_summary=False, enable_progress_bar=False)
    trainer.fit(training, data, ckpt_path=last if last.exists() else None)
    return training.prior.eval(), training.samples


def scores(prior: Prior, cases: list[dict]) -> list[dict]:
    """For each held-out case, denoising errors and the scores of a reconstruction."""
    denoiser, rows = prior.bind(), []
    for i, case in enumerate(cases):
        x0 = torch.cat([case["volume"], 2 * case["masks"] - 1])[None]
        noise = torch.randn(x0.shape, generator=torch.Generator().manual_seed(i))
        errors = denoising_errors(denoiser, x0, noise, prior.window)
        row = {"case": case["id"]} | {f"rmse_hu_t{t}": float(error) for t, error in errors.items()}
        rows.append(row | reconstruction_scores(prior, x0[:, :1], VIEWS, i))
    return rows


def call_seconds(priors: list[Prior], rounds: int = 7) -> list[float]:
    """The least CPU seconds of one call of each prior's denoiser, measured in turns."""
    best = [float("inf")] * len(priors)
    for _ in range(rounds):
        for i, prior in enumerate(priors):
            denoiser, x = prior.bind(), torch.zeros(1, prior.state_channels, *prior.grid.shape)
            begun = time.process_time()
            denoiser.denoise(x, 0.5)
            best[i] = min(best[i], time.process_time() - begun)
    return best


def parser() -> argparse.ArgumentParser:
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("cts", help="folder of training CTs")
    arguments.add_argument("--out", type=Path, default=Path("runs/designs"), help="checkpoints and cached draws")
    arguments.add_argument("--seconds", type=float, default=360.0, help="CPU time of each training")
    arguments.add_argument("--phantoms", type=int, default=200)
    arguments.add_argument("--designs", nargs="*", choices=DESIGNS, default=list(DESIGNS), metavar="NAME",
                           help=", ".join(DESIGNS))
    return arguments


if __name__ == "__main__":
    given = parser().parse_args()
    torch.set_num_threads(1)
    with quiet():
        data = Draws(given.cts, holdout=HoldOut([HELD_OUT_CT], phantoms=2), phantoms=given.phantoms,
                     loading=Loading(epoch_size=50, batch_size=2, ct_fraction=0.4), cache=str(given.out / "cache"))
        data.folder = given.out / "draws"
        cases = [data.validation[i] | {"id": name} for i, name in
                 enumerate(("held-out phantom 0", "held-out phantom 1", *data.held_out))]
        today = PriorTraining(VolumeUNet(), TextSettings("none")).prior.eval()
        for name in given.designs:
            if any(row["design"] == name and row["budget_s"] == given.seconds for row in read_csv(FILE)):
                continue
            data.loading = replace(data.loading, batch_size=DESIGNS[name].batch)
            prior, samples = learnt(DESIGNS[name], data, given.seconds, given.out / f"{name}, {given.seconds:g} s")
            own, least = call_seconds([prior, today])
            told = {"design": name, "budget_s": given.seconds, "samples": samples,
                    "parameters": sum(w.numel() for w in prior.parameters()), "relative_call": own / least}
            new = [told | row for row in scores(prior, cases)]
            write_csv(FILE, read_csv(FILE) + new)
            print(name, {k: round(mean(row[k] for row in new), 3) for k in new[0] if k not in ("case", "design")},
                  flush=True)
