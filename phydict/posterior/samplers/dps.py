"""DPS: ancestral steps of the prior, each pushed along the gradient of the misfit through the denoiser.

| here                           | publication                                                     |
|--------------------------------|-----------------------------------------------------------------|
| noise_in, stochastic_ddim_step | Algorithm 1, lines 4 to 6: the ancestral step                   |
| scale * gradient               | line 7, x <- x' - scale grad_x |y - A x0hat(x)|, norm unsquared |
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from phydict.diffusion import Denoiser, Generators, noise_in
from phydict.posterior.measurement import Measurement
from phydict.posterior.normalised import NormalisedMeasurement
from phydict.posterior.samplers.noise_levels import stochastic_ddim_step
from phydict.posterior.samplers.sampler import Sampler
from phydict.runtime.ranges import MOST, check_fields


@dataclass(frozen=True)
class DPS(Sampler):
    """Chung et al. 2023, diffusion posterior sampling.

    Every step costs a backward pass through the network, in time (about twice the forward one) and in memory (its
    activations are kept). The denoiser must be differentiable where its input requires a gradient, as those of priors
    are; others are refused with a ValueError. It samples no posterior that could be stated: the push has the length
    `scale` times the denoiser's slope whatever the noise of the data, which it does not use.

    Args:
        iterations: noise levels, evenly spaced in time
        scale: length of the push, in units of an operator of norm 1, published as 0.3 for super-resolution and blur at
            1000 levels; fewer levels need longer ones
    """

    citation = ("Chung et al., Diffusion Posterior Sampling for General Noisy Inverse Problems, ICLR 2023, "
                "arXiv:2209.14687")

    iterations: int = 1000
    scale: float = 0.3

    def __post_init__(self):
        check_fields(self, "DPS", iterations=(1, math.inf), scale=(0, MOST))

    def steps(self) -> int:
        return self.iterations

    def sample(self, denoiser: Denoiser, measurement: Measurement, x: Tensor, generator: Generators,
               on_step: Callable[[], None] = lambda: None) -> Tensor:
        m, schedule = NormalisedMeasurement(measurement, noise=1.0), denoiser.schedule
        for t, s in schedule.steps(self.iterations):
            x0, gradient = self._estimate(denoiser, m, x, t)
            kept = float(schedule.sigma(s) / schedule.sigma(t))
            eps = noise_in(schedule, x0, x, t)
            x = stochastic_ddim_step(schedule, x0, eps, s, kept, generator) - self.scale * gradient
            on_step()
        return (x0 - self.scale * gradient).clamp(-1, 1)

    def _estimate(self, denoiser: Denoiser, m: NormalisedMeasurement, x: Tensor, t: float) -> tuple[Tensor, Tensor]:
        """The clean estimate at (x, t), and the gradient of its misfit with respect to x."""
        with torch.enable_grad():
            x = x.detach().requires_grad_(True)
            x0 = denoiser.denoise(x, t).clamp(-1, 1)
            if not x0.requires_grad:
                raise ValueError("DPS needs a denoiser that can be differentiated, but this one gives no gradient: use "
                                 "another sampler, or guide the prior's own grid alone")
            m.measurement.match_gain_offset(x0[:, :1].detach())
            misfit = (m.project(x0[:, :1]) - m.y).flatten(1).norm(dim=1)
            (gradient,) = torch.autograd.grad(misfit.sum(), x)
        m.measurement.calls += 1  # autograd's use of the adjoint
        return x0.detach(), gradient
