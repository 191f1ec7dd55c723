"""Training of X2CT-GAN's generator against its discriminator."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import cast

import torch
from lightning.pytorch.utilities.types import OptimizerLRSchedulerConfig
from torch import Tensor
from torch.func import functional_call
from torch.nn.functional import l1_loss, mse_loss

from phydict.grid import Cube
from phydict.rivals import PatchDiscriminator, Rival, X2CTNetwork
from phydict.rivals.rival import WATER_MM, bound_orbit
from phydict.runtime.ranges import check_between, check_fields
from phydict.training.rivals import OrbitScenes, RivalTraining
from phydict.training.settings import Optimisation
from phydict.units import HUWindow
from phydict.xray import ConeBeam

BETAS = 0.5, 0.99
"""Of Adam, as published."""


@dataclass(frozen=True)
class Adversary:
    """The losses of the generator, with the published weights, and its discriminator.

    Args:
        adversarial: weight of the least-squares GAN's loss
        reconstruction: weight of the voxels' mean squared error
        projection: weight of the mean absolute error of the volume's means along its axes
        width: channels of the discriminator's first layer
        layers: of the discriminator that halve the size
    """

    adversarial: float = 0.1
    reconstruction: float = 10.0
    projection: float = 10.0
    width: int = 16
    layers: int = 2

    def __post_init__(self):
        check_fields(self, "model.adversary", adversarial=(0, math.inf), reconstruction=(0, math.inf),
                     projection=(0, math.inf), width=(1, math.inf), layers=(1, math.inf))


class X2CTTraining(RivalTraining):
    """Learns an X2CTNetwork: least-squares GAN, squared error and projections (Ying et al. 2019, Eqs. 1 to 4).

    Generator and discriminator take their step at once, each against the other's weights before it.

    Args:
        network: the generator; none given: that of initial, else the default X2CTNetwork
        scenes: the X-rays, of one geometry
        cube: of voxels
        window: HU that the range [-1, 1] stands for, whose volumes the losses see in [0, 1]
        optimisation: how the weights are learnt, by Adam with betas of 0.5 and 0.99
        adversary: the losses and the discriminator
        initial: a rival's file to continue from, with a new discriminator
        seed: of noise and dropout
    """

    def __init__(self, network: X2CTNetwork | None = None, scenes: OrbitScenes = OrbitScenes(), cube: Cube = Cube(),
                 window: tuple[float, float] = (-1000.0, 1000.0),
                 optimisation: Optimisation = Optimisation(2e-4, 0.0, 0), adversary: Adversary = Adversary(),
                 initial: str | None = None, seed: int = 0):
        grid = cube.grid()
        beam = bound_orbit(grid, scenes.views, scenes.arc_degrees)
        made = Rival(network or X2CTNetwork(), grid, HUWindow(*window), beam)
        super().__init__(made, scenes, (scenes.views,), optimisation, initial, seed, network is not None)
        deepest = max(cube.voxels.bit_length() - 2, 1)  # whose patches are still of more than one voxel
        check_between("model.adversary.layers", adversary.layers, 1, deepest)
        self.discriminator = PatchDiscriminator(scenes.views, adversary.width, adversary.layers)
        self.adversary = adversary

    def configure_optimizers(self) -> OptimizerLRSchedulerConfig:
        optimizers = super().configure_optimizers()
        for group in optimizers["optimizer"].param_groups:
            group["betas"] = BETAS
        return optimizers

    def case_loss(self, ct: Tensor, water: Tensor, beam: ConeBeam, generator: torch.Generator) -> Tensor:
        y, network = water / WATER_MM, cast(X2CTNetwork, self.prior.network)
        geometry = network.geometry(self.prior.grid, beam, y)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(int(torch.randint(2**31, (1,), generator=generator)))  # of the dropout
            made, real, lifted = (network(y, *geometry) + 1) / 2, (ct + 1) / 2, network.lifted(y, *geometry)
        judged = functional_call(self.discriminator, {name: weight.detach() for name, weight in
                                                      self.discriminator.named_parameters()}, (made, lifted))
        deceived = mse_loss(judged, torch.ones_like(judged))
        projected = torch.stack([l1_loss(made.mean(axis), real.mean(axis)) for axis in (2, 3, 4)]).mean()
        weights = self.adversary
        return (weights.adversarial * deceived + weights.reconstruction * mse_loss(made, real)
                + weights.projection * projected + self._discrimination(made.detach(), real, lifted))

    def _discrimination(self, made: Tensor, real: Tensor, lifted: Tensor) -> Tensor:
        """The discriminator's loss, which no gradient of the generator's passes through."""
        one, zero = self.discriminator(real, lifted), self.discriminator(made, lifted)
        return (mse_loss(one, torch.ones_like(one)) + mse_loss(zero, torch.zeros_like(zero))) / 2
