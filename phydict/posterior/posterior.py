"""Prior times reward, sampled: the reconstruction method of the paper and its relatives."""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from phydict.diffusion import Denoiser, noise_like
from phydict.grid import Grid
from phydict.guard import SCALED_VIEWS, Guard, check_ceiling, check_line_integral_scale, one_material
from phydict.posterior.measurement import Measurement
from phydict.posterior.metal import carried_note
from phydict.posterior.samplers.sampler import Sampler, check_drawn, check_sampler
from phydict.posterior.samplers.split_gibbs import SplitGibbs
from phydict.posterior.widening import limited_angle_factor, warn_of_contradictions, widening_of
from phydict.prior import AnyPrior, BoundRefiner, Refiner
from phydict.prior.contract import bound, check_answer, precision_of
from phydict.prior.uncertainty import LEVELS
from phydict.reconstruction import Reconstruction, Reconstructor, check_projected_from
from phydict.runtime.memory import check_memory
from phydict.runtime.own_code import is_own
from phydict.runtime.precision import check_precision
from phydict.runtime.profiling import Stopwatch, stage
from phydict.runtime.ranges import check_between, check_fields
from phydict.runtime.warning import warn
from phydict.units import MU_WATER, HUWindow
from phydict.xray import Projector
from phydict.xray.carried import Carried, mean_carried

MOST_GUIDANCE = 1_000_000
"""No scale of guidance is as large: it would overflow."""


WIDEST = 2.0
"""Half-width of the widest interval, in the prior's range [-1, 1], of which it then leaves out nothing."""


class CountingDenoiser:
    """A denoiser that counts its calls, one for each state of a batch, and shows a guard what it estimates."""

    def __init__(self, denoiser: Denoiser, guard: Guard):
        self.schedule, self._denoiser, self.guard, self.calls = denoiser.schedule, denoiser, guard, 0

    def denoise(self, x: Tensor, t: float) -> Tensor:
        return self._count(x, lambda: self._denoiser.denoise(x, t))

    def _count(self, x: Tensor, call: Callable[[], Tensor]) -> Tensor:
        self.calls += len(x)
        with stage("network"):
            x0 = call()
        if not isinstance(x0, Tensor) or x0.shape != x.shape:
            came = tuple(x0.shape) if isinstance(x0, Tensor) else type(x0).__name__
            raise ValueError(f"a denoiser answers with states like those it is given, {tuple(x.shape)}, but "
                             f"{came} came: correct the prior's denoise, or its grid and state_channels")
        self.guard.estimate = x0.detach()
        return x0.to(x)


class CountingRefiner(CountingDenoiser):
    """A refiner that counts its calls, as CountingDenoiser does a denoiser's, and keeps the half-widths of the last
    state's intervals."""

    _denoiser: BoundRefiner
    half_widths: Tensor | None = None

    @property
    def mean(self) -> Tensor:
        return self._denoiser.mean

    @property
    def begins(self) -> bool:
        return self._denoiser.begins

    def refine(self, x: Tensor, t: float, evidence: Tensor) -> Tensor:
        return self._count(x, lambda: self._denoiser.refine(x, t, evidence))

    def conclude(self, z: Tensor, evidence: Callable[[], Tensor]) -> None:
        if self._denoiser.refiner.uncertainty is not None:
            with stage("network"):
                self.half_widths = self._denoiser.half_widths(z, evidence())


@dataclass(frozen=True)
class Posterior(Reconstructor):
    """Reconstructs by sampling p(x | Y, report) under a prior.

    sampler: how; guidance: classifier-free guidance scale used when a report is given; mu_water: 1/mm;
    precision: of the denoiser, see phydict.runtime.precision;
    samples: how many are drawn. One is the sampler's own result; of several, drawn by its `for_sampling` settings, the
    volume is the mean, and their standard deviation shows where it is uncertain. batch: how many of them go through
    the denoiser at once, where the sampler allows it; fewer need less memory. Sample i depends neither on samples nor,
    but for rounding, on batch. What is sought of the X-rays beside the CT is each sample's own: the result carries the
    mean of what they carry, and its X-rays and misfit are as the last one leaves the X-rays.
    otherwise: what reconstructs instead, from the same X-rays, where the volume is one material in air and no chest;
    None: nothing does.
    room: voxels beyond the prior's at both ends of each axis, of a prior that takes them.
    """

    prior: AnyPrior
    sampler: Sampler = field(default_factory=SplitGibbs)
    guidance: float = 1.0
    mu_water: float = MU_WATER
    name: str = "phydict"
    precision: str = "auto"
    samples: int = 1
    batch: int = 4
    otherwise: Reconstructor | None = None
    room: tuple[int, int, int] = (0, 0, 0)

    def __post_init__(self):
        super().__post_init__()
        check_precision(self.precision)
        check_guidance(self.guidance)
        if isinstance(self.prior, Refiner) != self.sampler.needs_refiner:
            if self.sampler.needs_refiner and is_own(type(self.prior)):
                raise ValueError(f"{self.name} needs a refiner, its file or object, but {type(self.prior).__name__}, a "
                                 "prior of your own, was given: give it to phydict_fast, which takes any prior, or "
                                 "leave it out")
            needed, given = ("a refiner", "a prior") if self.sampler.needs_refiner else ("a prior", "a refiner")
            raise ValueError(f"{type(self.sampler).__name__} needs {needed}, but the file is {given}: give {needed}'s "
                             "file, or leave it out")
        if self.samples != 1 and self.sampler.needs_refiner:
            raise ValueError("an unrolled reconstruction is not random, so that samples of it do not differ, but "
                             f"{self.samples} were given: leave samples at 1, or use phydict_fast")
        self.window.check_air("the prior's window")
        check_fields(self, "Posterior", samples=(1, math.inf), batch=(1, math.inf))
        size = self.prior.state_channels * math.prod(self.grid.shape)
        check_memory(4 * self.samples * size, f"samples={self.samples} states of {size:,} numbers", "draw fewer")

    @property
    def grid(self) -> Grid:
        """Where the reconstructed volumes live."""
        return self.prior.grid.grown(*self.room)

    def with_room(self, x: int, y: int, z: int) -> Posterior | None:
        takes, room = getattr(self.prior, "takes", None), (self.room[0] + x, self.room[1] + y, self.room[2] + z)
        return replace(self, room=room) if takes and takes(self.prior.grid.grown(*room).shape) else None

    @property
    def window(self) -> HUWindow:
        return self.prior.window

    @property
    def volumes(self) -> int:
        return super().volumes + max((getattr(step, "kept", 0) for step in vars(self.sampler).values()), default=0)

    @property
    def full_detector(self) -> bool:  # type: ignore[override]
        return self.sampler.full_detector

    @property
    def citation(self) -> str:  # type: ignore[override]
        return self.sampler.citation

    def steps(self) -> int:
        together = min(self.batch, self.samples) if self.sampler.batches else 1
        return self.sampler.suited(self.prior).steps() * -(-self.samples // together)

    @torch.no_grad()
    def reconstruct(self, xrays: Tensor, projector: Projector, report: str = "", display: bool = False,
                    seed: int = 0, on_step: Callable[[], None] = lambda: None) -> Reconstruction:
        prior, watch = self.prior, Stopwatch()
        if isinstance(prior, torch.nn.Module):
            prior.to(xrays.device)
            if is_own(type(prior)):
                prior.eval()
            weights = next((weight.dtype for weight in prior.parameters()), xrays.dtype)
            xrays = xrays.to(weights if weights in (torch.float32, torch.float64) else torch.float32)
        check_projected_from(self.grid, projector, "the prior's", "the prior was trained on")
        sampler = self.sampler.suited(prior)
        sampler = sampler.for_sampling() if self.samples > 1 else sampler
        check_sampler(sampler)
        with watch.stage("prepare"):
            measurement = Measurement(projector, xrays, prior.window, display, self.mu_water)
            guard = Guard(measurement, on_step, sampler.steps(), sampler.sees_xrays)
            counting = CountingRefiner if sampler.needs_refiner else CountingDenoiser
            answering = bound(prior, report, self.guidance, self.precision)
            denoiser = counting(answering, guard)
            state = torch.empty(1, prior.state_channels, *self.grid.shape).to(xrays)
        with watch.stage("sample"):
            drawn, carried = self._drawn(sampler, denoiser, measurement, state, seed)
            states = torch.cat(drawn)
        if self.otherwise and one_material(prior.window.to_hu(states[:, 0].mean(0))):
            warn("the X-rays show one material in air and no chest, and of other objects the network knows nothing: a "
                 "method without one reconstructed instead, and there are no intervals")
            with watch.stage("otherwise"):
                result = self.otherwise.with_mu_water(self.mu_water).reconstruct(
                    xrays, projector, report, display, seed)
            return replace(result, method=self.name, seconds=watch.seconds, network_calls=denoiser.calls,
                           projector_calls=measurement.calls + result.projector_calls)
        with watch.stage("score"):
            state, ct = states.mean(0), states[:, :1].mean(0, keepdim=True)
            if len(drawn) > 1 and any(carried):
                measurement.carry(mean_carried(carried, self.grid))
            reprojection = measurement.conclude(ct)
            fit = guard.score(states if self.samples == 1 else None, reprojection, measurement.y)
            deviation = self._deviation(states[:, 0], carried) if self.samples > 1 else None
            volume, mean = self._volume(measurement, ct[0, 0])
            if not display and projector.beam.views >= SCALED_VIEWS:
                check_line_integral_scale(volume, fit["misfit"])
            intervals, widening = self._intervals(denoiser, measurement, reprojection)
            warn_of_contradictions(measurement, widening if intervals else None)
            variance = measurement.model_variance
            check_answer(prior, answering, states[:1])
        return Reconstruction(
            volume=volume, grid=self.grid, method=self.name, seed=seed, **fit, seconds=watch.seconds,
            network_calls=denoiser.calls * (2 if report and self.guidance != 1 else 1),
            projector_calls=measurement.calls, masks=((state[1:] + 1) / 2).cpu(), deviation=deviation,
            intervals=intervals, interval_widening=widening, hardened=measurement.hardened,
            scatter=measurement.scatter, model_variance=variance.cpu() if isinstance(variance, Tensor) else variance,
            precision=precision_of(prior, self.precision, xrays), carried=mean)

    def _drawn(self, sampler: Sampler, denoiser: CountingDenoiser, measurement: Measurement, state: Tensor, seed: int
               ) -> tuple[list[Tensor], list[Carried | None]]:
        """The samples' states, those of a batch like `state` (1, C, X, Y, Z) together, and what each carries."""
        seeds = [sample_seed(seed, i) for i in range(self.samples)]
        together = self.batch if self.sampler.batches else 1
        drawn, carried, plain = [], list[Carried | None](), measurement.fitted
        for first in range(0, self.samples, together):
            measurement.carry(None)
            measurement.fitted = plain
            denoiser.guard.reset()
            generators = [torch.Generator().manual_seed(s) for s in seeds[first:first + together]]
            x = noise_like(state.expand(len(generators), -1, -1, -1, -1), generators)
            generator = generators if len(generators) > 1 else generators[0]
            states = sampler.sample(denoiser, measurement, x, generator, denoiser.guard)
            drawn.append(check_drawn(sampler, states, x))
            carried += len(generators) * [measurement.carried]
            if self.samples > 1:
                denoiser.guard.finish(drawn[-1])
        return drawn, carried

    def _volume(self, measurement: Measurement, x: Tensor) -> tuple[Tensor, Carried | None]:
        """HU (X, Y, Z) of a result x in the prior's range, and what of them is carried beside it. Says what is as dense
        as the prior knows, or denser."""
        volume, carried = self.prior.window.to_hu(x).cpu(), measurement.carried
        if carried is None:
            check_ceiling(x, self.grid, self.prior.window)
            return volume, None
        warn(carried_note(carried, self.prior.window))
        carried = replace(carried, extra=carried.extra.cpu())
        return volume + carried.on(self.grid), carried

    def _deviation(self, x: Tensor, carried: list[Carried | None]) -> Tensor:
        """Standard deviation in HU (X, Y, Z) of samples x (N, X, Y, Z) in the prior's range with what each carries."""
        if any(carried):
            beside = [each.on(self.grid) if each else torch.zeros_like(x[0]) for each in carried]
            x = x + torch.stack(beside) / self.prior.window.half_width
        return (self.prior.window.half_width * x.std(0)).cpu()

    def _intervals(self, denoiser: CountingDenoiser, measurement: Measurement, reprojection: Tensor
                   ) -> tuple[dict[float, Tensor], float]:
        """Level -> half-widths in HU (X, Y, Z), none where the network does not know them, and the factor by which they
        are wider than calibrated."""
        uncertainty = self.prior.uncertainty if isinstance(self.prior, Refiner) else None
        if uncertainty is None or not isinstance(denoiser, CountingRefiner) or denoiser.half_widths is None:
            return {}, 1.0
        widening = widening_of(measurement, reprojection, float(uncertainty.most_residual))
        factor = widening * limited_angle_factor(measurement.projector)
        widths = self.prior.window.half_width * (factor * denoiser.half_widths[0].cpu()).clamp(max=WIDEST)
        return dict(zip(LEVELS, widths)), widening


def check_guidance(guidance: float) -> None:
    """Raises ValueError unless the scale of classifier-free guidance lies between 0 and MOST_GUIDANCE."""
    check_between("the guidance scale", guidance, 0, MOST_GUIDANCE)


def sample_seed(seed: int, i: int) -> int:
    """The seed of sample i of a reconstruction: its own for the first, one that hardly returns for the others."""
    return seed if i == 0 else zlib.crc32(f"{seed}/sample {i}".encode())
