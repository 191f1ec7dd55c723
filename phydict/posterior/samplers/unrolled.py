"""A few calls of a refiner, a network that sees the X-rays, each followed by a likelihood step."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn.functional import pad

from phydict.diffusion import Generators, noise_like
from phydict.posterior.discretisation import FINER_STEP, find_subgrid, has_finer, subgrid_projection
from phydict.posterior.evidence import Evidence
from phydict.posterior.explained import explained
from phydict.posterior.likelihood.likelihood import LikelihoodStep, ProximalCG
from phydict.posterior.measurement import Measurement
from phydict.posterior.metal import Metal
from phydict.posterior.samplers.sampler import Sampler
from phydict.posterior.samplers.split_gibbs import SplitGibbs
from phydict.prior import DEFAULT_REFINER, BoundRefiner
from phydict.runtime.ranges import LEAST, MOST, check_between, check_fields
from phydict.runtime.warning import warn
from phydict.xray import Projector
from phydict.xray.boxes import projector_method

CAUTION = 3.0
"""Standard deviation that a view's contradiction counts as, over its root mean square: neighbouring pixels share it."""

OUTLIER, SHARED = 2.2, 0.45
"""A view whose error is OUTLIER times the median's is doubted from half of the usual limit on: of one that was shifted
it is 2.8 to 3.2 times, of right ones 2.05 at most. Of the worst view's error, SHARED may be seen in others because of
it, and does not count against them: with one view flipped 0.25 to 0.5. Both of CTs that evaluate nothing."""

FIRST_STEP_VIEWS = 8
"""Views beyond which the first step, of bounded length, leaves more of each, as the root of their number: on five
CTs 0.26 to 0.36 voxels of 8 polychromatic views at most and 0.3 to 0.42 of 16, but 1.3 to 1.5 of 8 in wrong poses."""


@dataclass(frozen=True)
class Unrolled(Sampler):
    """z = start(start_state); then for each time: x0 = refine(z, evidence), z = likelihood(x0). Deterministic. Once
    more with line integrals straightened, where they bend as a tube's do, and with scatter subtracted, as SplitGibbs
    does.

    The start state is what chests are on average. From few views with a report, and with a refiner that has a prior to
    begin with, it is instead what this prior makes of both.

    Where the steps up to half of the calls still miss the X-rays by more than their noise, what the grid cannot hold of
    them is sought on finer voxels (`subgrid_projection`) and from then on counted as known: real X-rays are never made
    on a grid. Not in a view whose error grows more than UNLIKE_FINER times by it, nor where detectors are tilted, for
    which finer voxels cost too much.

    Where the first step misses a view, beyond its noise, by more than `contradiction`, or by more than half of it and
    OUTLIER times as much as the median view, and by more than SHARED of the worst view's error, and finer voxels do not
    explain that, such as a couch's sheets seen along their faces, then no volume does, as with wrong poses, a flipped
    view, a gain that drifts or a patient who moves: the excess counts from then on as noise of that view
    (`Measurement.model_variance`), so that volumes follow it less and the prior and the other views more. Where scatter
    is sought, of which the first step knows little, the second tells that.

    Args:
        times: labels in (0, 1) under which the refiner's network takes each z, as if it were a noisy state of that time
        x0_stds: standard deviation of the error of each x0, in the prior's range, that of the start state first
        start: the first step towards the X-rays
        likelihood: the steps towards the X-rays between the calls
        final_likelihood: the last step towards the X-rays
        many_views: the fewest views from which that step, where it is ProximalCG, has twice the total variation and
            twice the iterations: inside the bodies of two CTs that evaluate nothing they gain 0.5 and 0.9 dB from 32
            views of finer voxels and 0.3 and 0.6 from 32 of the same; from 16 of the same they lose
        subgrid: the step on finer voxels; none: what the grid cannot hold is left in the X-rays
        contradiction: root mean square error of a view's line integrals beyond its noise, from which on it counts as
            noise, in those of one voxel of water against air, of more than FIRST_STEP_VIEWS views in proportion to the
            root of their number; none: it never does
        chests_only: whether one material in air is left to a method without a network (`Posterior.otherwise`)
        metal: how what is denser than the prior's window is sought; none: it is not
        first: how the prior that a refiner begins with is sampled, in one pass (`SplitGibbs.one_pass`); none: it is not
        first_views: the most views, with a report, for which it is; more say themselves what a report could add
        more_times: labels of further calls from `more_views` views on, whose x0 has the last of x0_stds; of two CTs
            that evaluate nothing they gain 0.3 and 0.4 dB from 16 and 32 views, and at most 0.1 from 8
        more_views: the fewest views with further calls
        corrections: files of networks that correct its volumes on finer voxels (configs/prior/refinement.yaml); none:
            those shipped
    """

    citation = ("Adler & Oktem, Learned Primal-Dual Reconstruction, IEEE Transactions on Medical Imaging 37(6), 2018, "
                "doi:10.1109/TMI.2018.2799231")

    times: tuple[float, ...] = (0.35, 0.25, 0.2, 0.15)
    x0_stds: tuple[float, ...] = (0.5, 0.3, 0.3, 0.3, 0.3)
    start: LikelihoodStep = ProximalCG(10, 3, refit_scatter=True, tv_weight=10.0, tv_eps=0.003)
    likelihood: LikelihoodStep = ProximalCG(10, 3, refit_scatter=True, tv_weight=5.0, tv_eps=0.003)
    final_likelihood: LikelihoodStep = ProximalCG(10, 4, refit_scatter=True, weighted_least_squares=True,
                                                  tv_weight=2.0, tv_eps=0.003, discrepancy=True)
    many_views: int = 24
    subgrid: LikelihoodStep | None = FINER_STEP
    contradiction: float | None = 0.4
    chests_only: bool = False
    metal: Metal | None = Metal()
    first: SplitGibbs | None = SplitGibbs(
        5, ProximalCG(7, 1, tv_weight=10.0, tv_eps=0.003), t_start=0.97, t_end=0.15, noise_fraction=0.4, momentum=0.5)
    first_views: int = 3
    more_times: tuple[float, ...] = (0.12, 0.1)
    more_views: int = 12
    corrections: tuple[str, ...] = ()
    default_prior = DEFAULT_REFINER
    needs_refiner = True

    def __post_init__(self):
        if not self.times or not all(0 < t < 1 for t in self.times + self.more_times):
            raise ValueError("times are one or more numbers between 0 and 1, and more_times any number of them, but "
                             f"{self.times} and {self.more_times} were given")
        if len(self.x0_stds) != len(self.times) + 1:
            raise ValueError(f"x0_stds are {len(self.times) + 1} numbers, one more than times, but {self.x0_stds} was "
                             "given")
        if isinstance(self.corrections, str):
            raise ValueError(f"corrections are a list of files, but '{self.corrections}' was given: put it into one")
        for std in self.x0_stds:
            check_between("each of Unrolled.x0_stds", std, LEAST, MOST)
        check_fields(self, "Unrolled", contradiction=(0, MOST))

    def steps(self) -> int:
        return len(self.times) + 1

    def calls(self, views: int) -> tuple[float, ...]:
        """The label of each call of the refiner, given so many X-rays."""
        return self.times + (self.more_times if views >= self.more_views else ())

    def last_step(self, views: int) -> LikelihoodStep:
        """The last step towards so many X-rays."""
        step = self.final_likelihood
        if views < self.many_views or not isinstance(step, ProximalCG):
            return step
        return replace(step, iterations=2 * step.iterations, tv_weight=2 * step.tv_weight)

    def estimates(self, refiner: BoundRefiner, measurement: Measurement, on_step: Callable[[], None] = lambda: None,
                  on_result: Callable[[Tensor, Callable[[], Tensor]], None] = lambda z, evidence: None
                  ) -> Iterator[Tensor]:
        """What the refiner answers at each call, and at last the result. Gradients do not pass from call to call.

        on_result: is given the result, and what computes the evidence there. The calls of `more_times` are no steps
        of their own.
        """
        views = measurement.projector.beam.views
        times, final = self.calls(views), self.last_step(views)
        measurement.subgrid = measurement.model_variance = 0.0
        before = self.start_state(refiner, measurement)
        measurement.refit(before[:, :1])
        evidence = Evidence(measurement)
        z = start = self._likelihood_step(self.start, measurement, before, self.x0_stds[0])
        on_step()
        for n, t in enumerate(times):
            channels = evidence(z[:, :1], before[:, :1], start[:, :1])
            projection = measurement.last_projection
            checked = n == min(int(measurement.scatter_enabled), len(times) - 1)
            if checked and self.contradiction is not None and projection is not None:
                self._check_views_fit(measurement, z[:, :1], projection, self.contradiction)
            signal = float(refiner.schedule.scales(t)[0])
            x0 = refiner.refine(signal * z, t, channels)
            yield x0
            before = x0.detach().clamp(-1, 1)
            measurement.refit(before[:, :1])
            last, x0_std = n + 1 == len(times), self.x0_stds[min(n + 1, len(self.times))]
            z = self._likelihood_step(final if last else self.likelihood, measurement, before, x0_std)
            if n + 1 == len(self.times) // 2:
                find_subgrid(measurement, z[:, :1], self.subgrid, self.x0_stds[0])
            if last or n + 1 < len(self.times):
                on_step()
        on_result(z, lambda: evidence(z[:, :1], before[:, :1], start[:, :1]))
        yield z

    def _check_views_fit(self, measurement: Measurement, z: Tensor, projection: Tensor, contradiction: float) -> None:
        """Counts as noise of each view what the `projection` (1, K, V, U) of a CT z misses of it too much to be
        explained, on finer voxels either."""
        voxel = measurement.mu_water * max(measurement.projector.grid.spacing)
        usual = contradiction * voxel * max(1.0, measurement.projector.beam.views / FIRST_STEP_VIEWS) ** 0.5

        def excess_of(errors: Tensor) -> Tensor:
            like_others = (OUTLIER * errors.median()).clamp(usual / 2, usual)
            return errors.square() - torch.maximum(like_others, SHARED * errors.max()).square()

        excess = excess_of(errors := measurement.view_errors(projection))
        if (excess > 0).any() and self.subgrid is not None and has_finer(measurement.projector):
            known = measurement.subgrid
            finer = subgrid_projection(measurement, z, self.subgrid, self.x0_stds[0]) - known
            measurement.subgrid = known
            excess = excess_of(torch.minimum(errors, measurement.view_errors(projection + finer)))
        if (excess > 0).any():
            measurement.model_variance = CAUTION**2 * excess.clamp(min=0)[:, None, None]

    def start_state(self, refiner: BoundRefiner, measurement: Measurement) -> Tensor:
        """The state (1, C, X, Y, Z) before the first step: of few views with a report what the refiner's prior to begin
        with makes of both, in one pass from noise that is always the same. Beyond the refiner's own slices it is as in
        their last ones, and so is the mean beyond its own voxels."""
        mean = refiner.mean.to(measurement.y)
        x, y, z = ((n - own) // 2 for n, own in zip(measurement.projector.grid.shape, mean.shape[2:]))
        state = pad(mean, (0, 0, y, y, x, x), mode="replicate")
        if self.first is not None and refiner.begins and measurement.projector.beam.views <= self.first_views:
            generator = torch.Generator().manual_seed(0)
            own = without_slices(measurement, z) if z else measurement
            state = self.first.one_pass(refiner, own, noise_like(state, generator), generator)
            measurement.calls += own.calls if z else 0
        return pad(state, (z, z, 0, 0, 0, 0), mode="replicate")

    @staticmethod
    def _likelihood_step(step: LikelihoodStep, measurement: Measurement, x0: Tensor, x0_std: float) -> Tensor:
        return torch.cat([step(measurement, x0[:, :1], x0_std).clamp(-1, 1), x0[:, 1:]], 1)

    def sample(self, denoiser: BoundRefiner, measurement: Measurement, x: Tensor,  # type: ignore[override]
               generator: Generators, on_step: Callable[[], None] = lambda: None) -> Tensor:
        results = []

        def result(on_step: Callable[[], None]) -> Tensor:
            *_, z = self.estimates(denoiser, measurement, on_step, lambda *pair: results.append(pair))
            return z

        views = measurement.projector.beam.views
        if self.first is not None and denoiser.begins and views > self.first_views:
            warn(f"the report is not used: phydict_learned reads one with up to {self.first_views} X-rays, and {views} "
                 "were given; phydict_fast with a prior that reads reports uses it with any number")
        z = explained(measurement, result, on_step, self.metal)
        for state, evidence in results:
            if torch.equal(state, z):
                denoiser.conclude(z, evidence)
        return z


def without_slices(measurement: Measurement, slices: int) -> Measurement:
    """The same X-rays on a grid of so many slices less at both ends, beyond which the patient continues."""
    projector = measurement.projector
    return measurement.on(Projector(
        projector.grid.grown(0, 0, -slices), replace(projector.beam, continued=True), projector_method(projector),
        device=measurement.y.device, full_detector=True))
