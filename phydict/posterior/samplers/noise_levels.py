"""Grids of noise levels, as times of a schedule, and walks along them."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from phydict.diffusion import CosineSchedule, Denoiser, Generators, ddim, noise_in, noise_like, renoise

POWER = 7.0
"""Of the polynomial that noise levels follow."""


def polynomial_levels(high: float, low: float, n: int) -> list[float]:
    """n noise levels sigma from `high` down to `low`, evenly spaced in sigma^(1/POWER) (Karras et al. 2022,
    arXiv:2206.00364, Eq. 5); one level is `high`."""
    ends = high ** (1 / POWER), low ** (1 / POWER)
    return [(ends[0] + (ends[1] - ends[0]) * i / max(n - 1, 1)) ** POWER for i in range(n)]


def times_of(schedule: CosineSchedule, levels: Sequence[float]) -> list[float]:
    """The times of noise levels, clipped to the schedule's range; levels that fall together are one."""
    return list(dict.fromkeys(schedule.time(sigma) for sigma in levels))


def stochastic_ddim_step(schedule: CosineSchedule, x0: Tensor, eps: Tensor, s: float, kept: float,
                         generator: Generators) -> Tensor:
    """The clean state x0 at time s, with noise of which `kept` in [0, 1] is eps and the rest new: renoise(x0, s,
    kept eps + sqrt(1 - kept^2) noise). kept 1 is DDIM, 0 forgets the path."""
    if kept < 1:
        eps = kept * eps + (1 - kept**2) ** 0.5 * noise_like(eps, generator)
    return renoise(schedule, x0, s, eps)


def denoise_along(denoiser: Denoiser, x: Tensor, times: Sequence[float],
                  generator: Generators | None = None) -> Tensor:
    """The clean end, in [-1, 1], of the state x at times[0] that is taken down through the prior's noise levels.

    Without `generator` along the probability flow (DDIM); with it by ancestral steps, whose end is a draw from
    p(x_0 | x) as they become many (Ho et al. 2020, arXiv:2006.11239).
    """
    schedule = denoiser.schedule
    for t, s in zip(times, [*times[1:], None]):
        x0 = denoiser.denoise(x, t).clamp(-1, 1)
        if s is not None:
            x = ddim(schedule, x0, x, t, s) if generator is None else stochastic_ddim_step(
                schedule, x0, noise_in(schedule, x0, x, t), s, float(schedule.sigma(s) / schedule.sigma(t)), generator)
    return x0
