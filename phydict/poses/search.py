"""Poses and gains of the views, found by turns with a volume that does not mistake them for anatomy.

Each round, at the current unknowns theta and volume x:

1. C = what each unknown of the poses changes in the projections of x, per standard deviation
   (phydict.xray.poses.sensitivity);
2. x <- towards argmin |F (y - P(x))|^2 / noise^2 + 2 tv_weight TV(x), where F leaves out what C explains
   (phydict.poses.blind), so that x does not take on what belongs to the poses;
3. theta <- one Gauss-Newton step per view on y - P(x), with Huber's weights and the stated standard deviations, gains
   and offsets included. The mean gain stays 1, since a denser volume would explain another.

Steps 2 and 3 together approach a Gauss-Newton step in volume and poses (variable projection, Golub & Pereyra 1973,
doi:10.1137/0710036). The whole scene moved changes no projection (phydict.xray.poses.gauge), so that six numbers are
chosen: at the end the beam is carried to where its shadows are most like the nominal beam's. A detector that comes to
lie in an empty corner of the volume's box is drawn back along its rays, which changes no projection either.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import interpolate

from phydict.baselines.baseline import typical_chest
from phydict.grid import Grid
from phydict.poses.blind import BlindMeasurement
from phydict.poses.found import FoundPoses
from phydict.posterior.likelihood.likelihood import ProximalCG
from phydict.posterior.measurement import Measurement
from phydict.runtime.profiling import Stopwatch
from phydict.units import MU_WATER, HUWindow
from phydict.xray import ConeBeam, Projector, binned, binning
from phydict.xray.boxes import halved
from phydict.xray.calibration import match_views
from phydict.xray.checks import check_xrays
from phydict.xray.noise_level import MEDIAN
from phydict.xray.poses.gauge import aligned, drawn_back, obstructed, reprojection_errors
from phydict.xray.poses.sensitivity import pose_derivatives
from phydict.xray.poses.uncertain import Uncertain
from phydict.xray.poses.unknowns import moved
from phydict.xray.residuals import misfits

WINDOW = HUWindow()
DISPLAY_STD = 0.3
"""Standard deviation of gain and offset of display values, once they are matched to a typical chest."""
X0_STD = 5.0
"""Standard deviation, in the window's range, of the error of a round's volume: the next one is free to leave it."""
MOST_VOXELS = 96
"""Sides of the finest grid on which poses are searched; a finer one's is halved."""
SAME_FIT, LEAST_FIT, MOST_FIT = 6.5, 1.05, 1.4
"""The nominal poses of K views are kept where their misfit is at most 1 + SAME_FIT / K^2 times that of the poses found,
no less than LEAST_FIT and no more than MOST_FIT times: fewer views are the easier to fit by poses. Right ones of seven
training CTs have 1.08 at most from eight views and 1.38 from four, those off by 5 mm and 2 degrees 2.9 or more."""
HALVINGS = 6
"""Of a view's step that would put its source into the volume or its detector before the volume's middle."""


@dataclass(frozen=True)
class PoseSearch:
    """How poses are searched.

    Args:
        coarse: rounds on a grid of half as many voxels along each side
        fine: rounds on the reconstruction's grid
        likelihood: the step of the volume towards the X-rays in each round
        first: that step before the first round
        huber: residuals beyond so many of a view's standard deviations count less
    """

    coarse: int = 8
    fine: int = 7
    likelihood: ProximalCG = ProximalCG(iterations=10, restarts=2, tv_weight=10.0, tv_eps=0.003)
    first: ProximalCG = ProximalCG(iterations=10, restarts=4, tv_weight=10.0, tv_eps=0.003)
    huber: float = 3.0

    def __post_init__(self):
        if self.coarse < 0 or self.fine < 0 or self.coarse + self.fine < 1:
            raise ValueError(f"a search needs one round or more, but coarse={self.coarse} and fine={self.fine} were "
                             "given")

    @property
    def rounds(self) -> int:
        return self.coarse + self.fine


@torch.inference_mode(False)  # in which every derivative by a pose would be 0
@torch.no_grad()
def find_poses(xrays: Tensor, beam: ConeBeam, uncertain: Uncertain, grid: Grid, display: bool = False,
               mu_water: float = MU_WATER, search: PoseSearch = PoseSearch(),
               on_round: Callable[[], None] = lambda: None) -> FoundPoses:
    """Poses and gains of X-rays (K, V, U) whose nominal geometry is `beam`.

    display: display values, whose gains and offsets are found too, from those that a typical chest would have on.
    grid: of the reconstruction. on_round: called after each of the search's rounds. Computed on the CPU. Raises
    ValueError where the data cannot hold the unknowns, and where neither density nor size has a scale.
    """
    check_xrays(xrays, beam)
    if not xrays.any():
        raise ValueError("poses are found by what X-rays show, but these are 0 in every pixel: give others, or leave "
                         "out `uncertain`")
    beam.check(grid)
    if display:
        uncertain.check_scale(beam)
        uncertain = replace(uncertain, gain=max(uncertain.gain, DISPLAY_STD), offset=max(uncertain.offset, DISPLAY_STD))
    uncertain.check(beam.views, xrays[0].numel())
    while max(grid.shape) > MOST_VOXELS:
        grid = halved(grid)
    watch, deviations, coarse = Stopwatch(), uncertain.deviations, halved(grid)
    with watch.stage("calibrate"):
        xrays = xrays.float().cpu()
        if display:
            chest = Projector(coarse, beam.binned(binning(coarse, beam)), full_detector=True)
            xrays = match_views(xrays[None], mu_water * chest(typical_chest(chest)))[0]
        state = State(torch.zeros(beam.views, 10), torch.zeros(beam.views, 10))
        levels = [level for level in ((coarse, search.coarse), (grid, search.fine)) if level[1]]
        for n, (level, rounds) in enumerate(levels):
            views = Views(xrays, beam, level, torch.as_tensor(deviations).float(), mu_water, search)
            views.begin(state)
            for _ in range(rounds):
                views.improve(state)
                on_round()
            if n == 0:
                first, volume, sway = views, state.x, views.sway(state).double().numpy()
            if first.fits_as_stated(replace(state, x=volume), same_fit(beam.views) if n == 0 else 1.0):
                state.theta, state.misfits = torch.zeros_like(state.theta), state.misfits[:1]
                break
        there, points = moved(beam, pose_unknowns(state.theta)), middle_points(grid)
        if state.theta[:, :8].any():
            there = carried(there, beam, points, grid)
        shift = np.stack([reprojection_errors(there, beam, points), stated_shift(beam, uncertain, points)])
    return FoundPoses(drawn_back(there, grid), deviations, state.theta.double().numpy(), state.errors.double().numpy(),
                      (state.misfits[0], state.misfits[-1]), sway, shift, watch.seconds["calibrate"], display)


def pose_unknowns(theta: Tensor) -> np.ndarray:
    """Those of all unknowns (K, 10) that `moved` takes, (K, 8) float64: the rest are gains and offsets."""
    return theta[:, :8].double().numpy()


def carried(beam: ConeBeam, nominal: ConeBeam, points: np.ndarray, grid: Grid) -> ConeBeam:
    """The beam carried as a whole to where its points' shadows are most like the nominal beam's, or, where that would
    put a source into the volume, as it is."""
    there = aligned(beam, nominal, points)
    return beam if obstructed(there, grid).any() else there


def same_fit(views: int) -> float:
    """How many times the misfit of the poses found those of the nominal ones may be to be kept."""
    return min(max(1 + SAME_FIT / views**2, LEAST_FIT), MOST_FIT)


def stated_shift(beam: ConeBeam, uncertain: Uncertain, points: np.ndarray) -> np.ndarray:
    """Root mean square distance (K,) in mm on the detector by which points' shadows shift where each unknown of a pose
    is off by its standard deviation."""
    each = [reprojection_errors(moved(beam, np.tile(unknown, (beam.views, 1))), beam, points)
            for unknown in np.diag(uncertain.poses)]
    return np.sqrt(np.square(each).sum(0))


def middle_points(grid: Grid) -> np.ndarray:
    """125 points (N, 3) over the middle of a grid, where a body is."""
    shares = np.stack(np.meshgrid(*[np.linspace(-0.3, 0.3, 5)] * 3, indexing="ij"), -1).reshape(-1, 3)
    return grid.centre + (shares * grid.shape) @ grid.affine[:3, :3].T


@dataclass
class State:
    """What a search has found so far: unknowns (K, 10), their standard errors, the volume, the misfit of each round."""

    theta: Tensor
    errors: Tensor
    x: Tensor = None  # type: ignore[assignment]  # known once the first views begin
    misfits: list[float] = field(default_factory=list)


class Views:
    """X-rays (K, V, U) and their nominal beam on one grid, and what a round of the search does with them."""

    def __init__(self, xrays: Tensor, beam: ConeBeam, grid: Grid, deviations: Tensor, mu_water: float,
                 search: PoseSearch):
        factor = binning(grid, beam)
        self.xrays, self.beam, self.grid = binned(xrays, factor), beam.binned(factor), grid
        self.deviations, self.mu_water, self.search = deviations, mu_water, search

    def measurement(self, theta: Tensor) -> Measurement:
        """The X-rays without their gains and offsets, seen from the poses."""
        poses = drawn_back(moved(self.beam, pose_unknowns(theta)), self.grid)
        corrected = (self.xrays - theta[:, 9, None, None]) / (1 + theta[:, 8, None, None])
        measurement = Measurement(Projector(self.grid, poses, full_detector=True), corrected, WINDOW, True,
                                  self.mu_water)
        measurement.display = None  # their gains are unknowns here
        return measurement

    def begin(self, state: State) -> None:
        """The volume on this grid: the coarser one's, or one that the X-rays give as they are."""
        if state.x is not None:
            state.x = interpolate(state.x, size=self.grid.shape, mode="trilinear")
            return
        plain = self.measurement(state.theta)
        state.x = self.search.first(plain, torch.full((1, 1, *self.grid.shape), -1.0), X0_STD)
        state.misfits.append(misfits(plain.project(state.x)[0], plain.y[0])["misfit"])

    def fits_as_stated(self, state: State, allowed: float) -> bool:
        """Whether a volume of the nominal poses has at most `allowed` times the misfit of one of those found."""
        fits = []
        for theta in (torch.zeros_like(state.theta), state.theta):
            plain = self.measurement(theta)
            fits.append(misfits(plain.project(self.search.first(plain, state.x, X0_STD))[0], plain.y[0])["misfit"])
        return fits[0] <= allowed * fits[1]

    def improve(self, state: State) -> None:
        """One round."""
        plain, noise = self.measurement(state.theta), self.search.likelihood.noise
        changes, before = self.changes(state), state.theta / self.deviations.clamp(min=1e-12)
        blind = BlindMeasurement(plain, changes[:, :8], before[:, :8], noise)
        state.x = self.search.likelihood(blind, state.x, X0_STD)
        reprojection = plain.project(state.x)[0]
        state.misfits.append(misfits(reprojection, plain.y[0])["misfit"])
        residual = plain.y[0] - reprojection
        level = (residual.abs().flatten(1).median(1).values / MEDIAN).clamp(min=1e-6)[:, None, None]
        weights = (self.search.huber * level / residual.abs().clamp(min=1e-12)).clamp(max=1)
        data = torch.einsum("kmvu,kvu,knvu->kmn", changes, weights, changes)
        right = torch.einsum("kmvu,kvu->km", changes, weights * residual) / noise**2 - before
        identity = torch.eye(data.shape[-1])
        step = torch.linalg.solve(data / noise**2 + identity, right[..., None])[..., 0] * self.deviations
        state.theta = state.theta + self.clear(state.theta, step)
        state.theta[:, 8] -= state.theta[:, 8].mean()
        covariance = torch.linalg.inv(data / level**2 + identity)
        state.errors = covariance.diagonal(dim1=-2, dim2=-1).sqrt() * self.deviations

    def changes(self, state: State) -> Tensor:
        """What a standard deviation of each unknown changes in the corrected X-rays: (K, 10, V, U)."""
        mu = WINDOW.to_mu(state.x[0, 0], self.mu_water)
        integrals, derivatives = pose_derivatives(mu, self.grid, self.beam, pose_unknowns(state.theta))
        ones = torch.ones_like(integrals) / (1 + state.theta[:, 8, None, None])
        changes = torch.cat([derivatives, torch.stack([integrals / (1 + state.theta[:, 8, None, None]), ones], 1)], 1)
        return changes * self.deviations[:, None, None]

    def sway(self, state: State) -> Tensor:
        """How far each view shows the lower end of the body moved against the upper one, in mm on the detector, and the
        standard error of that: (2, K).

        Fitted to what is left of the X-rays, together with what the unknowns change. The volume is a compromise of all
        views, so that it has taken its part of a real movement.
        """
        plain = self.measurement(state.theta)
        residual = plain.y[0] - plain.project(state.x)[0]
        mu = WINDOW.to_mu(state.x[0, 0], self.mu_water)
        derivatives = pose_derivatives(mu, self.grid, self.beam, pose_unknowns(state.theta))[1]
        ramp = torch.linspace(-0.5, 0.5, residual.shape[1])[:, None]
        changes, swayed = self.changes(state), derivatives[:, 1:2] * ramp
        if not swayed.any():  # a volume of air
            return torch.zeros(2, len(residual))
        columns = torch.cat([changes[:, changes.abs().amax((0, 2, 3)) > 0], swayed], 1).flatten(2)
        covariance = torch.linalg.inv(columns @ columns.transpose(1, 2))
        fitted = (covariance @ (columns @ residual.flatten(1)[..., None]))[..., 0]
        left = residual.flatten(1) - torch.einsum("km,kmp->kp", fitted, columns)
        return torch.stack([fitted[:, -1], covariance[:, -1, -1].sqrt() * left.std(1)])

    def clear(self, theta: Tensor, step: Tensor) -> Tensor:
        """The step, shortened for the views that it would obstruct."""
        step = step.clone()
        for _ in range(HALVINGS):
            wrong = torch.as_tensor(obstructed(moved(self.beam, pose_unknowns(theta + step)), self.grid))
            step[wrong] /= 2
            if not wrong.any():
                break
        else:
            step[wrong] = 0
        return step
