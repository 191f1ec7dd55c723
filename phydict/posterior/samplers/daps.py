"""DAPS: at every noise level a clean estimate, a draw near it that fits the X-rays, and wholly new noise.

| here                                 | publication                                               |
|--------------------------------------|-----------------------------------------------------------|
| denoise_along(denoiser, x, times)    | x0hat(x_t) by the probability flow                        |
| likelihood(m, x0, x0_std, generator) | x_0 ~ p(x_0 | x_t, y), p(x_0 | x_t) as N(x0hat, x0_std^2) |
| renoise(z, s, noise)                 | x_s ~ N(x_0, sigma_s^2)                                   |
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import torch
from torch import Tensor

from phydict.diffusion import Denoiser, Generators, noise_like, renoise
from phydict.posterior.likelihood.langevin import Langevin
from phydict.posterior.likelihood.likelihood_draw import LikelihoodDraw
from phydict.posterior.measurement import Measurement
from phydict.posterior.normalised import NormalisedMeasurement, check_noise
from phydict.posterior.samplers.noise_levels import denoise_along, polynomial_levels, times_of
from phydict.posterior.samplers.sampler import Sampler
from phydict.runtime.ranges import LEAST, MOST, check_fields


@dataclass(frozen=True)
class DAPS(Sampler):
    """Zhang et al. 2025, decoupled annealing posterior sampling.

    On a Gaussian prior with components of variance v^2, one flow step, the exact draw and prior_std v sample the
    posterior exactly, with any levels. With the published spread and a full flow, low noise levels see the prior with
    half its weight: where the data are silent, the variance tends to 2 v^2.

    Args:
        levels: how many noise levels, polynomially spaced and clipped to the schedule's
        sigma_max: highest noise level
        sigma_min: lowest noise level
        flow_steps: denoiser calls of the probability flow from each level; one is the denoiser's estimate
        flow_end: noise level of the last of these calls
        likelihood: Langevin as published, or ExactDraw
        noise: standard deviation of the line integrals' error, which, divided by the operator's norm, is the published
            tau
        prior_std: None for the published spread, sigma; with the standard deviation v of the state, the spread is that
            of x_0 given x_t under independent components, sigma v / sqrt(sigma^2 + v^2)
    """

    citation = ("Zhang et al., Improving Diffusion Inverse Problem Solving with Decoupled Noise Annealing, CVPR 2025, "
                "arXiv:2407.01521")

    levels: int = 200
    sigma_max: float = 100.0
    sigma_min: float = 0.1
    flow_steps: int = 5
    flow_end: float = 0.01
    likelihood: LikelihoodDraw = field(default_factory=Langevin)
    noise: float = 0.02
    prior_std: float | None = None

    def __post_init__(self):
        check_noise(self.noise)
        check_fields(self, "DAPS", levels=(1, math.inf), flow_steps=(1, math.inf), prior_std=(LEAST, MOST),
                     **dict.fromkeys(("sigma_max", "sigma_min", "flow_end"), (LEAST, MOST)))
        if not self.flow_end <= self.sigma_min <= self.sigma_max:
            raise ValueError("DAPS needs flow_end <= sigma_min <= sigma_max, but "
                             f"{self.flow_end}, {self.sigma_min} and {self.sigma_max} were given")

    def steps(self) -> int:
        return self.levels

    def x0_std(self, sigma: float) -> float:
        """Standard deviation of x_0 around its estimate at noise level sigma."""
        return sigma if self.prior_std is None else sigma / (1 + (sigma / self.prior_std) ** 2) ** 0.5

    def sample(self, denoiser: Denoiser, measurement: Measurement, x: Tensor, generator: Generators,
               on_step: Callable[[], None] = lambda: None) -> Tensor:
        m, schedule = NormalisedMeasurement(measurement, self.noise), denoiser.schedule
        sigmas = [float(schedule.sigma(schedule.time(s)))
                  for s in polynomial_levels(self.sigma_max, self.sigma_min, self.levels)]
        z, noise = torch.zeros_like(x), x
        for i, sigma in enumerate(sigmas):
            x = renoise(schedule, z, schedule.time(sigma), noise)
            flow = polynomial_levels(sigma, min(self.flow_end, sigma), self.flow_steps)
            x0 = denoise_along(denoiser, x, times_of(schedule, flow))
            measurement.match_gain_offset(x0[:, :1])
            z = self.likelihood.of_states(m, x0, self.x0_std(sigma), generator, i / self.levels)
            noise = noise_like(x, generator)
            on_step()
        return z.clamp(-1, 1)
