"""Training what says how far a refiner's reconstruction on finer voxels may be off."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from phydict.grid import Cube
from phydict.prior import DEFAULT_CORRECTION, fingerprint, load_correction
from phydict.prior.finer_uncertainty import INPUT_CHANNELS, FinerUncertainty, tissue_of_seen
from phydict.prior.uncertainty import TISSUES
from phydict.runtime.ranges import check_between
from phydict.training.calibrated import CalibratedTraining
from phydict.training.settings import Optimisation
from phydict.training.stage import check_continues
from phydict.units import HUWindow

OUTSIDE = TISSUES.index("air")

EVERY = 7
"""Of how many voxels of a reconstruction one calibrates."""


class FinerUncertaintyTraining(CalibratedTraining):
    """Learns the FinerUncertainty of a CorrectionNetwork, whose own weights stay as they are, from crops of its
    results, as UncertaintyTraining learns a refiner's; each validation calibrates it.

    Args:
        network: what is learnt; none given: the initial network's, or the default FinerUncertainty
        cube: of the fine voxels
        window: HU that the prior's range [-1, 1] stands for
        optimisation: how the weights are learnt
        body_weight: how many times more a voxel of the body counts than one of air, plus 1
        initial: the CorrectionNetwork's file
    """

    def __init__(self, network: FinerUncertainty | None = None, cube: Cube = Cube(128),
                 window: tuple[float, float] = (-1000.0, 1000.0), optimisation: Optimisation = Optimisation(),
                 body_weight: float = 9.0, initial: str = str(DEFAULT_CORRECTION)):
        check_between("model.body_weight", body_weight, 0, math.inf)
        corrects = load_correction(initial)
        check_continues("network", initial, corrects, cube.grid(), HUWindow(*window))
        corrects.uncertainty = network or corrects.uncertainty or FinerUncertainty()
        super().__init__(corrects, optimisation, 0, initial, body_weight)
        corrects.uncertainty.train().requires_grad_(True)

    def setup(self, stage: str) -> None:
        super().setup(stage)
        made = self.trainer.datamodule.made.network  # type: ignore[attr-defined]
        if fingerprint(made) != fingerprint(str(self.initial)):
            raise ValueError(f"the results are those of {made}, but the intervals are to be those of {self.initial}: "
                             "give one file as model.initial and data.made.network")

    def batch_loss(self, batch: dict, key: tuple[int, ...] = (0,), rank: int = 0, processes: int = 1) -> Tensor:
        compared = zip(*self._compared(batch["volume"]))
        return torch.stack([self.error_loss(log_scale, error, tissue != OUTSIDE)
                            for log_scale, error, tissue in compared]).mean()

    def _compared(self, volume: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """What the network says of the log of the errors' scale, the errors, and the tissues, (B, X, Y, Z) each, of
        what is seen and the truth (B, INPUT_CHANNELS + 1, X, Y, Z)."""
        seen = volume[:, :INPUT_CHANNELS]
        error = (seen[:, 0] - volume[:, INPUT_CHANNELS]).abs()
        return self.prior.uncertainty(seen)[:, 0], error, tissue_of_seen(seen)

    def validation_step(self, batch: dict, index: int) -> None:
        log_scale, error, tissue = self._compared(batch["volume"])
        self.log_rank(index, log_scale, error, tissue != OUTSIDE)
        self.hold_out((error / log_scale.exp()).flatten()[::EVERY], tissue.flatten()[::EVERY])
