"""Reconstruction with a cascade: on the base prior's grid first, then on the fine one, where X-rays may guide again."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor
from torch.nn.functional import interpolate

from phydict.diffusion import noise_like
from phydict.grid import Grid
from phydict.guard import Guard
from phydict.posterior.likelihood.likelihood import ProximalCG
from phydict.posterior.measurement import Measurement
from phydict.posterior.posterior import CountingDenoiser, Posterior, check_guidance
from phydict.posterior.samplers.prior_only import PriorOnly
from phydict.posterior.samplers.sampler import Sampler, check_drawn, check_sampler
from phydict.posterior.samplers.split_gibbs import SplitGibbs
from phydict.prior import Cascade
from phydict.reconstruction import Reconstruction, Reconstructor, check_projected_from
from phydict.runtime.precision import check_precision, resolve_precision
from phydict.runtime.profiling import Stopwatch
from phydict.units import MU_WATER, HUWindow
from phydict.xray import Projector
from phydict.xray.boxes import binned_to, projector_method


@dataclass(frozen=True)
class CascadePosterior(Reconstructor):
    """Samples p(x | Y, report) under a cascade: the base stage by `sampler`, then the fine stage given its estimate.

    sr_guided: whether the X-rays guide the fine stage too, by `sr_sampler`, as in the paper; else `unguided` samples
    it from the base estimate alone, as in the authors' release. noise: level of the Gaussian noise that the base
    estimate is given before the fine stage sees it, in [0, 1] (noise augmentation): more trusts it less; None: the fine
    stage's `default_noise`. The rest as for Posterior; a base sampler that wants the full detector gives it to both
    stages.

    Of each result, volume and misfit are the fine stage's; masks that it does not make are the base stage's, upsampled.
    """

    cascade: Cascade
    sampler: Sampler = field(default_factory=SplitGibbs)
    sr_guided: bool = True
    sr_sampler: Sampler = SplitGibbs(
        iterations=2, t_start=0.3, noise_fraction=0.0, prior_std=0.2,
        likelihood=ProximalCG(iterations=5, restarts=2, tv_weight=10.0, tv_eps=0.003),
        final_likelihood=ProximalCG(iterations=10, restarts=2, tv_weight=10.0, tv_eps=0.003))
    unguided: Sampler = PriorOnly(20)
    noise: float | None = None
    guidance: float = 1.0
    mu_water: float = MU_WATER
    name: str = "phydict"
    precision: str = "auto"

    def __post_init__(self):
        super().__post_init__()
        check_precision(self.precision)
        check_guidance(self.guidance)
        for name in ("sr_sampler", "unguided"):
            given = getattr(self, name)
            if not isinstance(given, Sampler) or given.needs_refiner:
                raise ValueError(f"{name} is a Sampler that needs no refiner, since the second stage is none, but "
                                 f"{given!r} was given")
        if not 0 <= self.level <= 1:
            raise ValueError(f"the noise of the base estimate is a level in [0, 1], but {self.noise} was given")

    @property
    def grid(self) -> Grid:
        """Where the reconstructed volumes live."""
        return self.cascade.super_resolution.grid

    @property
    def window(self) -> HUWindow:
        return self.cascade.super_resolution.window

    @property
    def level(self) -> float:
        """The level of the noise that the base estimate is given."""
        return self.cascade.super_resolution.default_noise if self.noise is None else self.noise

    @property
    def full_detector(self) -> bool:  # type: ignore[override]
        return self.sampler.full_detector or self.second.full_detector

    @property
    def second(self) -> Sampler:
        """What samples the fine stage; what the X-rays hold beside the CT is as the base stage found it."""
        sampler = (self.sr_sampler if self.sr_guided else self.unguided).suited(self.cascade.super_resolution)
        if isinstance(sampler, SplitGibbs):
            return replace(sampler, scatter=False, hardening=False, metal=None)
        return sampler

    @property
    def citation(self) -> str:  # type: ignore[override]
        return self.sampler.citation

    def steps(self) -> int:
        return self.sampler.suited(self.cascade.base).steps() + self.second.steps()

    def check_memory(self, device: torch.device, state: torch.dtype = torch.float32) -> None:
        """Raises ValueError where the fine stage, for states of type `state` on `device`, does not fit into the memory
        that it may take."""
        self.cascade.super_resolution.check_memory(resolve_precision(self.precision, device, state))

    @torch.no_grad()
    def reconstruct(self, xrays: Tensor, projector: Projector, report: str = "", display: bool = False,
                    seed: int = 0, on_step: Callable[[], None] = lambda: None) -> Reconstruction:
        stage, watch = self.cascade.super_resolution, Stopwatch()
        check_projected_from(stage.grid, projector, "its", "the super-resolution stage makes")
        xrays = xrays.float()  # which the stage learnt in
        self.check_memory(xrays.device, xrays.dtype)
        check_sampler(self.second)
        if isinstance(stage, torch.nn.Module):
            stage.to(xrays.device)
        with watch.stage("base"):
            base = self._base(xrays, projector, report, display, seed, on_step)
        with watch.stage("prepare"):
            generator = torch.Generator().manual_seed(seed + 1)
            masks: Tensor = base.masks  # type: ignore[assignment]  # a prior gives them
            state = torch.cat([stage.window.to_range(base.within)[None], 2 * masks - 1])[None].to(xrays)
            state = state[:, :stage.coarse_channels]
            measurement = Measurement(projector, xrays, stage.window, display, self.mu_water, told=True)
            measurement.adopt(base)
            if base.scatter:
                measurement.refit(stage.upsample(state)[:, :1])
                measurement.scatter_enabled = False  # the base stage's is kept
            guard = Guard(measurement, on_step, self.second.steps())
            denoiser = CountingDenoiser(stage.bind(state, self.level, self.precision, generator), guard)
            x = noise_like(torch.empty(1, stage.state_channels, *stage.grid.shape, device=xrays.device), generator)
        with watch.stage("sample"):
            state = check_drawn(self.second, self.second.sample(denoiser, measurement, x, generator, guard), x)
        with watch.stage("score"):
            ct = state[:, :1]
            fit = guard.score(state, measurement.conclude(ct), measurement.y)
            masks = interpolate(masks[None], stage.grid.shape, mode="trilinear")[0] if len(masks) else (
                masks.new_zeros(0, *stage.grid.shape))
            masks[:stage.state_channels - 1] = ((state[0, 1:] + 1) / 2).cpu()
            volume = stage.window.to_hu(ct[0, 0]).cpu()
            if base.carried:
                volume = volume + base.carried.on(stage.grid)
        return Reconstruction(
            volume=volume, carried=base.carried, grid=stage.grid, method=self.name, seed=seed,
            **fit | {"diverged_at": base.diverged_at or guard.diverged_at}, seconds=watch.seconds,
            network_calls=base.network_calls + denoiser.calls,
            projector_calls=base.projector_calls + measurement.calls, masks=masks,
            hardened=base.hardened, scatter=base.scatter, model_variance=base.model_variance, precision=base.precision)

    def _base(self, xrays: Tensor, projector: Projector, report: str, display: bool, seed: int,
              on_step: Callable[[], None]) -> Reconstruction:
        """The base stage's reconstruction, by the same kind of projector, from X-rays binned to what its grid holds."""
        prior = self.cascade.base
        binned = binned_to(prior.grid, xrays, projector.beam, self.sampler.full_detector, projector_method(projector))
        posterior = Posterior(prior, self.sampler, self.guidance, self.mu_water, self.name, self.precision)
        return posterior.reconstruct(*binned, report, display, seed, on_step)
