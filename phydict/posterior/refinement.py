"""How an estimate is refined on finer voxels: towards the X-rays, and by networks that know what it lacks there."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

from torch import Tensor

from phydict.grid import Grid
from phydict.posterior.coarse_correction import CoarseCorrection
from phydict.posterior.evidence import Evidence
from phydict.posterior.likelihood.likelihood import LikelihoodStep, ProximalCG
from phydict.posterior.measurement import Measurement
from phydict.runtime.profiling import stage
from phydict.runtime.ranges import LEAST, MOST, check_fields
from phydict.units import HUWindow


class Correction(Protocol):
    """A network that has learnt what refined estimates lack on voxels of one size."""

    def suits(self, grid: Grid, window: HUWindow) -> bool:
        """Whether it was trained for these voxels and HU."""
        ...

    def corrected(self, z: Tensor, evidence: Tensor, precision: str) -> Tensor:
        """An estimate z (1, 1, X, Y, Z) of the CT without what it lacks, given the evidence there."""
        ...

    def half_widths(self, grid: Grid, seen: Tensor, precision: str) -> Tensor | None:
        """Half-widths (1, levels, X, Y, Z) of intervals around the result, given a FinerUncertainty's input `seen`;
        None where it knows none on these voxels."""
        ...


@dataclass(frozen=True)
class Refinement:
    """How an estimate is refined on finer voxels.

    z = step(interpolated); then `calls` times z = call_step(coarse(network(z))), of what there is of the two, the last
    time without the coarse one if there is the other. The interpolation of what was refined before takes call_step at
    first as well.

    Args:
        step: towards the X-rays, such as ProximalCG, whose total variation takes a prior's place; none: interpolation
            alone
        x0_std: standard deviation of an interpolated estimate's error, in the range [-1, 1] of its HU window
        calls: how often the networks correct the estimate
        call_step: towards the X-rays after that; none: not met again
        call_std: standard deviation of a corrected estimate's error
        coarse: whether a network that knows coarse voxels corrects the estimate as well
        few_views: with fewer views the total variation of both steps weighs as many times less, the estimate is
            corrected at most once, and by no network on coarse voxels
        many_views: from so many views call_step takes twice the restarts, of four fifths of the iterations, call_std is
            two thirds, and the estimate is corrected `mirrored`
        mirrored: whether the network on the voxels then corrects the estimate mirrored left to right too, as half of
            what it learnt from was, and the mean of both counts
    """

    step: LikelihoodStep | None = ProximalCG(iterations=10, restarts=3, tv_weight=10.0, tv_eps=0.003)
    x0_std: float = 0.5
    calls: int = 2
    call_step: LikelihoodStep | None = ProximalCG(iterations=10, restarts=1, tv_weight=5.0, tv_eps=0.003)
    call_std: float = 0.3
    coarse: bool = True
    few_views: int = 3
    many_views: int = 12
    mirrored: bool = True

    def __post_init__(self):
        check_fields(self, "Refinement", x0_std=(LEAST, MOST), call_std=(LEAST, MOST), calls=(0, math.inf))

    def of_views(self, views: int) -> Refinement:
        """How it is done from so many X-rays."""
        if views >= self.many_views:
            return replace(self, call_std=self.call_std * 2 / 3, call_step=_changed(
                self.call_step, lambda step: {"restarts": 2 * step.restarts,
                                              "iterations": math.ceil(0.8 * step.iterations)}))
        if views >= self.few_views:
            return replace(self, mirrored=False)
        step, call_step = (_changed(step, lambda step: {"tv_weight": step.tv_weight * views / self.few_views})
                           for step in (self.step, self.call_step))
        return replace(self, step=step, call_step=call_step, calls=min(self.calls, 1), coarse=False, mirrored=False)

    def corrections(self, network: bool) -> tuple[int, int]:
        """How often an estimate calls a network on its own voxels, if there is one, and one on coarse voxels; neither
        is called where estimates are only interpolated."""
        fine_calls = self.calls * (1 + self.mirrored) if self.step and network else 0
        coarse_calls = self.calls - network if self.step and self.coarse else 0
        return fine_calls, max(coarse_calls, 0)

    def __call__(self, measurement: Measurement, x: Tensor, network: Correction | None,
                 coarse: CoarseCorrection | None = None, refined: bool = False, precision: str = "auto") -> Tensor:
        """The refined estimate of an interpolated one x (1, 1, X, Y, Z), by a network on these voxels and one on coarse
        ones. refined: whether what was interpolated had been refined; precision: of the former network."""
        if self.step is None:
            return x
        first = (self.call_step, self.call_std) if refined and self.call_step else (self.step, self.x0_std)
        before, z = x, first[0](measurement, x, first[1])
        start, evidence = z, Evidence(measurement) if network and self.calls else None
        for left in reversed(range(self.calls if network or coarse else 0)):
            if network and evidence:
                evidence.measure_noise()
                channels = evidence(z, before, start)
                with stage("network"):
                    z = self._corrected(network, z, channels, precision)
            if coarse is not None and (left or network is None):
                z = coarse(z)
            before = z
            measurement.refit(z)
            z = z if self.call_step is None else self.call_step(measurement, z, self.call_std)
        return z

    def _corrected(self, network: Correction, z: Tensor, channels: Tensor, precision: str) -> Tensor:
        corrected = network.corrected(z, channels, precision)
        if not self.mirrored:
            return corrected
        return (corrected + network.corrected(z.flip(2), channels.flip(2), precision).flip(2)) / 2


def _changed(step: LikelihoodStep | None, settings: Callable[[ProximalCG], dict]) -> LikelihoodStep | None:
    """Conjugate gradients with other settings; another step stays."""
    return replace(step, **settings(step)) if isinstance(step, ProximalCG) else step
