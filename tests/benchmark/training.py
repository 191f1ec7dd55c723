"""What a training step costs: ours against one written with MONAI's own inferer, and what each flag changes.

    python tests/benchmark/training.py [names of the steps to measure, "float32" first]

Every step runs in a process of its own, on the shipped prior, the same phantoms and the CPU. Seconds are the median
step, after one that compiles and allocates; memory is what the process grew by at its peak, from before its first
step. Writes training.csv beside this file. torch.compile takes minutes, unless it finds what an earlier run compiled.
"""

import resource
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from statistics import median

import lightning
import torch
from lightning.pytorch.callbacks import EMAWeightAveraging
from monai.inferers import DiffusionInferer
from monai.networks.schedulers import DDPMScheduler
from torch.utils.data import DataLoader

from phydict.datasets import phantom_case
from phydict.evaluation import write_csv
from phydict.grid import Cube
from phydict.prior import VolumeUNet, load_prior
from phydict.prior.files import DEFAULT_PRIOR
from phydict.runtime.console import quiet
from phydict.runtime.precision import instruction_set
from phydict.training import PriorTraining
from phydict.training.settings import Execution, PriorValidation
from phydict.training.throughput import matmul_peak, sample_flop

BATCH, STEPS, WARM_UP = 2, 8, 1

MONAI = "MONAI's DiffusionInferer"
OURS = {"float32": {}, "bf16": {"precision": "bf16-mixed"}, "gradient checkpointing": {"gradient_checkpointing": True},
        "bf16, gradient checkpointing": {"precision": "bf16-mixed", "gradient_checkpointing": True},
        "channels first": {"channels_last": False},
        "weight averaging": {"callbacks": [EMAWeightAveraging(decay=0.999)]}, "torch.compile": {"compile": True}}


class Clock(lightning.Callback):
    """When steps begin and end, and their losses."""

    def __init__(self):
        self.seconds, self.losses = [], []

    def on_train_batch_start(self, *_) -> None:
        self.began = time.perf_counter()

    def on_train_batch_end(self, trainer, module, outputs, *_) -> None:
        self.seconds.append(time.perf_counter() - self.began)
        self.losses.append(float(outputs["loss"]))


class MonaiNames(torch.nn.Module):
    """Our network as MONAI's inferer calls one."""

    def __init__(self, network: VolumeUNet):
        super().__init__()
        self.network = network

    def forward(self, x, timesteps, context):
        return self.network(x, timesteps / 1000, context)


def our_steps(loader: DataLoader, precision: str = "32-true", callbacks: list = (), **flags) -> Clock:
    clock, task = Clock(), new_task(**flags)
    trainer = lightning.Trainer(
        max_steps=STEPS + WARM_UP, accelerator="cpu", precision=precision, callbacks=[clock, *callbacks], logger=False,
        enable_checkpointing=False, enable_progress_bar=False, enable_model_summary=False)
    trainer.fit(task, loader)
    return clock


def monai_steps(loader: DataLoader) -> Clock:
    clock, prior = Clock(), new_task().prior
    model = MonaiNames(prior.network)
    prior.text.trainable = False  # as in our training
    inferer = DiffusionInferer(DDPMScheduler(num_train_timesteps=1000, schedule="cosine", prediction_type="sample"))
    optimizer = torch.optim.AdamW(model.parameters(), 5e-4, weight_decay=0.01)
    for index, batch in enumerate(loader):
        clock.on_train_batch_start()
        x0 = torch.cat([batch["volume"], 2 * batch["masks"] - 1], 1)
        context = prior.context(batch["report"])
        estimate = inferer(inputs=x0, diffusion_model=model, noise=torch.randn_like(x0),
                           timesteps=torch.randint(0, 1000, (BATCH,)), condition=context)
        loss = torch.nn.functional.mse_loss(estimate, x0)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        clock.on_train_batch_end(None, None, {"loss": loss.detach()}, batch, index)
    return clock


def new_task(**flags) -> PriorTraining:
    torch.manual_seed(0)
    prior = load_prior(DEFAULT_PRIOR)
    return PriorTraining(initial=str(DEFAULT_PRIOR),
                         window=(prior.window.low, prior.window.high),
                         cube=Cube(prior.grid.shape[0], prior.grid.extent[0]), validation=PriorValidation(0),
                         execution=Execution(**flags))


def example_cases() -> list[dict]:
    """A batch of phantoms, as training is given them."""
    prior = new_task().prior
    cases = [phantom_case(seed, prior.grid, prior.window) for seed in range(BATCH)]
    return [{key: case[key] for key in ("volume", "masks", "has_masks", "report")} for case in cases]


def peak_mib() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024  # Linux counts KiB


def measure(name: str, cases: list[dict]) -> dict:
    """One row of the table, and the losses."""
    loader = DataLoader(cases * (STEPS + WARM_UP), BATCH)
    prior = new_task().prior
    flop = sample_flop(prior, prior.grid.shape)
    low = torch.bfloat16 if "bf16" in name else torch.float32
    peak = matmul_peak(torch.device("cpu"), low)
    before = peak_mib()
    with quiet():
        clock = monai_steps(loader) if name == MONAI else our_steps(loader, **OURS[name])
    seconds = median(clock.seconds[WARM_UP:])
    return {"step": name, "instruction_set": instruction_set(torch.device("cpu")),
            "threads": torch.get_num_threads(), "batch": BATCH, "seconds": seconds,
            "samples_per_s": BATCH / seconds,
            "tflop_per_s": BATCH * flop / seconds / 1e12, "matmul_peak_tflop_per_s": peak / 1e12,
            "share_of_peak": BATCH * flop / seconds / peak, "memory_mib": peak_mib() - before, "losses": clock.losses}


if __name__ == "__main__":
    cases, rows = example_cases(), []
    for name in sys.argv[1:] or ["float32", MONAI, *list(OURS)[1:]]:
        with ProcessPoolExecutor(1, get_context("spawn")) as fresh:
            row = fresh.submit(measure, name, cases).result()
        losses = row.pop("losses")
        if not rows:
            plain, plain_losses = row, losses
        row["times_float32"] = row["seconds"] / plain["seconds"]
        row["memory_times_float32"] = row["memory_mib"] / plain["memory_mib"]
        row["loss_difference"] = None if name == MONAI else max(
            abs(own / other - 1) for own, other in zip(losses, plain_losses))
        rows.append(row)
        write_csv(Path(__file__).with_suffix(".csv"), rows)
        print(f"{name}: {row['seconds']:.2f} s", file=sys.stderr)
    print("| step | seconds | x float32 | TFLOP/s | of matmul peak | memory (MiB) | x float32 | loss differs by |")
    print("|---|---:|---:|---:|---:|---:|---:|---:|")
    for row in rows:
        differs = "another loss" if row["loss_difference"] is None else f"{row['loss_difference']:.0e}"
        print(f"| {row['step']} | {row['seconds']:.2f} | {row['times_float32']:.2f} | {row['tflop_per_s']:.3f} | "
              f"{100 * row['share_of_peak']:.0f} % | {row['memory_mib']:.0f} | {row['memory_times_float32']:.2f} | "
              f"{differs} |")
