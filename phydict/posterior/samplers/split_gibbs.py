"""Split Gibbs sampling: the prior's denoiser and the X-rays' likelihood step in turn, along the noise levels.

| here                       | paper                                              |
|----------------------------|----------------------------------------------------|
| denoise(x, t)              | Eq. 1, (x0)_t = F_t(x_t, c)                        |
| likelihood(m, x0, x0_std)  | z_t, from pi(z | x, Y)                             |
| ddim(z, x, t, s)           | Eq. 2, x_s = DDIM(z_t, x_t)                        |
| ec_delta                   | Extra Compute: renoise to delta, sample again      |
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from functools import partial

import torch
from torch import Tensor

from phydict.diffusion import Denoiser, Generators, ddim, noise_like, renoise
from phydict.posterior.discretisation import find_subgrid
from phydict.posterior.explained import explained
from phydict.posterior.likelihood.likelihood import LikelihoodStep, ProximalCG
from phydict.posterior.measurement import Measurement
from phydict.posterior.metal import Metal
from phydict.posterior.samplers.sampler import Sampler, ddim_sample
from phydict.runtime.ranges import LEAST, MOST, check_fields


@dataclass(frozen=True)
class SplitGibbs(Sampler):
    """Samples p(x | Y, report) with one denoiser call and one likelihood step per noise level, twice where
    scatter is sought.

    Args:
        iterations: noise levels
        likelihood: the step towards the X-rays
        final_likelihood: the one at the last level, None to return the denoiser's estimate there, as the paper does
        t_start: below 1, the first estimate, the prior's mean moved onto the X-rays, is taken at once to this time
        t_end: the last level's time (None: levels evenly spaced down to 0); where t_start leaves one level, it is that
            one's, whatever t_end is
        noise_fraction: None for the paper's DDIM moves; else each level starts from the estimate with new noise of this
            share of the level's own: 1 decouples the levels, 0 adds none and descends to a point estimate
        momentum: with noise_fraction, each level starts beyond the estimate, by this share of how far it has moved
            since the level before, so that fewer levels reach as far (heavy ball; Polyak 1964,
            doi:10.1016/0041-5553(64)90137-5)
        sampling_noise: the noise_fraction that takes its place, without momentum, where several samples are to show how
            far they differ; None: the same
        prior_std: standard deviation of the state, above 0, which sets the spread of x0 at each time
        ec_delta: EC's delta in [0, 1), 0 for none
        ec_steps: EC's noise levels
        ec_guided: meet the X-rays at each of EC's levels too, as in the first pass, instead of following the prior
            alone, as the paper does
        full_detector: meet the X-rays pixel by pixel instead of binned to what the grid can hold
        clip: pull the denoiser's estimate into the prior's range before the likelihood step, not only after it
        final_denoise: both passes end with one more call of the denoiser, at time 0 and without X-rays, as in the
            release
        scatter: where the result misses the X-rays by more than SCATTER_THRESHOLD times their noise, sample once more,
            subtracting the scatter that each estimate implies, and keep what that gives if it misses less
        hardening: where line integrals bend as a tube's do, sample once more from straight ones (`with_hardening`)
        subgrid: the step on finer voxels that seeks what the grid cannot hold of the X-rays (`find_subgrid`), after
            which the last likelihood step is done again; none: it is left in them
        metal: how what is denser than the prior's window is sought; none: it is not
    """

    citation = ("Dai, Ghosh & Batmanghelich, PhyDiCT: Plug-and-Play CT Reconstruction from Sparse X-Rays via "
                "Differentiable Rendering and Strong Priors, MICCAI 2026")

    iterations: int = 50
    likelihood: LikelihoodStep = field(default_factory=ProximalCG)
    final_likelihood: LikelihoodStep | None = None
    t_start: float = 1.0
    t_end: float | None = None
    noise_fraction: float | None = None
    momentum: float = 0.0
    sampling_noise: float | None = None
    prior_std: float = 0.5
    ec_delta: float = 0.0
    ec_steps: int = 0
    ec_guided: bool = False
    full_detector: bool = False
    clip: bool = True
    final_denoise: bool = False
    scatter: bool = False
    hardening: bool = False
    subgrid: LikelihoodStep | None = None
    metal: Metal | None = None

    def __post_init__(self):
        check_fields(self, "SplitGibbs", iterations=(1, math.inf), ec_steps=(0, math.inf), prior_std=(LEAST, MOST),
                     noise_fraction=(0, 1), sampling_noise=(0, 1))
        if not 0 < self.t_start <= 1:
            raise ValueError(f"t_start is a time in (0, 1], but {self.t_start} was given")
        if self.t_start < 1 and self.iterations < 2:
            raise ValueError("a t_start below 1 needs at least 2 iterations, but 1 was given")
        if self.t_end is not None and not 0 < self.t_end <= self.t_start:
            raise ValueError(f"t_end is a time above 0 and not above t_start, but {self.t_end} was given")
        if not 0 <= self.momentum <= 1 or (self.momentum and self.noise_fraction is None):
            raise ValueError("momentum is a share in [0, 1], and above 0 only where noise_fraction is given, but "
                             f"{self.momentum} was given, with a noise_fraction of {self.noise_fraction}")
        if not 0 <= self.ec_delta < 1:
            raise ValueError(f"ec_delta (the paper's delta) lies in [0, 1), but {self.ec_delta} was given")
        if self.ec_delta and self.ec_steps < 1:
            raise ValueError(f"refining from {self.ec_delta} needs ec_steps of at least 1, but "
                             f"{self.ec_steps} was given")

    @property
    def batches(self) -> bool:  # type: ignore[override]
        """Not where something is sought beside the CT, of which a measurement holds one for all states."""
        steps = [step for step in (self.likelihood, self.final_likelihood) if step]
        return not (self.scatter or self.hardening or self.subgrid or self.metal) and all(s.batches for s in steps)

    def steps(self) -> int:
        passes = [self.iterations] + ([self.ec_steps] if self.ec_delta else [])
        return sum(passes) + len(passes) * self.final_denoise

    def for_sampling(self) -> SplitGibbs:
        if self.sampling_noise is None:
            return self
        return replace(self, noise_fraction=self.sampling_noise, momentum=0.0)

    def times(self, denoiser: Denoiser) -> list[tuple[float, float]]:
        """The pairs (t, s) of noise levels passed through."""
        if self.t_start == 1.0:
            return list(denoiser.schedule.steps(self.iterations, last=self.t_end))
        return [(1.0, self.t_start), *denoiser.schedule.steps(self.iterations - 1, self.t_start, self.t_end)]

    def sample(self, denoiser: Denoiser, measurement: Measurement, x: Tensor, generator: Generators,
               on_step: Callable[[], None] = lambda: None) -> Tensor:
        run = partial(self.one_pass, denoiser, measurement, x, generator)
        return explained(measurement, run, on_step, self.metal, self.scatter, self.hardening)

    def one_pass(self, denoiser: Denoiser, measurement: Measurement, x: Tensor, generator: Generators,
                 on_step: Callable[[], None] = lambda: None) -> Tensor:
        """As `sample`, but nothing is looked for in what the X-rays miss: neither scatter nor metal."""
        z = self._guided_pass(denoiser, measurement, x, self.times(denoiser), generator, on_step)
        if not self.ec_delta:
            return z
        x = renoise(denoiser.schedule, z, self.ec_delta, noise_like(z, generator))
        if not self.ec_guided:
            return ddim_sample(denoiser, x, self.ec_steps, self.ec_delta, on_step, self.final_denoise)
        t_end = self.t_end if self.t_end is not None and self.t_end < self.ec_delta else None
        times = denoiser.schedule.steps(self.ec_steps, self.ec_delta, t_end)
        return self._guided_pass(denoiser, measurement, x, times, generator, on_step)

    def _guided_pass(self, denoiser: Denoiser, measurement: Measurement, x: Tensor,
                     times: Iterable[tuple[float, float]], generator: Generators,
                     on_step: Callable[[], None]) -> Tensor:
        """The estimate after the noise levels of `times`, at each of which it meets the X-rays."""
        schedule = denoiser.schedule
        previous, measurement.subgrid = None, 0.0
        for t, s in times:
            x0 = denoiser.denoise(x, t)
            if self.clip:
                x0 = x0.clamp(-1, 1)
            (measurement.refit if t < 1 else measurement.match_gain_offset)(x0[:, :1])
            z, step = x0.clamp(-1, 1), self.likelihood if s > 0 else self.final_likelihood
            if step:
                x0_std = self.x0_std(denoiser, t)
                ct = step(measurement, x0[:, :1], x0_std)
                if s == 0 and find_subgrid(measurement, ct, self.subgrid, self.prior_std):
                    ct = step(measurement, x0[:, :1], x0_std)
                z = torch.cat([ct.clamp(-1, 1), z[:, 1:]], 1)
            if self.noise_fraction is None:
                x = ddim(schedule, z, x, t, s)
            elif s > 0 or self.final_denoise:
                ahead = z if previous is None else (z + self.momentum * (z - previous)).clamp(-1, 1)
                x = renoise(schedule, ahead, s, self.noise_fraction * noise_like(z, generator))
            previous = z if t < 1 else None
            on_step()
        if self.final_denoise:
            z = denoiser.denoise(x, 0.0).clamp(-1, 1)
            on_step()
        return z

    def x0_std(self, denoiser: Denoiser, t: float) -> float:
        """Standard deviation of x_0 given x_t under independent components of prior_std."""
        a, s = (float(w) for w in denoiser.schedule.scales(t))
        return self.prior_std * s / (s**2 + (a * self.prior_std) ** 2) ** 0.5
