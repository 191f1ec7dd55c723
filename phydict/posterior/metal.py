"""Metal and whatever else is denser than a prior's window: found, and carried beside the prior."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn.functional import interpolate, max_pool3d

from phydict.guard import BONE, CEILING, CEILING_ML, millilitres
from phydict.linalg.conjugate_gradients import conjugate_gradients, may_follow
from phydict.linalg.total_variation import TVQuadraticMajorizer
from phydict.posterior.measurement import Measurement
from phydict.posterior.widening import directions
from phydict.runtime.ranges import check_fields
from phydict.units import HUWindow
from phydict.xray import Projector
from phydict.xray.boxes import part
from phydict.xray.carried import RAYS, Carried
from phydict.xray.finer import FinerProjector


@dataclass(frozen=True)
class Metal:
    """How what is denser than a prior's window is sought.

    Where a result has `least_ml` to `most_ml` at the window's upper end, extra attenuation e is sought in these voxels
    and their neighbours, on voxels half as long, together with the CT z around it:

        min over z in [-1, 1], e >= 0 of |P(z) + B e - y|^2 / noise^2 + |z - x|^2 / x0_std^2 + 2 tv_weight TV(z)

    x is the result with soft tissue in the place of those voxels. Total variation counts z alone, so that what is
    dense and sharp comes to lie in e. After FREE restarts of conjugate gradients e is left where it reaches SHARE of
    its largest value, for metal is compact and dense. The method then runs again with e counted as known, unless e
    falls short of PROMISING times `least` or is above DENSEST, and all that `rounds` times. e is believed where it is
    denser by `least` than soft tissue, as no bone is, and what the X-rays and the result differ by, noise left out, is
    at most LEFT times that without it, or less than EXPLAINED, and where views from two directions or more show it, as
    they do not show a bad pixel of one: in its shadow they read more than the result without it has, and miss the one
    with it by less than SEEN times as much. From one direction no metal is sought.

    Args:
        least_ml: where less lies at the window's upper end, no metal is estimated
        most_ml: nor where more does
        least_views: nor of fewer X-rays in display values, whose gain and offset are unknown: in two that do not fit
            each other, a small dense object explains what heel effect, scatter and wrong poses leave; of three training
            CTs without metal seven of nine such pairs had some
        least: HU; of training CTs without metal 1100 are found at a shoulder, of pieces of 3000 HU 2700
        rounds: of search and method
        restarts: of conjugate gradients
        iterations: of each restart
    """

    least_ml: float = CEILING_ML[0]
    most_ml: float = CEILING_ML[1]
    least_views: int = 3
    least: float = 2000.0
    rounds: int = 2
    restarts: int = 8
    iterations: int = 10

    def __post_init__(self):
        if not 0 < self.least_ml <= self.most_ml:
            raise ValueError("metal is sought where the window's upper end holds between least_ml and most_ml, 0 < "
                             f"least_ml <= most_ml, but {self.least_ml} and {self.most_ml} were given")
        check_fields(self, "Metal", least_views=(1, math.inf), rounds=(1, math.inf), restarts=(1, math.inf),
                     iterations=(1, math.inf))


NOISE, X0_STD, TV_WEIGHT, TV_EPS = 0.02, 0.3, 5.0, 0.003
"""Of z, as the likelihood steps of phydict_learned have them."""

SOFT = 40.0
"""HU."""

FREE, SHARE = 2, 0.25

LEFT, EXPLAINED = 0.94, 1e-3
"""Shares of the X-rays' shared misfit without metal, and of the X-rays themselves. Of 10^4 photons per pixel of
training CTs without metal, 5 to 30 ml of 2600 to 3400 HU leave 1.01 to 1.03 times the shared misfit, where a view is
turned over or another's 0.95 to 1.00; rods of 2 to 15 ml leave 0.6 to 0.93."""

SEEN = 0.9
"""The share of what a view misses in the shadow of metal that may be left with it for the view to show it: of true
metal 0.1 to 0.6 is in each view, of a bad pixel 0.4 to 4 in the views without, where the result had too much."""

DENSEST = 40_000.0
"""HU above which nothing is believed: about those of steel at 65 keV, on finer voxels than any here."""

PROMISING = 0.75
"""The share of the density to be reached at which the method runs again: of rods put into training CTs, of 3000 HU and
more, 2200 HU and more were found at first, of shoulders without metal 1300 at most; the second round adds a tenth."""

BOLDNESS = 10.0
"""How many times further than its own column of B allows each voxel of e is moved at first: z, which total variation
holds back, would else take what is sharp along the rays before e does."""


def with_metal(measurement: Measurement, metal: Metal | None, first: Callable[[], Tensor],
               again: Callable[[], Tensor]) -> Tensor:
    """The states of `first`; where metal is found beside their first CT, those of `again`, run with it as
    `measurement.carried`."""
    z = first()
    if metal is None or measurement.carried is not None or measurement.window.high < BONE:
        return z
    beam, centre = measurement.projector.beam, measurement.projector.grid.centre
    if directions(beam, centre) < 2 or (measurement.display is not None and beam.views < metal.least_views):
        return z
    dense = z[:1, :1] >= CEILING
    if not metal.least_ml <= millilitres(dense, measurement.projector.grid) <= metal.most_ml:
        return z
    plain, missed, where = measurement.fitted, measurement.shared_misfit(z[:, :1]), grown(dense)
    states, errors = z, last_errors(measurement)
    for _ in range(metal.rounds):
        carried = beside(measurement, states[:1, :1], where, metal)
        if not PROMISING * metal.least <= carried.density <= DENSEST:  # not a number where nothing is left
            break
        measurement.carry(carried)
        states = again()
        where = where | grown(states[:1, :1] >= CEILING)
    else:
        left = measurement.shared_misfit(states[:, :1])
        seen = shown_by(measurement.beside, errors, last_errors(measurement))
        if carried.density >= metal.least and left < max(LEFT * missed, EXPLAINED) and seen and directions(
                beam.select(seen), centre) > 1:
            return states
    measurement.carry(None)
    measurement.fitted = plain
    return z


def last_errors(measurement: Measurement) -> Tensor:
    """What the CT that was projected last misses of each pixel (K, V, U)."""
    assert measurement.last_projection is not None
    return (measurement.last_projection - measurement.y)[0]


def shown_by(metal: Tensor | float, without: Tensor, with_it: Tensor) -> list[int]:
    """The views in which the metal is seen.

    metal: its line integrals (K, V, U). without, with_it: projected minus measured ones without and with it, alike.
    """
    before, after = ((metal * errors.square()).sum((1, 2)).sqrt() for errors in (without, with_it))
    too_little = (metal * without).sum((1, 2)) < 0
    return (too_little & (after < SEEN * before)).nonzero().flatten().tolist()


def beside(measurement: Measurement, x: Tensor, where: Tensor, metal: Metal) -> Carried:
    """What lies beside a CT x (1, 1, X, Y, Z) in the voxels `where`, as `Metal` says."""
    measurement.carry(None)
    measurement.subgrid = 0.0
    box = tuple(slice(int(i.min()), int(i.max()) + 1) for i in where[0, 0].nonzero(as_tuple=True))
    projector = measurement.projector
    B = FinerProjector(Projector(part(projector.grid, box), replace(projector.beam, continued=False), device=x.device,
                                 full_detector=True), RAYS)
    allowed = interpolate(where[:, :, *box].to(x), scale_factor=RAYS) > 0
    x = torch.where(where, float(measurement.window.to_range(torch.tensor(SOFT))), x)
    z, e, slope = x, torch.zeros_like(allowed, dtype=x.dtype), measurement.slope
    weight, tv_scale = (NOISE / X0_STD) ** 2, NOISE**2 * TV_WEIGHT
    columns = slope**2 * max(B.grid.spacing) * B.T(torch.ones_like(measurement.y)) + 1e-6
    for restart in range(metal.restarts):
        if restart >= FREE:
            allowed = e > SHARE * e.max()
            e = e * allowed
        residual = measurement.y - measurement.project(z) - slope * B(e)
        tv = TVQuadraticMajorizer(z, TV_EPS, measurement.scales)
        down = measurement.adjoint(residual) + weight * (x - z) - tv_scale * tv.gradient(z)
        rise = slope * B.T(residual)

        def normal(d: Tensor, tv=tv) -> Tensor:
            dz, de = apart(d, z, e)
            fitted = measurement.linear(dz) + slope * B(de)
            return together(measurement.adjoint(fitted) + weight * dz + tv_scale * tv.gradient(dz),
                            slope * B.T(fitted))

        scale = together(1 / (weight + tv_scale * tv.diagonal()), BOLDNESS / columns) * together(
            may_follow(z, down, -1, 1), allowed & may_follow(e, rise, 0, math.inf))
        dz, de = apart(conjugate_gradients(normal, together(down, rise) * (scale > 0), metal.iterations,
                                           preconditioner=scale), z, e)
        z, e = (z + dz).clamp(-1, 1), (e + de).clamp(min=0)
    return Carried(measurement.window.half_width * e[0, 0], B.grid, measurement.mu_water)


def together(z: Tensor, e: Tensor) -> Tensor:
    """Two volumes as one row (1, N)."""
    return torch.cat([z.flatten(), e.flatten()])[None]


def apart(row: Tensor, z: Tensor, e: Tensor) -> tuple[Tensor, Tensor]:
    """What `together` joined, of the shapes of z and e."""
    return row[0, :z.numel()].view_as(z), row[0, z.numel():].view_as(e)


def grown(mask: Tensor) -> Tensor:
    """A mask (1, 1, X, Y, Z) with the neighbours of its voxels."""
    return max_pool3d(mask.float(), 3, 1, 1) > 0


def carried_note(carried: Carried, window: HUWindow) -> str:
    """What was carried, where, and what that leaves wrong."""
    place = ", ".join(f"{mm:.0f}" for mm in carried.centre)
    return (f"{carried.millilitres:.1f} ml as dense as metal were found, about {carried.density:.0f} HU above what "
            f"surrounds them, around ({place}) mm: as far as the volume that is kept reaches, it holds them beside "
            f"what the method knows, up to {window.high:g} HU, and where the place is outside of it or of the patient, "
            "the geometry is doubtful; beam hardening and scatter of metal are not corrected, and intervals do not "
            "hold there")
