"""The moves every sampler is made of.

| here                            | paper                              |
|---------------------------------|------------------------------------|
| ddim(schedule, z, x, t, s)      | Eq. 2, from time t to time s < t   |
| renoise(schedule, x0, t, noise) | forward diffusion, the start of EC |
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from phydict.diffusion.schedule import CosineSchedule


def ddim(schedule: CosineSchedule, x0: Tensor, x: Tensor, t: float, s: float) -> Tensor:
    """Deterministic DDIM move of the state x at time t to time s, given the clean estimate x0 (arXiv:2010.02502).

    ddim(x0, x, t, t) = x; the noise is recomputed from the x0 that is given, so a changed x0 stays consistent.
    """
    return renoise(schedule, x0, s, noise_in(schedule, x0, x, t))


def noise_in(schedule: CosineSchedule, x0: Tensor, x: Tensor, t: float) -> Tensor:
    """The noise that the state x at time t holds if its clean state is x0: renoise(x0, t, noise_in(x0, x, t)) = x."""
    signal, sigma = schedule.scales(t)
    return (x - signal.to(x) * x0) / sigma.to(x)


def renoise(schedule: CosineSchedule, x0: Tensor, t: float, noise: Tensor) -> Tensor:
    """Forward diffusion of the clean state x0 to time t with the given standard normal noise."""
    signal, sigma = schedule.scales(t)
    return signal.to(x0) * x0 + sigma.to(x0) * noise


Generators = torch.Generator | Sequence[torch.Generator]
"""Where noise comes from: one generator, or one for each state of a batch."""


def noise_like(x: Tensor, generator: Generators) -> Tensor:
    """Standard normal noise drawn in float32 on the generator's device, so that a result depends on neither of x's."""
    if not isinstance(generator, torch.Generator):
        return torch.cat([noise_like(one[None], source) for one, source in zip(x, generator, strict=True)])
    return torch.randn(x.shape, generator=generator, device=generator.device, dtype=torch.float32).to(x)
