"""Training what corrects a refined estimate on finer voxels."""

from __future__ import annotations

import math

from torch import Tensor

from phydict.grid import Cube
from phydict.prior import load_correction
from phydict.prior.correction import CorrectionNetwork
from phydict.runtime.ranges import check_between
from phydict.training.settings import Optimisation
from phydict.training.stage import StageTraining, check_continues
from phydict.units import HUWindow


class RefinementTraining(StageTraining):
    """Learns a CorrectionNetwork from crops of stored reconstructions: the squared and the absolute error of its
    estimate, over those of the whole reconstruction, which weighs a dB alike at all numbers of views. No likelihood
    step follows in training. What was known of its errors is forgotten.

    Args:
        channels: width of each level of the network, the first at half the resolution
        cube: of the fine voxels
        window: HU that the prior's range [-1, 1] stands for
        optimisation: how the weights are learnt
        body_weight: how many times more a voxel of the body counts than one of air, plus 1
        initial: a network's file to continue from, of these voxels or twice as long ones, which then decides its size
    """

    prior: CorrectionNetwork

    def __init__(self, channels: tuple[int, ...] = (32, 64, 96), cube: Cube = Cube(128),
                 window: tuple[float, float] = (-1000.0, 1000.0), optimisation: Optimisation = Optimisation(),
                 body_weight: float = 2.0, initial: str | None = None):
        check_between("model.body_weight", body_weight, 0, math.inf)
        hu = HUWindow(*window)
        network = load_correction(initial) if initial else CorrectionNetwork(channels, 16, cube.grid(), hu)
        if not network.suits(cube.grid(), hu):
            check_continues("network", str(initial), network, cube.grid(), hu)
        network.grid = cube.grid()
        network.uncertainty = None  # of the errors of other weights
        super().__init__(network.train().requires_grad_(True), optimisation, 0, initial)
        self.body_weight = body_weight

    def batch_loss(self, batch: dict, key: tuple[int, ...] = (0,), rank: int = 0, processes: int = 1) -> Tensor:
        truth = batch["volume"][:, -1:]
        error = (self.prior(batch["volume"][:, :-1]).float() - truth) * (1 + self.body_weight * (truth > -0.9)).sqrt()
        squared, absolute = batch["scale"].clamp(min=1e-6).T
        each = error.square().mean((1, 2, 3, 4)) / squared + error.abs().mean((1, 2, 3, 4)) / absolute
        return each.mean()

    def validation_step(self, batch: dict, index: int) -> None:
        truth, inputs = batch["volume"][:, -1:], batch["volume"][:, :-1]
        for name, x0 in (("psnr", self.prior(inputs).clamp(-1, 1)), ("psnr_before", inputs[:, :1])):
            psnr = 10 * (4 / (x0.float() - truth).square().mean()).log10()  # the range is 2 wide
            self.log_case(index, f"val/{name}", psnr, prog_bar=name == "psnr")
        self.log("samples", float(self.samples), rank_zero_only=True, batch_size=1)
