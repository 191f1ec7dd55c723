"""Split Gibbs sampling: the prior's denoiser and the X-rays' likelihood step in turn, along the noise levels.

| here                       | paper                                              |
|----------------------------|----------------------------------------------------|
| denoise(x, t)              | Eq. 1, (x0)_t = F_t(x_t, c)                        |
| likelihood(m, x0, spread)  | z_t, from pi(z | x, Y)                             |
| ddim(z, x, t, s)           | Eq. 2, x_s = DDIM(z_t, x_t)                        |
| refine                     | Extra Compute: renoise to delta, descend unguided  |
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import torch
from torch import Tensor

from phydict.diffusion import Denoiser, ddim, renoise
from phydict.posterior.likelihood import LikelihoodStep, ProximalCG
from phydict.posterior.measurement import Measurement
from phydict.posterior.sampler import Sampler, descend


@dataclass(frozen=True)
class SplitGibbs(Sampler):
    """Samples p(x | Y, report) with one denoiser call and one likelihood step per noise level.

    iterations: noise levels; likelihood: the step towards the X-rays; warm_start: the second noise level in (0, 1],
    so that below 1 the first estimate, the prior's mean moved onto the X-rays, starts the descent from there;
    final_guided: whether the last estimate (at the lowest noise) still takes a likelihood step;
    churn: 0 for deterministic DDIM, 1 for ancestral sampling, which draws most of the noise anew;
    prior_std: standard deviation of the state, which sets the spread of x0 at each time;
    refine_from: EC's delta in [0, 1), 0 for none; refine_iterations: its noise levels.
    """

    iterations: int = 50
    likelihood: LikelihoodStep = field(default_factory=ProximalCG)
    warm_start: float = 1.0
    final_guided: bool = False
    churn: float = 0.0
    prior_std: float = 0.5
    refine_from: float = 0.0
    refine_iterations: int = 0

    def __post_init__(self):
        if self.iterations < 1:
            raise ValueError(f"split Gibbs sampling needs at least one iteration, but {self.iterations} was given")
        if not 0 < self.warm_start <= 1:
            raise ValueError(f"warm_start is a time in (0, 1], but {self.warm_start} was given")
        if not 0 <= self.refine_from < 1:
            raise ValueError(f"refine_from (the paper's delta) lies in [0, 1), but {self.refine_from} was given")
        if self.refine_from and self.refine_iterations < 1:
            raise ValueError(f"refining from {self.refine_from} needs refine_iterations of at least 1, but "
                             f"{self.refine_iterations} was given")
        if self.warm_start < 1 and self.iterations < 2:
            raise ValueError("a warm_start below 1 needs at least 2 iterations, but 1 was given")
        if not 0 <= self.churn <= 1:
            raise ValueError(f"churn lies in [0, 1], but {self.churn} was given")

    def steps(self) -> int:
        return self.iterations + (self.refine_iterations if self.refine_from else 0)

    def times(self, denoiser: Denoiser) -> list[tuple[float, float]]:
        """The pairs (t, s) of noise levels passed through."""
        if self.warm_start == 1.0:
            return list(denoiser.schedule.steps(self.iterations))
        return [(1.0, self.warm_start), *denoiser.schedule.steps(self.iterations - 1, self.warm_start)]

    def sample(self, denoiser: Denoiser, measurement: Measurement | None, x: Tensor, draw: torch.Generator,
               on_step: Callable[[], None] = lambda: None) -> Tensor:
        schedule = denoiser.schedule
        for t, s in self.times(denoiser):
            x0 = denoiser.denoise(x, t).clamp(-1, 1)
            measurement.calibrate(x0[:, :1])
            z = x0
            if s > 0 or self.final_guided:
                ct = self.likelihood(measurement, x0[:, :1], self.spread(denoiser, t)).clamp(-1, 1)
                z = torch.cat([ct, x0[:, 1:]], 1)
            x = ddim(schedule, z, x, t, s)
            if self.churn and s > 0:
                x = self._churned(schedule, x, z, t, s, draw)
            on_step()
        if self.refine_from:
            x = renoise(schedule, z, self.refine_from, noise_like(z, draw))
            z = descend(denoiser, x, self.refine_iterations, self.refine_from, on_step)
        return z

    def spread(self, denoiser: Denoiser, t: float) -> float:
        """Standard deviation of x_0 given x_t under independent components of prior_std."""
        a, s = (float(w) for w in denoiser.schedule.scales(t))
        return self.prior_std * s / (s**2 + (a * self.prior_std) ** 2) ** 0.5

    def _churned(self, schedule, x: Tensor, z: Tensor, t: float, s: float, draw: torch.Generator) -> Tensor:
        signal, noise = (w.to(x) for w in schedule.scales(s))
        share = self.churn * (1 - float(schedule.sigma(s) / schedule.sigma(t)) ** 2)
        return signal * z + (1 - share) ** 0.5 * (x - signal * z) + share**0.5 * noise * noise_like(x, draw)


def noise_like(x: Tensor, draw: torch.Generator) -> Tensor:
    """Standard normal noise drawn on the generator's device, so that a result does not depend on x's."""
    return torch.randn(x.shape, generator=draw, dtype=x.dtype).to(x.device)
