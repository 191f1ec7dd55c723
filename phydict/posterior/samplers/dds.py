"""DDS: a few conjugate gradients onto the X-rays at every noise level, from the prior's estimate.

| here                           | publication                                            |
|--------------------------------|--------------------------------------------------------|
| denoise(x, t)                  | Tweedie's estimate                                     |
| nearest_fit(m, x0, 1 / gamma)  | M conjugate gradients, without or with a proximal term |
| tv                             | the ADMM of its 3D solver, dual kept across the levels |
| noise_in, stochastic_ddim_step | DDIM with the noise of the old estimate, partly new    |
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from phydict.diffusion import Denoiser, Generators, noise_in
from phydict.posterior.likelihood.admm_tv import ADMMTV
from phydict.posterior.measurement import Measurement
from phydict.posterior.normalised import NormalisedMeasurement, nearest_fit
from phydict.posterior.samplers.noise_levels import stochastic_ddim_step
from phydict.posterior.samplers.sampler import Sampler
from phydict.runtime.ranges import LEAST, MOST, check_fields


@dataclass(frozen=True)
class DDS(Sampler):
    """Chung, Lee & Ye 2024. It knows no noise level: few iterations regularise. For many steps and iterations on a
    Gaussian prior with components of equal variance, its mean is the posterior's for noiseless data; its covariance is
    (1 + sqrt(1 - eta^2)) / 2 times that posterior's.

    Args:
        iterations: noise levels, evenly spaced in time
        eta: the published eta, amplitude of the noise that is new at each level
        cg_iterations: of conjugate gradients at each level
        gamma: weight of |P(z) - y|^2 against |z - x0|^2, as published for noisy data (None: no proximal term)
        tv: total variation, as in the published 3D solver; it replaces the proximal term
    """

    citation = ("Chung, Lee & Ye, Decomposed Diffusion Sampler for Accelerating Large-Scale Inverse Problems, ICLR "
                "2024, arXiv:2303.05754")

    iterations: int = 50
    eta: float = 0.85
    cg_iterations: int = 5
    gamma: float | None = None
    tv: ADMMTV | None = None

    def __post_init__(self):
        check_fields(self, "DDS", iterations=(1, math.inf), eta=(0, 1), cg_iterations=(1, math.inf),
                     gamma=(LEAST, MOST))
        if self.tv and self.gamma is not None:
            raise ValueError("DDS takes gamma or total variation, but both were given: leave one out")

    def steps(self) -> int:
        return self.iterations

    def sample(self, denoiser: Denoiser, measurement: Measurement, x: Tensor, generator: Generators,
               on_step: Callable[[], None] = lambda: None) -> Tensor:
        m, schedule = NormalisedMeasurement(measurement, noise=1.0), denoiser.schedule
        tv = self.tv.begin(x[:, :1]) if self.tv else None
        for t, s in schedule.steps(self.iterations):
            x0 = denoiser.denoise(x, t).clamp(-1, 1)
            measurement.match_gain_offset(x0[:, :1])
            ct = tv(m, x0[:, :1], self.cg_iterations) if tv else nearest_fit(
                m, x0[:, :1], 1 / self.gamma if self.gamma else 0.0, self.cg_iterations)
            z = torch.cat([ct.clamp(-1, 1), x0[:, 1:]], 1)
            eps = noise_in(schedule, x0, x, t)
            x = stochastic_ddim_step(schedule, z, eps, s, (1 - self.eta**2) ** 0.5, generator)
            on_step()
        return z
