"""Training of rivals on the draws and X-rays that the refiner learns from."""

from __future__ import annotations

import math
from abc import abstractmethod
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from phydict.grid import Cube, Grid
from phydict.rivals import LiftedNetwork, Rival, RivalAnswer, load_rival
from phydict.rivals.rival import bound_orbit
from phydict.runtime.ranges import LEAST, check_between, check_fields
from phydict.training.scenes import Scenes
from phydict.training.scores import log_error, log_scores
from phydict.training.settings import Optimisation, RefinerValidation
from phydict.training.stage import StageTraining, check_network
from phydict.units import MU_WATER, HUWindow
from phydict.xray import ConeBeam


class RivalTraining(StageTraining):
    """Learns a rival from CTs and X-rays of drawn scenes.

    made: the rival to train; scenes: its X-rays; views: numbers of X-rays from which validation reconstructs; initial:
    a rival's file to continue from, one that is not bound to a geometry also of another grid, one that is also of
    another geometry, whose weights then learn this one; seed: of scenes, noise and whatever else is drawn; given:
    whether made's network was requested, which that in `initial` must then equal.
    """

    prior: Rival

    def __init__(self, made: Rival, scenes: Scenes, views: tuple[int, ...], optimisation: Optimisation,
                 initial: str | None, seed: int, given: bool):
        rival = made if initial is None else load_rival(initial)
        before = rival.budget
        bound = ("grid",) if made.network.bound else ()
        for part in ("stage", "hu_window", *bound):
            if rival.describe()[part] != made.describe()[part]:
                raise ValueError(f"the rival {initial} and this training differ in '{part}': give another "
                                 "model.initial, or the settings that it was trained with")
        if given:
            check_network("rival", str(initial), rival.network.settings, made.network.settings)
        rival = Rival(rival.network, made.grid, made.window, made.beam)
        super().__init__(rival.train().requires_grad_(True), optimisation, seed, initial)
        self.before = before
        self.scenes, self.validation_views = scenes, views

    @abstractmethod
    def case_loss(self, ct: Tensor, water: Tensor, beam: ConeBeam, generator: torch.Generator) -> Tensor:
        """The loss of one CT (1, 1, X, Y, Z) in [-1, 1] and its X-rays (1, K, V, U) in mm of water."""

    def batch_loss(self, batch: dict, key: tuple[int, ...] = (0,), rank: int = 0, processes: int = 1) -> Tensor:
        losses = []
        for case, rng in self.drawn(batch, key, rank, processes):
            ct = case["volume"]
            measurement = self.scenes.measure(ct, rng, self.prior.grid, self.prior.window, case.get("fine"))
            generator = torch.Generator().manual_seed(int(rng.integers(2**31)))
            losses.append(self.case_loss(ct, measurement.y / MU_WATER, measurement.projector.beam, generator))
        return torch.stack(losses).mean()

    def validation_step(self, batch: dict, index: int) -> None:
        log_scores(self, batch, index, self.validation_views, RivalAnswer(self.prior), self.prior.beam)


class LiftedTraining(RivalTraining):
    """Learns a LiftedNetwork by the refiner's loss of the CT.

    Args:
        network: the network; none given: that of initial, else the default LiftedNetwork
        scenes: the X-rays that are drawn for it
        cube: of voxels
        window: HU that the range [-1, 1] stands for
        optimisation: how the weights are learnt
        validation: what validation measures
        body_weight: how many times more a voxel of the body counts than one of air, plus 1
        initial: a rival's file to continue from
        seed: of scenes and noise
    """

    def __init__(self, network: LiftedNetwork | None = None, scenes: Scenes = Scenes(), cube: Cube = Cube(),
                 window: tuple[float, float] = (-1000.0, 1000.0), optimisation: Optimisation = Optimisation(),
                 validation: RefinerValidation = RefinerValidation(), body_weight: float = 2.0,
                 initial: str | None = None, seed: int = 0):
        check_between("model.body_weight", body_weight, 0, math.inf)
        made = Rival(network or LiftedNetwork(), cube.grid(), HUWindow(*window))
        super().__init__(made, scenes, validation.views, optimisation, initial, seed, network is not None)
        self.body_weight = body_weight

    def case_loss(self, ct: Tensor, water: Tensor, beam: ConeBeam, generator: torch.Generator) -> Tensor:
        return log_error(self.prior(water, beam), ct, self.body_weight)


@dataclass(frozen=True)
class OrbitScenes(Scenes):
    """Scenes of one geometry, the benchmarks' orbit from angle 0; the settings of its geometry mean nothing.

    Args:
        views: X-rays
        arc_degrees: that the views are spread over, view k at arc k / views; 180 puts two views at right angles
    """

    views: int = 8
    arc_degrees: float = 360.0

    def __post_init__(self):
        super().__post_init__()
        check_fields(self, "model.scenes", views=(1, 1000), arc_degrees=(LEAST, 360))

    def beam(self, rng: np.random.Generator, grid: Grid) -> ConeBeam:
        return bound_orbit(grid, self.views, self.arc_degrees)
