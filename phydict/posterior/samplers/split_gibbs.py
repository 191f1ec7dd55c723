"""Split Gibbs sampling: the prior's denoiser and the X-rays' likelihood step in turn, along the noise levels.

| here                       | paper                                              |
|----------------------------|----------------------------------------------------|
| denoise(x, t)              | Eq. 1, (x0)_t = F_t(x_t, c)                        |
| likelihood(m, x0, spread)  | z_t, from pi(z | x, Y)                             |
| ddim(z, x, t, s)           | Eq. 2, x_s = DDIM(z_t, x_t)                        |
| refine_from                | Extra Compute: renoise to delta, descend again     |
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from phydict.diffusion import Denoiser, ddim, renoise
from phydict.diffusion.steps import Draw, noise_like
from phydict.posterior.likelihood.likelihood import LikelihoodStep, ProximalCG
from phydict.posterior.measurement import Measurement
from phydict.posterior.samplers.sampler import Sampler, descend

MISSED = 2.5
"""Times their noise that X-rays are missed by before scatter is looked for: on the CTs that it was chosen on, ideal
ones are missed by 1.4 at most (those without noise by whatever the grid cannot hold), polychromatic ones by 1.4 to 3.5,
those with scatter of 6 % by 2.7 to 17, fewer views by less."""


@dataclass(frozen=True)
class SplitGibbs(Sampler):
    """Samples p(x | Y, report) with one denoiser call and one likelihood step per noise level, twice where
    scatter is sought.

    iterations: noise levels; likelihood: the step towards the X-rays; final_likelihood: the one at the last level,
    None to return the denoiser's estimate there, as the paper does;
    warm_start: below 1, the first estimate, the prior's mean moved onto the X-rays, is taken at once to this time;
    last: the last level's time (None: levels evenly spaced down to 0);
    fresh_noise: None for the paper's DDIM moves; else each level starts from the estimate with new noise of this
    share of the level's own: 1 decouples the levels, 0 adds none and descends to a point estimate;
    overshoot: with fresh_noise, each level starts beyond the estimate, by this share of how far it has moved since the
    level before, so that fewer levels reach as far (heavy ball; Polyak 1964, doi:10.1016/0041-5553(64)90137-5);
    randomised_noise: the fresh_noise that takes its place, without overshoot, where several samples are to show how far
    they differ; None: the same;
    prior_std: standard deviation of the state, which sets the spread of x0 at each time;
    refine_from: EC's delta in [0, 1), 0 for none; refine_iterations: its noise levels; refine_guided: meet the X-rays
    at each of them too, as in the first pass, instead of following the prior alone, as the paper does;
    full_detector: meet the X-rays pixel by pixel instead of binned to what the grid can hold;
    clip: pull the denoiser's estimate into the prior's range before the likelihood step, not only after it;
    at_zero: both passes end with one more call of the denoiser, at time 0 and without X-rays, as in the release;
    scatter: where the result misses the X-rays by more than MISSED times their noise, sample once more, subtracting the
    scatter that each estimate tells of, and keep what that gives if it misses less.
    """

    citation = ("Dai, Ghosh & Batmanghelich, PhyDiCT: Plug-and-Play CT Reconstruction from Sparse X-Rays via "
                "Differentiable Rendering and Strong Priors, MICCAI 2026")

    iterations: int = 50
    likelihood: LikelihoodStep = field(default_factory=ProximalCG)
    final_likelihood: LikelihoodStep | None = None
    warm_start: float = 1.0
    last: float | None = None
    fresh_noise: float | None = None
    overshoot: float = 0.0
    randomised_noise: float | None = None
    prior_std: float = 0.5
    refine_from: float = 0.0
    refine_iterations: int = 0
    refine_guided: bool = False
    full_detector: bool = False
    clip: bool = True
    at_zero: bool = False
    scatter: bool = False
    batches = True

    def __post_init__(self):
        if self.iterations < 1:
            raise ValueError(f"split Gibbs sampling needs at least one iteration, but {self.iterations} was given")
        if not 0 < self.warm_start <= 1:
            raise ValueError(f"warm_start is a time in (0, 1], but {self.warm_start} was given")
        if self.warm_start < 1 and self.iterations < 2:
            raise ValueError("a warm_start below 1 needs at least 2 iterations, but 1 was given")
        if self.last is not None and not 0 < self.last <= self.warm_start:
            raise ValueError(f"last is a time above 0 and not above warm_start, but {self.last} was given")
        if not 0 <= self.overshoot <= 1 or self.overshoot and self.fresh_noise is None:
            raise ValueError("overshoot is a share in [0, 1], and above 0 only where fresh_noise is given, but "
                             f"{self.overshoot} was given, with a fresh_noise of {self.fresh_noise}")
        for name in ("fresh_noise", "randomised_noise"):
            share = getattr(self, name)
            if share is not None and not 0 <= share <= 1:
                raise ValueError(f"{name} is a share in [0, 1] or left out, but {share} was given")
        if not 0 <= self.refine_from < 1:
            raise ValueError(f"refine_from (the paper's delta) lies in [0, 1), but {self.refine_from} was given")
        if self.refine_from and self.refine_iterations < 1:
            raise ValueError(f"refining from {self.refine_from} needs refine_iterations of at least 1, but "
                             f"{self.refine_iterations} was given")

    def steps(self) -> int:
        passes = [self.iterations] + ([self.refine_iterations] if self.refine_from else [])
        return sum(passes) + len(passes) * self.at_zero

    def randomised(self) -> SplitGibbs:
        if self.randomised_noise is None:
            return self
        return replace(self, fresh_noise=self.randomised_noise, overshoot=0.0)

    def times(self, denoiser: Denoiser) -> list[tuple[float, float]]:
        """The pairs (t, s) of noise levels passed through."""
        if self.warm_start == 1.0:
            return list(denoiser.schedule.steps(self.iterations, last=self.last))
        return [(1.0, self.warm_start), *denoiser.schedule.steps(self.iterations - 1, self.warm_start, self.last)]

    def sample(self, denoiser: Denoiser, measurement: Measurement | None, x: Tensor, draw: Draw,
               on_step: Callable[[], None] = lambda: None) -> Tensor:
        if not self.scatter:
            return self._descend(denoiser, measurement, x, draw, on_step)
        measurement.seek_scatter(False)
        z = self._descend(denoiser, measurement, x, draw, on_step)
        if measurement.may_scatter and ((missed := measurement.missed(z[:, :1])) > MISSED).any():
            measurement.seek_scatter(True)
            again = self._descend(denoiser, measurement, x, draw)
            better = (missed > MISSED) & (measurement.missed(again[:, :1]) < missed)
            measurement.seek_scatter(bool(better.any()))
            z = torch.where(better, again, z)
        return z

    def _descend(self, denoiser: Denoiser, measurement: Measurement, x: Tensor, draw: Draw,
                 on_step: Callable[[], None] = lambda: None) -> Tensor:
        z = self._meet(denoiser, measurement, x, self.times(denoiser), draw, on_step)
        if not self.refine_from:
            return z
        x = renoise(denoiser.schedule, z, self.refine_from, noise_like(z, draw))
        if not self.refine_guided:
            return descend(denoiser, x, self.refine_iterations, self.refine_from, on_step, self.at_zero)
        last = self.last if self.last is not None and self.last < self.refine_from else None
        times = denoiser.schedule.steps(self.refine_iterations, self.refine_from, last)
        return self._meet(denoiser, measurement, x, times, draw, on_step)

    def _meet(self, denoiser: Denoiser, measurement: Measurement, x: Tensor, times: Iterable[tuple[float, float]],
              draw: Draw, on_step: Callable[[], None]) -> Tensor:
        """The estimate after the noise levels of `times`, at each of which it meets the X-rays."""
        schedule = denoiser.schedule
        previous = None
        for t, s in times:
            x0 = denoiser.denoise(x, t)
            if self.clip:
                x0 = x0.clamp(-1, 1)
            measurement.calibrate(x0[:, :1])
            if measurement.scattered and t < 1:
                measurement.correct(measurement.project(x0[:, :1]))
            z, step = x0.clamp(-1, 1), self.likelihood if s > 0 else self.final_likelihood
            if step:
                ct = step(measurement, x0[:, :1], self.spread(denoiser, t)).clamp(-1, 1)
                z = torch.cat([ct, z[:, 1:]], 1)
            if self.fresh_noise is None:
                x = ddim(schedule, z, x, t, s)
            elif s > 0 or self.at_zero:
                ahead = z if previous is None else (z + self.overshoot * (z - previous)).clamp(-1, 1)
                x = renoise(schedule, ahead, s, self.fresh_noise * noise_like(z, draw))
            previous = z if t < 1 else None
            on_step()
        if self.at_zero:
            z = denoiser.denoise(x, 0.0).clamp(-1, 1)
            on_step()
        return z

    def spread(self, denoiser: Denoiser, t: float) -> float:
        """Standard deviation of x_0 given x_t under independent components of prior_std."""
        a, s = (float(w) for w in denoiser.schedule.scales(t))
        return self.prior_std * s / (s**2 + (a * self.prior_std) ** 2) ** 0.5
