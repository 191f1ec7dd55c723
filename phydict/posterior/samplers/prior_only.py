"""The prior alone, sampled: the unconditional end of every comparison."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from torch import Tensor

from phydict.diffusion import Generators
from phydict.diffusion.denoiser import Denoiser
from phydict.posterior.measurement import Measurement
from phydict.posterior.samplers.sampler import Sampler, ddim_sample


@dataclass(frozen=True)
class PriorOnly(Sampler):
    """A sample of the prior that ignores the X-rays: deterministic DDIM with `iterations` noise levels.

    Args:
        iterations: noise levels, evenly spaced in time
        final_denoise: denoise once more at time 0; None: where the prior's own inference does, which its `ends_at_zero`
            says
    """

    citation = "Song, Meng & Ermon, Denoising Diffusion Implicit Models, ICLR 2021, arXiv:2010.02502"

    iterations: int = 50
    final_denoise: bool | None = None
    batches = True
    sees_xrays = False

    def steps(self) -> int:
        return self.iterations + bool(self.final_denoise)

    def suited(self, prior: object) -> PriorOnly:
        if self.final_denoise is not None:
            return self
        return replace(self, final_denoise=getattr(prior, "ends_at_zero", False))

    def sample(self, denoiser: Denoiser, measurement: Measurement | None, x: Tensor, generator: Generators | None,
               on_step: Callable[[], None] = lambda: None) -> Tensor:
        return ddim_sample(denoiser, x, self.iterations, on_step=on_step, final_denoise=bool(self.final_denoise))
