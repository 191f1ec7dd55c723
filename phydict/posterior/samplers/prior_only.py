"""The prior alone, sampled: the unconditional end of every comparison."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from torch import Tensor

from phydict.diffusion.denoiser import Denoiser
from phydict.diffusion.steps import Draw
from phydict.posterior.measurement import Measurement
from phydict.posterior.samplers.sampler import Sampler, descend


@dataclass(frozen=True)
class PriorOnly(Sampler):
    """A sample of the prior that ignores the X-rays: deterministic DDIM with `iterations` noise levels.

    at_zero: denoise once more at time 0; None: where the prior's own inference does, which its `ends_at_zero` says.
    """

    citation = "Song, Meng & Ermon, Denoising Diffusion Implicit Models, ICLR 2021, arXiv:2010.02502"

    iterations: int = 50
    at_zero: bool | None = None
    batches = True

    def steps(self) -> int:
        return self.iterations + bool(self.at_zero)

    def suited(self, prior: object) -> PriorOnly:
        return self if self.at_zero is not None else replace(self, at_zero=getattr(prior, "ends_at_zero", False))

    def sample(self, denoiser: Denoiser, measurement: Measurement | None, x: Tensor, draw: Draw,
               on_step: Callable[[], None] = lambda: None) -> Tensor:
        return descend(denoiser, x, self.iterations, on_step=on_step, at_zero=self.suited(denoiser).at_zero)
