"""A sampler of one's own: at each noise level the prior's estimate, corrected by conjugate gradients on the X-rays."""

from dataclasses import dataclass

import torch

from phydict.diffusion import ddim
from phydict.posterior import Sampler
from phydict.posterior.normalised import NormalisedMeasurement, nearest_fit


@dataclass(frozen=True)
class MySampler(Sampler):
    """levels: of noise; cg_iterations: at each; weight: of the prior's estimate against the X-rays."""

    levels: int = 4
    cg_iterations: int = 6
    weight: float = 0.01

    def steps(self):
        return self.levels

    def sample(self, denoiser, measurement, x, generator, on_step=lambda: None):
        fit, schedule = NormalisedMeasurement(measurement, noise=1.0), denoiser.schedule
        for t, s in schedule.steps(self.levels):
            x0 = denoiser.denoise(x, t).clamp(-1, 1)
            measurement.match_gain_offset(x0[:, :1])
            ct = nearest_fit(fit, x0[:, :1], self.weight, self.cg_iterations).clamp(-1, 1)
            x = ddim(schedule, torch.cat([ct, x0[:, 1:]], 1), x, t, s)
            on_step()
        return x
