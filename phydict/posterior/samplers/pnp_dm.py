"""PnP-DM: Gibbs sampling of a clean state and its copy near it, one under the prior, one under the X-rays.

| here                                         | publication                                                       |
|----------------------------------------------|-------------------------------------------------------------------|
| likelihood(m, x, rho, generator)             | z ~ exp(-|P(z) - y|^2 / (2 sigma_y^2) - |z - x|^2 / (2 rho^2))    |
| denoise_along(denoiser, z, times, generator) | x ~ p(x) exp(-|x - z|^2 / (2 rho^2)), by diffusion from level rho |
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from phydict.diffusion import Denoiser, Generators
from phydict.posterior.likelihood.likelihood_draw import ExactDraw, LikelihoodDraw
from phydict.posterior.measurement import Measurement
from phydict.posterior.normalised import NormalisedMeasurement, check_noise
from phydict.posterior.samplers.noise_levels import denoise_along, polynomial_levels, times_of
from phydict.posterior.samplers.sampler import Sampler
from phydict.runtime.ranges import LEAST, MOST, check_fields


@dataclass(frozen=True)
class PnPDM(Sampler):
    """Wu et al. 2024, plug-and-play diffusion models.

    With many levels its states tend to p(x | y) for data whose noise has the covariance noise^2 I + rho_min^2 A A'.

    Args:
        iterations: of the Gibbs sampler
        rho_max: coupling of the two states in iteration k, rho_max decay^k but not below rho_min
        decay: see rho_max
        rho_min: see rho_max
        levels: of the polynomial grid of noise levels, of which each prior step takes rho and those below it
        sigma_max: highest level of that grid
        sigma_min: lowest level of that grid
        stochastic: whether the prior step draws, as the Gibbs sampler asks, or follows the probability flow, which is
            published too
        likelihood: ExactDraw, published for linear operators, or Langevin, for others
        noise: standard deviation of the line integrals' error
        burn_in: iterations left out of the result, which is the mean of the states after them: the posterior mean; for
            one draw, and where several samples are drawn, iterations - 1
        thinning: every how many iterations a state is taken into that mean; for one draw, 1
    """

    citation = ("Wu et al., Principled Probabilistic Imaging using Diffusion Models as Plug-and-Play Priors, NeurIPS "
                "2024, arXiv:2405.18782")

    iterations: int = 100
    rho_max: float = 10.0
    decay: float = 0.9
    rho_min: float = 0.1
    levels: int = 100
    sigma_max: float = 80.0
    sigma_min: float = 0.002
    stochastic: bool = True
    likelihood: LikelihoodDraw = field(default_factory=ExactDraw)
    noise: float = 0.02
    burn_in: int = 40
    thinning: int = 3

    def __post_init__(self):
        check_noise(self.noise)
        check_fields(self, "PnPDM", iterations=(1, math.inf), burn_in=(0, math.inf), thinning=(1, math.inf),
                     levels=(1, math.inf), decay=(LEAST, 1),
                     **dict.fromkeys(("rho_max", "rho_min", "sigma_max", "sigma_min"), (LEAST, MOST)))
        if not (self.rho_min <= self.rho_max and self.sigma_min <= self.sigma_max):
            raise ValueError("PnP-DM needs rho_min <= rho_max and sigma_min <= sigma_max, but "
                             f"{self.rho_min}, {self.rho_max}, {self.sigma_min} and {self.sigma_max} were given")
        if self.burn_in > self.iterations - self.thinning:
            raise ValueError("PnP-DM keeps every thinning-th state after burn_in, which leaves none of "
                             f"{self.iterations} iterations with burn_in {self.burn_in} and thinning {self.thinning}")

    def steps(self) -> int:
        return self.iterations

    def for_sampling(self) -> PnPDM:
        return replace(self, burn_in=self.iterations - 1, thinning=1)  # means differ less than the posterior is wide

    def sample(self, denoiser: Denoiser, measurement: Measurement, x: Tensor, generator: Generators,
               on_step: Callable[[], None] = lambda: None) -> Tensor:
        m, schedule = NormalisedMeasurement(measurement, self.noise), denoiser.schedule
        grid = polynomial_levels(self.sigma_max, self.sigma_min, self.levels)
        total, kept = torch.zeros_like(x), 0
        if measurement.display is not None:
            measurement.match_gain_offset(denoiser.denoise(x, 1.0)[:, :1].clamp(-1, 1))
        for i in range(self.iterations):
            rho = max(self.rho_max * self.decay**i, self.rho_min)
            times = times_of(schedule, [rho, *(sigma for sigma in grid if sigma < rho)])
            rho = float(schedule.sigma(times[0]))
            z = self.likelihood.of_states(m, x, rho, generator, i / self.iterations)
            signal, _ = schedule.scales(times[0])
            x = denoise_along(denoiser, signal.to(z) * z, times, generator if self.stochastic else None)
            measurement.match_gain_offset(x[:, :1])
            if i >= self.burn_in and (i - self.burn_in) % self.thinning == self.thinning - 1:
                total, kept = total + x, kept + 1
            on_step()
        return total / kept
