"""Training what says how far a refiner's reconstruction may be off."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from phydict.grid import Cube
from phydict.posterior import Measurement, Unrolled
from phydict.posterior.widening import limited_angle_factor
from phydict.prior import DEFAULT_REFINER, Refiner, load_prior
from phydict.prior.uncertainty import AIR_BELOW, Uncertainty, coverage_of, tissue_of
from phydict.runtime.ranges import check_between
from phydict.training.calibrated import CalibratedTraining
from phydict.training.scenes import Scenes
from phydict.training.settings import CalibrationScenes, Optimisation
from phydict.training.stage import check_continues
from phydict.units import HUWindow

VOXELS = 20_000
"""Voxels of a reconstruction that calibrate."""


class UncertaintyTraining(CalibratedTraining):
    """Learns the Uncertainty of a refiner, whose own weights stay as they are; each validation calibrates it.

    Training teaches the scale of each voxel's error; validation sets the quantiles of error over scale that make
    intervals of it, from patients who are not trained on.

    Args:
        network: what is learnt; none given: the initial refiner's, or the default Uncertainty
        method: the unrolled reconstruction whose errors are learnt
        scenes: the X-rays that are drawn for it
        cube: of voxels
        window: HU that the prior's range [-1, 1] stands for
        optimisation: how the weights are learnt
        validation: the scenes of each held-out case
        body_weight: how many times more a voxel of the body counts than one of air, plus 1
        initial: the refiner's file
        seed: of scenes and noise
    """

    def __init__(self, network: Uncertainty | None = None, method: Unrolled = Unrolled(), scenes: Scenes = Scenes(),
                 cube: Cube = Cube(), window: tuple[float, float] = (-1000.0, 1000.0),
                 optimisation: Optimisation = Optimisation(), validation: CalibrationScenes = CalibrationScenes(),
                 body_weight: float = 9.0, initial: str = str(DEFAULT_REFINER), seed: int = 0):
        check_between("model.body_weight", body_weight, 0, math.inf)
        refiner = load_prior(initial)
        if not isinstance(refiner, Refiner):
            raise ValueError(f"uncertainty is learnt of a refiner, but {initial} is none: give a refiner's file as "
                             "model.initial")
        check_continues("refiner", initial, refiner, cube.grid(), HUWindow(*window))
        refiner.uncertainty = network or refiner.uncertainty or Uncertainty(refiner.state_channels)
        super().__init__(refiner, optimisation, seed, initial, body_weight)
        refiner.reader.ready_text()  # to be written with the rest
        refiner.uncertainty.requires_grad_(True)
        self.method, self.scenes, self.validation = method, scenes, validation

    def batch_loss(self, batch: dict, key: tuple[int, ...] = (0,), rank: int = 0, processes: int = 1) -> Tensor:
        losses = []
        for case, rng in self.drawn(batch, key, rank, processes):
            ct = case["volume"]
            z, evidence, measurement = self._reconstruct(case, rng)
            log_scale = self._log_scale(z, evidence, measurement)
            losses.append(self.error_loss(log_scale, (z[:, :1] - ct).abs(), _body(ct, z)))
        return torch.stack(losses).mean()

    @torch.no_grad()
    def _reconstruct(self, case: dict, rng: np.random.Generator) -> tuple[Tensor, Tensor, Measurement]:
        """The last state of a reconstruction, the evidence there, and its measurement."""
        with torch.autocast(self.device.type, enabled=False):
            measurement = self.scenes.measure(case["volume"], rng, self.prior.grid, self.prior.window,
                                              case.get("fine"))
            ends = []
            for _ in self.method.estimates(self.prior.bind(), measurement, on_result=lambda *end: ends.append(end)):
                pass
            [(z, evidence)] = ends
            return z, evidence(), measurement

    def _log_scale(self, z: Tensor, evidence: Tensor, measurement: Measurement) -> Tensor:
        """What the network says of the log of the errors' scale, and what is known of the scene's angles."""
        return self.prior.uncertainty(z, evidence) + math.log(limited_angle_factor(measurement.projector))

    def validation_step(self, batch: dict, index: int) -> None:
        ct, scenes = batch["volume"], []
        for scene in range(self.validation.scenes):
            rng = np.random.default_rng((self.seed, self.validation_number(index), scene))
            z, evidence, measurement = self._reconstruct(batch, rng)
            error, log_scale = (z[:, :1] - ct).abs(), self._log_scale(z, evidence, measurement)
            self.log_rank(index, log_scale, error, _body(ct, z))
            chosen = torch.from_numpy(rng.integers(error.numel(), size=VOXELS)).to(ct.device)
            scenes.append((
                (error / log_scale.exp()).flatten()[chosen], tissue_of(z).flatten()[chosen],
                coverage_of(evidence).flatten()[chosen],
                measurement.normalised_residual(z[:, :1], modelled=True).flatten()))
        self.hold_out(*map(torch.cat, zip(*scenes)))


def _body(ct: Tensor, z: Tensor) -> Tensor:
    """Which voxels (B, 1, X, Y, Z) are no air outside: those of tissue in the CT, and of lung in the state z."""
    return (ct > AIR_BELOW) | (tissue_of(z)[:, None] == 0)
