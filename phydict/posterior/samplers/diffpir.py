"""DiffPIR: a proximal step onto the X-rays per noise level, then diffusion with noise of which a share is new.

| here                           | publication                                        |
|--------------------------------|----------------------------------------------------|
| denoise(x, t)                  | Algorithm 1, line 3                                |
| nearest_fit(m, x0, rho_t)      | line 4, rho_t = prior_weight sigma_y^2 / sigma_t^2 |
| noise_in, stochastic_ddim_step | lines 5 and 6, with zeta of the noise new          |
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from phydict.diffusion import Denoiser, Generators, noise_in
from phydict.posterior.measurement import Measurement
from phydict.posterior.normalised import NormalisedMeasurement, check_noise, nearest_fit
from phydict.posterior.samplers.noise_levels import stochastic_ddim_step
from phydict.posterior.samplers.sampler import Sampler
from phydict.runtime.ranges import LEAST, MOST, check_fields


@dataclass(frozen=True)
class DiffPIR(Sampler):
    """Zhu et al. 2023. For many steps on a Gaussian prior its mean is the posterior's, under data of variance
    prior_weight noise^2; its covariance is (1 + sqrt(1 - zeta)) / 2 times the posterior's.

    Args:
        iterations: noise levels
        spacing: their times are (1 - i / iterations)^spacing, dense near pure noise as published (there called
            quadratic), even at 1
        prior_weight: the published lambda, weight of the prior's estimate
        zeta: the published zeta, share of the noise's variance that is new at each level
        noise: standard deviation of the line integrals' error
        cg_iterations: of conjugate gradients at each level, in place of the published closed forms
    """

    citation = ("Zhu et al., Denoising Diffusion Models for Plug-and-Play Image Restoration, CVPR Workshops (NTIRE) "
                "2023, arXiv:2305.08995")

    iterations: int = 100
    spacing: float = 0.5
    prior_weight: float = 1.0
    zeta: float = 0.1
    noise: float = 0.02
    cg_iterations: int = 5

    def __post_init__(self):
        check_noise(self.noise)
        check_fields(self, "DiffPIR", iterations=(1, math.inf), spacing=(LEAST, MOST), prior_weight=(LEAST, MOST),
                     zeta=(0, 1), cg_iterations=(1, math.inf))

    def steps(self) -> int:
        return self.iterations

    def sample(self, denoiser: Denoiser, measurement: Measurement, x: Tensor, generator: Generators,
               on_step: Callable[[], None] = lambda: None) -> Tensor:
        m, schedule = NormalisedMeasurement(measurement, self.noise), denoiser.schedule
        times = [(1 - i / self.iterations) ** self.spacing for i in range(self.iterations)]
        for t, s in zip(times, [*times[1:], 0.0]):
            x0 = denoiser.denoise(x, t).clamp(-1, 1)
            measurement.match_gain_offset(x0[:, :1])
            weight = self.prior_weight * (m.noise / float(schedule.sigma(t))) ** 2
            ct = nearest_fit(m, x0[:, :1], weight, self.cg_iterations).clamp(-1, 1)
            z = torch.cat([ct, x0[:, 1:]], 1)
            x = stochastic_ddim_step(schedule, z, noise_in(schedule, z, x, t), s, (1 - self.zeta) ** 0.5, generator)
            on_step()
        return z
