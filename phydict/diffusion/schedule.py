"""The noise schedule: how much of the clean state is left at time t.

    x_t = sqrt(alpha_bar(t)) x_0 + sqrt(1 - alpha_bar(t)) eps,   eps ~ N(0, I),   t in [0, 1]
    alpha_bar(t) = cos^2(pi/2 (t + s) / (1 + s)), clamped to [floor, 1 - floor]
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class CosineSchedule:
    """Continuous clamped-cosine schedule (Nichol & Dhariwal 2021, arXiv:2102.09672, Eq. 17; clamped as in MedSyn).

    offset: the small s that keeps alpha_bar(0) below 1.
    floor: alpha_bar stays in [floor, 1 - floor], so that both square roots stay away from zero.
    Raises ValueError for others.
    """

    offset: float = 0.008
    floor: float = 1e-4

    def __post_init__(self):
        if not (0 <= self.offset < math.inf and 0 < self.floor < 0.5):
            raise ValueError("a schedule needs an offset of at least 0 and a floor between 0 and 0.5, but "
                             f"{self.offset} and {self.floor} were given")

    def alpha_bar(self, t: float | Tensor) -> Tensor:
        """Share of signal variance at time t in [0, 1]; same shape, dtype and device as t."""
        t = torch.as_tensor(t, dtype=None if isinstance(t, Tensor) else torch.float64)
        angle = (t + self.offset) / (1 + self.offset) * (math.pi / 2)
        return torch.cos(angle).square().clamp(self.floor, 1 - self.floor)

    def scales(self, t: float | Tensor) -> tuple[Tensor, Tensor]:
        """(sqrt(alpha_bar), sqrt(1 - alpha_bar)): the weights of state and noise in x_t."""
        alpha_bar = self.alpha_bar(t)
        return alpha_bar.sqrt(), (1 - alpha_bar).sqrt()

    def sigma(self, t: float | Tensor) -> Tensor:
        """Noise level of x_t / sqrt(alpha_bar) (Karras et al. 2022, arXiv:2206.00364): sqrt((1 - ab) / ab)."""
        signal, noise = self.scales(t)
        return noise / signal

    def time(self, sigma: float) -> float:
        """The time in [0, 1] whose noise level is `sigma`; levels beyond those of the schedule have its ends' times."""
        angle = math.atan(min(max(sigma, float(self.sigma(0.0))), float(self.sigma(1.0))))
        return min(max(angle / (math.pi / 2) * (1 + self.offset) - self.offset, 0.0), 1.0)

    def steps(self, n: int, start: float = 1.0, last: float | None = None) -> Iterator[tuple[float, float]]:
        """n time pairs (t, s) with start = t_1 > s_1 = t_2 > ... > s_n = 0, evenly spaced in t.

        last: t_n, from which the final pair goes to 0 at once; None spaces all of them evenly down to 0. A single
        pair goes from start to 0 whatever it is.
        """
        if n < 1:
            raise ValueError(f"a sampler needs at least one step, but {n} was given")
        if not 0 < start <= 1:
            raise ValueError(f"sampling starts at a time in (0, 1], but {start} was given")
        if last is not None and not 0 < last <= start:
            raise ValueError(f"the last time lies above 0 and not above the start {start}, but {last} was given")
        if last is None:
            times = [start * (n - i) / n for i in range(n)]
        else:
            times = [start + (last - start) * i / max(n - 1, 1) for i in range(n)]
        yield from zip(times, [*times[1:], 0.0])
