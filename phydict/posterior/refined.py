"""A reconstruction on finer voxels than its method's own: upsampled and met with the X-rays, level by level."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from phydict.grid import Grid
from phydict.guard import BAD_FIT, Guard
from phydict.posterior.coarse_correction import coarse_correction
from phydict.posterior.measurement import Measurement
from phydict.posterior.posterior import WIDEST
from phydict.posterior.refinement import Correction, Refinement
from phydict.prior.finer_uncertainty import INPUT_LEVEL
from phydict.prior.uncertainty import LEVELS
from phydict.reconstruction import Delegating, Reconstruction, check_projected_from
from phydict.runtime.profiling import Stopwatch
from phydict.runtime.warning import Remark, warn
from phydict.units import AIR, HUWindow, hu_to_mu
from phydict.xray import Projector
from phydict.xray.boxes import (
    SLACK,
    averaged,
    binned_to,
    covers,
    interpolated,
    no_finer,
    outside_projection,
    projector_method,
    refinements,
)
from phydict.xray.residuals import misfits, shared_norms

ON_FINER = {0.5: (0.85, 0.0), 0.8: (1.0, 0.0), 0.9: (1.0, 0.1), 0.95: (1.0, 0.2)}
"""Level -> the shares of a coarse interval and of the refinement's change of which one on finer voxels is the sum: of
two CTs kept from training these hold 43 to 52, 75 to 86, 85 to 95 and 92 to 99 % of the body from 1 to 16 views. Those
of other levels are interpolated, and beyond the ends they are those there."""

CORRECTED_VOLUMES = 62
"""Volumes of the finest voxels that a refinement by a network on them holds at most, in float32
(tests/benchmark/grid_cost.csv)."""


@dataclass(frozen=True)
class Refined(Delegating):
    """`base` on its own voxels, then a refinement on finer ones, each time half as long, up to the target's.

    At each level the estimate so far is interpolated trilinearly onto the finer voxels and is then where the
    refinement starts and what it stays near. Where the base is a refiner and the level's voxels divide its own, its
    network corrects the estimate there as well (`CoarseCorrection`). The X-rays are binned to what the level can hold.
    Where the target's box leaves out a part of the base's, the line integrals of what the base shows there are added to
    those of the box (region-of-interest tomography; Ziegler, Nielsen & Grass 2008, Medical Physics 35(4)). Scatter that
    the base found is subtracted, and what it counted as noise of a view counts so; display values are matched to the
    estimate anew. What a base without masks reconstructed, such as water, no network corrects.

    Masks and deviations of the result are the base's, interpolated. Its intervals are the network's where it knows
    them and the base's have its LEVELS, on still finer voxels interpolated, and else made of the base's and of what the
    refinement changed of the interpolated volume, as ON_FINER says. Remarks on voxels on which no network corrects.

    A target in the base's box whose voxels are along no axis shorter than the base's is not refined: its volume, masks,
    deviation and intervals are the base's, averaged over its voxels, and its misfit that of the base's volume.

    Args:
        base: the method, bound to voxels and an HU `window` of its own: a prior's, a cascade's or a rival's
        target: the voxels of the result, along the same axes
        refinement: how
        networks: what corrects the estimates on voxels, the last of those that suit them; none: nothing
    """

    base: Any
    target: Grid
    refinement: Refinement = Refinement()
    networks: tuple[Correction, ...] = ()

    def __post_init__(self):
        super().__post_init__()
        refinements(self.base.grid, self.target)

    @property
    def survey(self) -> Grid:
        return self.base.grid

    def detector_grid(self, grid: Grid) -> Grid:
        return min(grid, self.base.grid, key=lambda voxels: min(voxels.spacing))

    def with_room(self, x: int, y: int, z: int) -> Refined | None:
        """As a Reconstructor; the target has as much more room where it holds all of the base's box."""
        base, target = self.base.with_room(x, y, z), self.target
        if base is None:
            return None
        if covers(target, self.base.grid):
            more = np.multiply((x, y, z), self.base.grid.spacing) / target.spacing
            target = target.grown(*(math.ceil(n - SLACK) for n in more))
        return replace(self, base=base, target=target)

    @property
    def levels(self) -> list[Grid]:
        """The voxels of each refinement."""
        return [] if no_finer(self.target, self.base.grid) else refinements(self.base.grid, self.target)

    @property
    def volumes(self) -> int:
        if any(map(self._network, self.levels)):
            return CORRECTED_VOLUMES
        return super(Delegating, self).volumes  # the base holds its own on coarser voxels

    def _network(self, level: Grid) -> Correction | None:
        suiting = [network for network in self.networks if network.suits(level, self.base.window)]
        return suiting[-1] if suiting else None

    def steps(self) -> int:
        return self.base.steps() + len(self.levels)

    @torch.no_grad()
    def reconstruct(self, xrays: Tensor, projector: Projector, report: str = "", display: bool = False,
                    seed: int = 0, on_step: Callable[[], None] = lambda: None) -> Reconstruction:
        check_projected_from(self.target, projector, "the target's", "the target is")
        xrays = xrays.float()  # which the networks learnt in
        watch, base, refinement = Stopwatch(), self.base, self.refinement.of_views(projector.beam.views)
        with watch.stage("base"):
            binned = self._binned(xrays, projector, base.grid)
            coarse = base.reconstruct(*binned, report, display, seed, on_step)
        if not self.levels:
            return self._averaged(coarse, watch.seconds)
        volume, grid, calls, scores = coarse.within.to(xrays), base.grid, coarse.projector_calls, {}
        network_calls, known, alone = coarse.network_calls, None, list[str]()
        for number, level in enumerate(self.levels):
            with watch.stage("refine"):
                y, A = self._binned(xrays, projector, level)
                start = base.window.to_range(interpolated(volume, grid, level, AIR))[None, None]
                measurement = self._measurement(y, A, coarse, display, bool(projector.beam.continued))
                measurement.refit(start)
                network = self._network(level) if coarse.masks is not None else None
                fine_calls, coarse_calls = refinement.corrections(network is not None)
                correction = coarse_correction(base, level, binned, coarse, report, display) if coarse_calls else None
                x = refinement(measurement, start, network, correction, number > 0, base.precision)
                guard = Guard(measurement, on_step, 1)
                guard()
                if network is not None and coarse.intervals and coarse.masks is not None and len(coarse.masks):
                    known = self._known_intervals(network, level, x, start, coarse) or known
            volume, grid = base.window.to_hu(x[0, 0]), level
            with watch.stage("score"):
                scores = guard.score(x, measurement.conclude(x), measurement.y) | {"scatter": measurement.scatter}
            calls += measurement.calls
            network_calls += fine_calls
            if correction is not None:
                calls += correction.projector_calls
                network_calls += correction.calls
            if refinement.step and not fine_calls and correction is None:
                alone.append(" x ".join(map(str, level.shape)))
        if alone:
            warn(f"no network has learnt to refine {self.name} to {' and '.join(alone)} voxels here: the X-rays and "
                 "total variation alone do", Remark)
        before, after = (misfits(fit["reprojection"], fit["xrays"], shared_norms)["misfit"]
                         for fit in (vars(coarse), scores))
        if before <= BAD_FIT < after:
            warn(f"the volume refined to {' x '.join(map(str, grid.shape))} voxels does not explain the X-rays (misfit "
                 f"{after:.2g}), though the coarse one does: trust that one, and look at what the networks that refine "
                 "have learnt")
        deviation, volume = coarse.deviation, volume.cpu()
        if deviation is not None and not covers(base.grid, self.target):
            drawn = " x ".join(f"{side:g}" for side in base.grid.extent)
            warn(f"samples are drawn on the prior's {drawn} mm alone: beyond these their deviation is 0, which says "
                 "nothing", Remark)
        intervals = self._intervals(coarse, volume, known)
        if coarse.carried:
            volume = volume + coarse.carried.on(grid)
        return replace(
            coarse, **scores | {"diverged_at": coarse.diverged_at}, volume=volume, grid=self.target,
            coarse=coarse, projector_calls=calls, network_calls=network_calls, seconds=watch.seconds,
            intervals=intervals,
            masks=None if coarse.masks is None else interpolated(coarse.masks, base.grid, self.target, 0.0),
            deviation=None if deviation is None else interpolated(deviation, base.grid, self.target, 0.0))

    def _averaged(self, coarse: Reconstruction, seconds: dict[str, float]) -> Reconstruction:
        def onto(volume: Tensor) -> Tensor:
            return averaged(volume, coarse.grid, self.target)

        return replace(coarse, volume=onto(coarse.volume), grid=self.target, coarse=coarse, seconds=seconds,
                       masks=None if coarse.masks is None else onto(coarse.masks),
                       deviation=None if coarse.deviation is None else onto(coarse.deviation),
                       intervals={level: onto(half_width) for level, half_width in coarse.intervals.items()})

    def _known_intervals(self, network: Correction, level: Grid, x: Tensor, start: Tensor, coarse: Reconstruction
                         ) -> tuple[dict[float, Tensor], Grid] | None:
        """The half-widths in HU that a network knows on a level's voxels, and these; None where it knows none."""
        if tuple(coarse.intervals) != LEVELS:
            return None
        window = self.base.window
        widths = network.half_widths(level, network_input(x, start, coarse, window, level), self.base.precision)
        if widths is None:
            return None
        return dict(zip(LEVELS, window.half_width * widths[0].clamp(max=WIDEST).cpu())), level

    def _intervals(self, coarse: Reconstruction, volume: Tensor, known: tuple[dict[float, Tensor], Grid] | None
                   ) -> dict[float, Tensor]:
        """Level -> half-widths in HU (X, Y, Z) on the target's voxels, from those `known` or else the coarse ones."""
        if known is not None:
            return {level: interpolated(half_width, known[1], self.target, 0.0)
                    for level, half_width in known[0].items()}
        change = (volume - interpolated(coarse.within, coarse.grid, self.target, AIR)).abs()
        intervals = {}
        for level, half_width in coarse.intervals.items():
            own, changed = on_finer(level)
            intervals[level] = own * interpolated(half_width, coarse.grid, self.target, 0.0) + changed * change
        return intervals

    def _binned(self, xrays: Tensor, projector: Projector, grid: Grid) -> tuple[Tensor, Projector]:
        """The X-rays as a level sees them, binned to what its voxels can hold, and the projector to them."""
        beam = projector.beam
        if beam.continued and not covers(grid, self.base.grid):  # what lies beyond is then outside
            beam = replace(beam, continued=False)
        elif grid.same_as(projector.grid):
            return xrays, projector
        return binned_to(grid, xrays, beam, self.full_detector, projector_method(projector))

    def _measurement(self, y: Tensor, A: Projector, coarse: Reconstruction, display: bool, continued: bool
                     ) -> Measurement:
        """The X-rays as a problem on a level's voxels alone; continued: whether the coarse volume continues."""
        outside = None
        if not covers(self.target, coarse.grid):
            mu = hu_to_mu(coarse.within.to(y), self.mu_water)
            outside = outside_projection(mu, coarse.grid, A, continued)
        measurement = Measurement(A, y, self.base.window, display, self.mu_water, outside=outside, told=True)
        measurement.adopt(coarse)
        return measurement


def on_finer(level: float) -> tuple[float, float]:
    """The shares of ON_FINER at any level."""
    own, changed = (float(np.interp(level, list(ON_FINER), shares)) for shares in zip(*ON_FINER.values()))
    return own, changed


def network_input(x: Tensor, start: Tensor, coarse: Reconstruction, window: HUWindow, level: Grid) -> Tensor:
    """The input of a FinerUncertainty (1, INPUT_CHANNELS, X, Y, Z): an estimate x on a level's voxels, `start`, from
    which it was interpolated, both (1, 1, X, Y, Z) in the prior's range, and the coarse result's interval and lungs."""
    assert coarse.masks is not None
    width, lung = (interpolated(of_coarse, coarse.grid, level, 0.0)[None, None].to(x)
                   for of_coarse in (coarse.intervals[INPUT_LEVEL] / window.half_width, coarse.masks[0]))
    return torch.cat([x.clamp(-1, 1), start, width, lung], 1)
