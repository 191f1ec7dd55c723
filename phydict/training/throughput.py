"""How fast a training is, beside what its machine can do at best."""

from __future__ import annotations

import json
import time
from collections.abc import Hashable, Sequence
from functools import cache
from typing import cast

import lightning
import torch
from torch import nn
from torch.utils.flop_counter import FlopCounterMode

from phydict.prior import Prior, SuperResolution
from phydict.runtime.precision import instruction_set
from phydict.runtime.progress_log import log_progress

REPEATS = 5
"""Matrix products of which the fastest counts."""


class Throughput(lightning.Callback):
    """Logs samples/s and TFLOP/s of all processes together, and prints at the start what to compare them with.

    A step that follows a validation or a checkpoint is not timed.

    FLOP are those of the network's forward and backward pass, a multiplication and an addition counting two; what
    gradient checkpointing computes twice counts once.

    Args:
        peak: TFLOP/s that one device reaches at best; none given: measured by a matrix product in the training's
            precision when training starts
    """

    def __init__(self, peak: float | None = None):
        if peak is not None and not peak > 0:
            raise ValueError(f"throughput.peak is a positive number of TFLOP/s, but {peak} was given: leave it out to "
                             "have it measured")
        self.peak, self.flop = peak, 0
        self.began: float | None = None

    def on_fit_start(self, trainer, module) -> None:
        self.began, self.flop = None, 0

    def _log_costs(self, trainer, module, shape: tuple[int, ...]) -> None:
        self.flop = module.calls * sample_flop(module.prior, shape)
        low = torch.bfloat16 if "bf16" in str(trainer.precision) else torch.float32
        precision, instructions = str(low).removeprefix("torch."), instruction_set(module.device)
        if self.peak is None:
            self.peak = matmul_peak(module.device, low) / 1e12
        weights = sum(weight.numel() for weight in module.prior.parameters() if weight.requires_grad)
        if trainer.is_global_zero:
            log_progress(f"training {weights / 1e6:.3g} M weights in {precision} on {instructions}: a sample costs "
                         f"{self.flop / 1e9:.3g} GFLOP forward and backward; a {precision} matrix product reaches "
                         f"{self.peak:.3g} TFLOP/s on this device", event="costs", weights=weights, precision=precision,
                         instruction_set=instructions, sample_flop=self.flop, peak_tflop_per_s=self.peak)

    def on_train_batch_start(self, trainer, module, batch, _) -> None:
        if not self.flop:
            self._log_costs(trainer, module, batch["volume"].shape[2:])
        now, samples = time.perf_counter(), len(batch["volume"])
        if self.began is not None:
            rate = samples * trainer.world_size / (now - self.began)
            tflops = rate * self.flop / 1e12
            module.log("samples_per_s", rate, prog_bar=True, batch_size=samples)
            module.log("tflop_per_s", tflops, prog_bar=True, batch_size=samples)
            module.log("share_of_peak", tflops / (self.peak * trainer.world_size), batch_size=samples)
        self.began = now

    def on_validation_start(self, trainer, module) -> None:
        self.began = None

    def on_save_checkpoint(self, trainer, module, checkpoint) -> None:
        self.began = None


def sample_flop(prior: Prior | SuperResolution, shape: Sequence[int]) -> int:
    """FLOP of the network's forward and backward pass over one state of `shape` voxels; nothing is computed. What a
    prior's detail network does, a tenth of it by default, is not counted."""
    with torch.device("meta"):
        inputs = prior.network_inputs(shape)
    kind = cast(Hashable, type(prior.network))
    return _network_flop(kind, json.dumps(prior.network.settings), tuple((part.shape, part.dtype) for part in inputs))


@cache
def _network_flop(kind: type[nn.Module], settings: str, inputs: tuple[tuple[torch.Size, torch.dtype], ...]) -> int:
    """As `sample_flop`, of a network of these settings (JSON) and inputs."""
    with torch.device("meta"):
        network, given = kind(**json.loads(settings)), [torch.zeros(shape, dtype=dtype) for shape, dtype in inputs]
    with FlopCounterMode(display=False) as counter:
        network(*given).sum().backward()
    return counter.get_total_flops()


@cache
def matmul_peak(device: torch.device, dtype: torch.dtype) -> float:
    """FLOP/s of the fastest of a few square matrix products on `device`, measured once."""
    n = 1024 if device.type == "cpu" else 8192
    a, b = torch.rand(2, n, n, device=device).to(dtype)
    seconds = []
    for _ in range(REPEATS + 1):
        began = time.perf_counter()
        a @ b
        if device.type != "cpu":
            torch.accelerator.synchronize(device)
        seconds.append(time.perf_counter() - began)
    return 2 * n**3 / min(seconds)
