"""FDK: filtered back projection for cone beams on a circular orbit."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from phydict.baselines.baseline import Baseline, CountingProjector, clip, empty
from phydict.baselines.orbit import CircularOrbit
from phydict.grid import Grid
from phydict.units import MU_WATER, HUWindow
from phydict.xray.places import detector_places


@dataclass(frozen=True)
class FDK(Baseline):
    """Feldkamp, Davis & Kress 1984, doi:10.1364/JOSAA.1.000612, for upright detectors on a circle.

        mu(x) = sum over k of share_k R^2 / depth_k(x)^2 q_k(a, b),   q_k = ramp * (w cos p_k) along rows

    p_k are view k's line integrals at (a, b), mm on the detector scaled to the axis at distance R from the source; cos
    is R / sqrt(R^2 + a^2 + b^2); share_k is the angle that the view stands for and w counts lines seen twice once: both
    are `CircularOrbit`'s, which says how they are on full circles, short scans and limited arcs. The ramp is Kak &
    Slaney's band-limited one (1988, ch. 3), between zeros; detector edges that cut the patient are not extrapolated.

    Few views give streaks. Raises ValueError for views that are no such orbit.

    Args:
        hann: smooth the ramp with a Hann window down to zero at the pixels' Nyquist frequency
        window: HU bounds of the result, or None for none, which makes it linear in the X-rays
        mu_water: attenuation of water in 1/mm in the X-rays
        name: what results call the method
    """

    citation = ("Feldkamp, Davis & Kress, Practical Cone-Beam Algorithm, Journal of the Optical Society of America "
                "A 1(6), 1984, doi:10.1364/JOSAA.1.000612")

    local = True
    hann: bool = True
    window: HUWindow | None = HUWindow()
    mu_water: float = MU_WATER
    name: str = "fdk"

    def steps(self) -> int:
        return 1

    def solve(self, A: CountingProjector, y: Tensor, on_step: Callable[[], None]) -> Tensor:
        beam, grid = A.beam, A.grid
        orbit = CircularOrbit.of(beam, grid)
        density = empty(A, y)
        for k, filtered in enumerate(self._filtered(orbit, y)):
            density += _smeared(orbit, k, filtered, grid)
        A.calls += 1
        on_step()
        return clip(density, self.window)

    def _filtered(self, orbit: CircularOrbit, y: Tensor) -> Tensor:
        """Weighted and filtered views (K, V, U), times the angles that they stand for."""
        beam, (rows, columns) = orbit.beam, (torch.arange(n) - (n - 1) / 2 for n in y.shape[2:])
        foot = beam.detectors - beam.sources
        a, b = (torch.as_tensor((foot * step).sum(1) / (step**2).sum(1))[:, None] + places
                for step, places in ((beam.u, columns), (beam.v, rows)))
        height, pitch = torch.as_tensor(beam.pixel.T * (orbit.radius / beam.distances))[..., None]
        a, b = a * pitch, b * height
        cosine = orbit.radius / (orbit.radius**2 + a[:, None] ** 2 + b[:, :, None] ** 2).sqrt()
        share = orbit.shares()[:, None] * orbit.redundancy((a / orbit.radius).numpy())
        weight = cosine * torch.as_tensor(share)[:, None]
        n = 2 ** math.ceil(math.log2(2 * y.shape[3]))
        response = ramp(n, self.hann) / pitch
        return torch.fft.irfft(torch.fft.rfft(y[0] * weight.to(y), n) * response[:, None].to(y), n)[..., :y.shape[3]]


def ramp(n: int, hann: bool = False) -> Tensor:
    """Frequency response (n/2 + 1,) of the band-limited ramp for samples one apart, of which n are transformed.

    Transform of h(0) = 1/4, h(j) = -1 / (pi j)^2 for odd j and 0 for even j: unlike |f| itself it has the right mean.
    """
    j = torch.arange(n, dtype=torch.float64)
    j = torch.minimum(j, n - j)
    kernel = torch.where(j % 2 == 1, -1 / (math.pi * j.clamp(min=1)) ** 2, 0.0)
    kernel[0] = 0.25
    response = torch.fft.rfft(kernel).real
    return response * torch.cos(torch.linspace(0, math.pi / 2, len(response)).double()) ** 2 if hann else response


def _smeared(orbit: CircularOrbit, k: int, filtered: Tensor, grid: Grid) -> Tensor:
    """View k's part in the volume (1, 1, X, Y, Z): its filtered pixels (V, U) along their rays, by distance."""
    depth, places = detector_places(grid, orbit.beam, k, filtered)
    smeared = grid_sample(filtered[None, None], places.flatten(0, 1)[None], align_corners=False).view(depth.shape)
    return ((orbit.radius / depth) ** 2 * smeared)[None, None]
