"""Region-of-interest tomography without a prior: what lies outside the box is taken from a coarse reconstruction."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from phydict.baselines.baseline import Baseline
from phydict.grid import Grid
from phydict.reconstruction import Delegating, Reconstruction
from phydict.runtime.profiling import Stopwatch
from phydict.runtime.warning import heard
from phydict.units import hu_to_mu
from phydict.xray import Projector
from phydict.xray.boxes import binned_to, outside_projection, projector_method
from phydict.xray.calibration import match_views
from phydict.xray.checks import prepared_xrays


@dataclass(frozen=True)
class Region(Delegating):
    """A baseline on a box that holds a part of the patient alone.

    It first reconstructs the coarse `outer` box. The line integrals of what that shows outside the region are
    subtracted from the X-rays, of which the region then explains the rest (Ziegler, Nielsen & Grass 2008, Medical
    Physics 35(4)), unless the method is local. Display values are matched to the coarse volume.

    Args:
        base: the baseline
        target: the voxels of the result
        outer: those of the coarse reconstruction, which hold all that the rays meet
    """

    base: Baseline
    target: Grid
    outer: Grid

    @property
    def survey(self) -> Grid:
        return self.outer

    def with_room(self, x: int, y: int, z: int) -> Region | None:
        return replace(self, outer=self.outer.grown(x, y, z)) if self.base.with_room(x, y, z) else None

    def steps(self) -> int:
        return 2 * self.base.steps()

    @torch.no_grad()
    def reconstruct(self, xrays: Tensor, projector: Projector, report: str = "", display: bool = False,
                    seed: int = 0, on_step: Callable[[], None] = lambda: None) -> Reconstruction:
        watch = Stopwatch()
        with watch.stage("base"):
            method = projector_method(projector)
            y, whole = binned_to(self.outer, xrays, projector.beam, self.full_detector, method)
            prepared_xrays(y, whole.beam, display)
            with warnings.catch_warnings(), heard():  # what is doubtful of the X-rays is said, of the fit the box will
                warnings.simplefilter("ignore")
                coarse = self.base.reconstruct(y, whole, report, display, seed, on_step)
        with watch.stage("outside"):
            mu = hu_to_mu(coarse.volume.to(xrays), self.mu_water)
            if display:
                outer = Projector(self.outer, projector.beam, method, device=xrays.device, full_detector=True)
                xrays = match_views(xrays[None], outer(mu[None, None]))[0]
            continued = bool(projector.beam.continued)
            projector = Projector(self.target, replace(projector.beam, continued=False), method,
                                  device=xrays.device, full_detector=True)
            outside = outside_projection(mu, self.outer, projector, continued)
        calls = coarse.projector_calls + 2 + display  # outside: of all and of what lies in the target's columns
        result = self.base.reconstruct(xrays, projector, report, False, seed, on_step, outside)
        return replace(result, coarse=coarse, seconds=watch.seconds | result.seconds,
                       projector_calls=calls + result.projector_calls)
