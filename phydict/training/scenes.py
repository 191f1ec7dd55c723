"""X-ray scenes to learn from: geometry, noise and model errors, drawn at random."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from phydict.grid import Grid
from phydict.posterior import Measurement
from phydict.runtime.ranges import check_fields
from phydict.units import HUWindow
from phydict.xray import ConeBeam, Projector
from phydict.xray.finer import FinerProjector
from phydict.xray.orbits import PIXEL, PIXELS, SOURCE_TO_DETECTOR, SOURCE_TO_ISOCENTRE
from phydict.xray.polychromatic import scatter_of
from phydict.xray.poses.unknowns import POSE, moved

REACH = 1.48
"""Least distance from the isocentre to source and detector, over half the grid's side: their planes miss the grid."""


MISPLACED = (1.5, 1.5, 1.5, 1.5, 1.5, 0.0, 0.3, 0.0)
"""Standard deviations of the poses' errors (poses.unknowns.POSE), in mm and degrees; detectors stay upright."""

SCATTER_AMPLITUDE, SCATTER_MM = (0.02, 0.08), 60.0
"""Least and most amplitude of `scatter_of`, and its width."""

PHOTONS = (1e4, 1e6)

TILT_DEGREES = 20.0

USUAL_NOISE = 0.005
"""The noise of two fifths of the scenes, as far as `Scenes.noise` has it."""


@dataclass(frozen=True)
class Scenes:
    """From which scenes a refiner learns. Lengths are those of a grid of 384 mm and scale with the grid.

    Args:
        most_views: views, drawn log-uniformly from 1 on
        orbit: share of full orbits from angle 0, as the benchmarks use; half as many again start anywhere
        arc: share of limited arcs, of 40 to 220 degrees; the rest has views at irregular angles
        varied: share of scenes whose distances, pixels and detector place differ from the benchmarks'
        noise: least and most standard deviation of the noise, as a share of the largest line integral
        model_error: share of scenes with beam hardening and a scale that is off by up to 3 %
        fine: share of scenes whose X-rays are made of the finer volume, where the data have one
            (data.loading.simulation_voxels), on a detector that is as much finer and is then binned
        misplaced: share of scenes whose views are not exactly where they are stated to be
        scatter: share of scenes with scattered radiation
        counting: share of scenes with the noise of 10^4 to 10^6 counted photons per pixel instead
        tilted: share of scenes whose detectors are tilted, all by the same up to 20 degrees; their projections are slow
    """

    most_views: int = 32
    orbit: float = 0.5
    arc: float = 0.15
    varied: float = 0.4
    noise: tuple[float, float] = (5e-4, 0.02)
    model_error: float = 0.3
    fine: float = 0.5
    misplaced: float = 0.0
    scatter: float = 0.0
    counting: float = 0.0
    tilted: float = 0.0

    def __post_init__(self):
        shares = ("orbit", "arc", "varied", "model_error", "fine", "misplaced", "scatter", "counting",
                  "tilted")
        check_fields(self, "model.scenes", most_views=(1, 1000), **dict.fromkeys(shares, (0, 1)))
        if 1.5 * self.orbit + self.arc > 1:
            raise ValueError("model.scenes has 1.5 orbit + arc of at most 1, but orbit "
                             f"{self.orbit} and arc {self.arc} were given")
        if not 0 < self.noise[0] <= self.noise[1] < 1:
            raise ValueError(f"model.scenes.noise is two shares, 0 < least <= most < 1, but {self.noise} was given")

    def beam(self, rng: np.random.Generator, grid: Grid) -> ConeBeam:
        """A geometry whose detector has about the resolution of the grid."""
        scale, side = grid.extent[0] / 384, grid.shape[0]
        views = int(np.clip(round(self.most_views ** rng.random()), 1, self.most_views))
        source, centre, shift = SOURCE_TO_DETECTOR, SOURCE_TO_ISOCENTRE, 0.0
        pixel, pixels = 4 * PIXEL * 64 / side, PIXELS * side // 256
        tilt = math.radians(rng.uniform(-TILT_DEGREES, TILT_DEGREES)) if _happens(self.tilted, rng) else 0.0
        if rng.random() < self.varied or tilt:
            source = rng.uniform(950, 1400)
            reach = 192 * (REACH * math.cos(tilt) + math.sin(abs(tilt)))
            centre = np.clip(source * rng.uniform(0.55, 0.75), reach, source - reach)
            pixel *= rng.uniform(0.8, 1.2)
            pixels = int(rng.uniform(0.4, 1.15) * pixels)
            shift = rng.uniform(-0.25, 0.25) * (rng.random() < 0.3)
        kind, start = rng.random(), rng.uniform(0, 2 * math.pi)
        geometry = source * scale, centre * scale, (pixels, pixels), pixel * scale
        if kind < 1.5 * self.orbit:
            beam = ConeBeam.orbit(views, *geometry, start=0.0 if kind < self.orbit else start)
        elif kind < 1.5 * self.orbit + self.arc:
            beam = ConeBeam.orbit(views, *geometry, start=start, arc=math.radians(rng.uniform(40, 220)))
        else:
            angles = max(360, self.most_views)
            beam = ConeBeam.orbit(angles, *geometry).select(np.sort(rng.choice(angles, views, replace=False)))
        if tilt:
            beam = beam.tilted(math.degrees(tilt))
        return beam.shifted(columns=shift * pixels * pixel * scale) if shift else beam

    def xrays(self, ct: Tensor, rng: np.random.Generator, grid: Grid, window: HUWindow,
              fine: Tensor | None = None) -> tuple[Tensor, Projector]:
        """X-rays (K, V, U) of a CT (1, 1, X, Y, Z) in the prior's range, of a drawn scene, and their projector from its
        grid; `fine`, if given, is the same CT in finer voxels."""
        scale = grid.extent[0] / 384
        projector = true = Projector(grid, self.beam(rng, grid), device=ct.device, full_detector=True)
        if _happens(self.misplaced, rng):
            true = Projector(grid, _moved(projector.beam, rng, scale), device=ct.device, full_detector=True)
        if fine is not None and rng.random() < self.fine:
            y = FinerProjector(true, fine.shape[-1] // ct.shape[-1])(window.to_mu(fine))
        else:
            y = true(window.to_mu(ct))
        if rng.random() < self.model_error:
            hardened = rng.uniform(0, 0.02) * y * (0.7 * float(y.max()) - y) / 2
            y = (1 + rng.uniform(-0.03, 0.03)) * (y + hardened)
        if _happens(self.scatter, rng):
            primary, amplitude = (-y[0]).exp(), rng.uniform(*SCATTER_AMPLITUDE)
            y = -(primary + scatter_of(primary, true.beam, amplitude, SCATTER_MM * scale)).log()[None]
        if _happens(self.counting, rng):
            photons = math.exp(rng.uniform(*np.log(PHOTONS)))
            counts = torch.from_numpy(rng.poisson(photons * (-y.double()).exp().numpy(force=True))).clamp(min=0.5)
            return -(counts / photons).log().to(y)[0], projector
        low, high = np.log(self.noise)
        usual = float(np.clip(USUAL_NOISE, *self.noise))
        noise = usual if rng.random() < 0.4 else math.exp(rng.uniform(low, high))
        y = y + noise * y.max() * torch.from_numpy(rng.standard_normal(tuple(y.shape))).to(y)
        return y[0], projector

    def measure(self, ct: Tensor, rng: np.random.Generator, grid: Grid, window: HUWindow,
                fine: Tensor | None = None) -> Measurement:
        """The same as a measurement; of what was drawn into it nobody is warned."""
        with warnings.catch_warnings(), torch.autocast(ct.device.type, enabled=False):
            warnings.simplefilter("ignore")
            y, projector = self.xrays(ct, rng, grid, window, fine)
            return Measurement(projector, y, window)


def _happens(share: float, rng: np.random.Generator) -> bool:
    """Whether something that befalls a share of the scenes does; what befalls none draws nothing."""
    return share > 0 and rng.random() < share


def _moved(beam: ConeBeam, rng: np.random.Generator, scale: float) -> ConeBeam:
    """Where the views of a beam really are."""
    lengths = np.where([kind.endswith("_mm") for kind in POSE], scale, 1.0)
    return moved(beam, rng.standard_normal((beam.views, len(POSE))) * MISPLACED * lengths)
