"""Training what corrects a refined estimate on finer voxels."""

from __future__ import annotations

import torch
from torch import Tensor

from phydict.evaluation import volume_metrics
from phydict.grid import Cube
from phydict.prior import describe_correction, load_correction
from phydict.prior.correction import CorrectionNetwork
from phydict.training.refiner import log_error
from phydict.training.settings import Optimisation
from phydict.training.stage import StageTraining
from phydict.units import HUWindow


class RefinementTraining(StageTraining):
    """Learns a CorrectionNetwork from crops of stored reconstructions: the logarithms of its estimate's mean squared
    and mean absolute error. No likelihood step follows in training.

    Args:
        channels: width of each level of the network, the first at half the resolution
        cube: of the fine voxels
        window: HU that the prior's range [-1, 1] stands for
        optimisation: how the weights are learnt
        body_weight: how many times more a voxel of the body counts than one of air, plus 1
        initial: a network's file to go on from, which then decides its size
    """

    def __init__(self, channels: tuple[int, ...] = (32, 64, 96), cube: Cube = Cube(128),
                 window: tuple[float, float] = (-1000.0, 1000.0), optimisation: Optimisation = Optimisation(),
                 body_weight: float = 2.0, initial: str | None = None):
        hu = HUWindow(*window)
        network = load_correction(initial) if initial else CorrectionNetwork(channels, 16, cube.grid(), hu)
        if not network.grid.same_as(cube.grid()) or network.window != hu:
            raise ValueError(f"the network {initial} has another grid or HU window than this training: "
                             "set model.cube and model.window to its own")
        super().__init__(network.train().requires_grad_(True), optimisation, 0)
        self.body_weight = body_weight

    def batch_loss(self, batch: dict, key: tuple[int, ...] = (0,), rank: int = 0, processes: int = 1) -> Tensor:
        losses = [log_error(self.prior(case[None, :-1]).float(), case[None, -1:], self.body_weight)
                  for case in batch["volume"]]
        return torch.stack(losses).mean()

    def validation_step(self, batch: dict, index: int) -> None:
        truth, seen = batch["volume"][:, -1:], batch["volume"][:, :-1]
        found = {"psnr": self.prior(seen).clamp(-1, 1).float(), "psnr_before": seen[:, :1]}
        for name, x0 in found.items():
            score = volume_metrics(*(self.prior.window.to_hu(x) for x in (x0, truth)))["psnr"]
            self.log(f"val/{name}", score, prog_bar=True, sync_dist=True, batch_size=1)
        self.log("samples", float(self.samples), rank_zero_only=True, batch_size=1)

    def _describe(self) -> dict:
        return describe_correction(self.prior)
