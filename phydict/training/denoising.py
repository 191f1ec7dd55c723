"""Training one stage of a cascade by denoising, whatever the stage is."""

from __future__ import annotations

from abc import abstractmethod
from pathlib import Path

import torch
from torch import Tensor

from phydict.diffusion import Denoiser, noise_like, renoise
from phydict.posterior import ddim_sample
from phydict.prior import Prior, SuperResolution
from phydict.training.settings import Optimisation
from phydict.training.stage import StageTraining
from phydict.units import HUWindow

NOISE_LEVELS = (0.1, 0.3, 0.5, 0.7, 0.9)
"""Times t at which validation measures the denoising error."""


class DenoisingTraining(StageTraining):
    """Learns one stage by denoising: squared error of x0 at all noise levels, up to four times heavier at the low ones.

    A stage says what a batch's clean state is (`_clean_state`), what conditions its network (`_condition`), and
    what denoises a held-out case (`_denoiser`).
    """

    prior: Prior | SuperResolution

    def __init__(self, prior: Prior | SuperResolution, typical_std: float, optimisation: Optimisation,
                 preview_steps: int, seed: int, mask_weight: float = 0.0, initial: str | None = None):
        super().__init__(prior, optimisation, seed, initial)
        self.typical_std, self.preview_steps, self.mask_weight = typical_std, preview_steps, mask_weight

    @abstractmethod
    def _clean_state(self, batch: dict) -> tuple[Tensor, Tensor]:
        """The clean state (B, C, X, Y, Z) of a batch and the weight of each channel's error (B, C, 1, 1, 1)."""

    @abstractmethod
    def _condition(self, batch: dict, x0: Tensor, generators: list[torch.Generator]) -> tuple[Tensor, ...]:
        """What conditions the network beside the noisy state and its time; one source of randomness per sample."""

    @abstractmethod
    def _denoiser(self, batch: dict, x0: Tensor) -> Denoiser:
        """The denoiser of a held-out case."""

    def batch_loss(self, batch: dict, key: tuple[int, ...] = (0,), rank: int = 0, processes: int = 1) -> Tensor:
        """Weighted squared error of one batch's clean estimates, at times and with noise drawn by `key`."""
        x0, weight = self._clean_state(batch)
        places = range(rank, len(x0) * processes, processes)
        generators = [torch.Generator().manual_seed(hash((*key, place)) % 2**31) for place in places]
        u = torch.cat([torch.rand(1, generator=generator) for generator in generators])
        t = ((torch.tensor(places) + u) / (len(x0) * processes)).to(self.device)
        noise = torch.stack([_noise(x0[0], generator) for generator in generators])
        conditioning = self._condition(batch, x0, generators)
        a, s = (w.float().view(-1, 1, 1, 1, 1) for w in self.prior.schedule.scales(t.double()))
        error = (self.prior(a * x0 + s * noise, t, *conditioning) - x0).square()
        weight = self.time_weight(t) * weight
        return (weight * error).mean() * x0.shape[1] / (1 + self.mask_weight * (x0.shape[1] - 1))

    def time_weight(self, t: Tensor) -> Tensor:
        """The weight (B, 1, 1, 1, 1) of the squared error of x0 at times t (B,)."""
        return self.prior.preconditioning(t)[1].clamp(min=self.typical_std / 2) ** -2

    def validation_step(self, batch: dict, index: int) -> None:
        x0, _ = self._clean_state(batch)
        noise = noise_like(x0, torch.Generator().manual_seed(self.validation_number(index)))
        denoiser = self._denoiser(batch, x0)
        errors = denoising_errors(denoiser, x0, noise, self.prior.window)
        for t, error in errors.items():
            self.log_case(index, f"val/rmse_hu_t{t}", error)
        mean = torch.stack([*errors.values()]).mean()
        self.log_case(index, "val/rmse_hu", mean, prog_bar=True)
        self.log("samples", float(self.samples), rank_zero_only=True, batch_size=len(x0))
        folder = Path(self.trainer.log_dir or self.trainer.default_root_dir) / "samples"  # asks every process
        painted = index < 2 and self.preview_steps
        if painted and (self.trainer.is_global_zero or self.device_mesh):  # sharded weights need every process's help
            sample = ddim_sample(denoiser, noise, self.preview_steps)
        if painted and self.trainer.is_global_zero:
            self._write_preview(folder / f"step{self.global_step:06d}_{index}.png", batch, x0, sample)

    @abstractmethod
    def _write_preview(self, file: Path, batch: dict, x0: Tensor, sample: Tensor) -> None:
        """Writes a picture of a held-out case and a sample."""


def _noise(like: Tensor, generator: torch.Generator) -> Tensor:
    """Normal noise of a tensor's shape, drawn where the tensor is: a CPU would take longer than a GPU for a step."""
    if like.device.type != "cpu":
        seed = int(torch.randint(2**62, (1,), generator=generator))
        generator = torch.Generator(like.device).manual_seed(seed)
    return torch.randn(like.shape, device=like.device, generator=generator)


def denoising_errors(denoiser: Denoiser, x0: Tensor, noise: Tensor, window: HUWindow) -> dict[float, Tensor]:
    """RMSE of the CT in HU, by time t of NOISE_LEVELS, of a denoiser's estimates of the state x0 (B, C, X, Y, Z) from
    x0 renoised with `noise`, of x0's shape."""
    errors = {}
    for t in NOISE_LEVELS:
        estimate = denoiser.denoise(renoise(denoiser.schedule, x0, t, noise), t)
        errors[t] = (estimate - x0)[:, 0].square().mean().sqrt() * window.half_width
    return errors
