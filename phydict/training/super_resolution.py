"""Training the super-resolution stage, on crops."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor
from torch.nn.functional import avg_pool3d

from phydict.diffusion import Denoiser, noise_like
from phydict.evaluation import method_panel
from phydict.grid import Cube, Grid
from phydict.prior import LocalUNet, SuperResolution, load_super_resolution
from phydict.runtime.ranges import check_between
from phydict.training.crops import SuperResolutionData
from phydict.training.denoising import DenoisingTraining
from phydict.training.settings import Optimisation, Previews
from phydict.training.stage import check_network
from phydict.units import HUWindow

DETAIL_STD = 0.08
"""What a stage's detail_std is where training starts from none and is given no other."""


class SuperResolutionTraining(DenoisingTraining):
    """Learns a SuperResolution from crops; a crop's block means are its coarse volume.

    Args:
        network: the UNet; none given: that of initial, else the default LocalUNet
        cube: of fine voxels
        factor: fine voxels along each side of a coarse one
        window: HU that the prior's range [-1, 1] stands for
        detail_std: standard deviation, in the prior's range, of what the fine CT adds to the coarse one; none given:
            that of initial, else 0.08
        most_noise: highest level of the noise that the coarse volume is given, in [0, 1]
        optimisation: how the weights are learnt
        validation: what validation shows
        initial: a stage's file to start from, which then decides the network
        seed: of times and noise
    """

    prior: SuperResolution

    def __init__(self, network: LocalUNet | None = None, cube: Cube = Cube(256), factor: int = 4,
                 window: tuple[float, float] = (-1000.0, 1000.0), detail_std: float | None = None,
                 most_noise: float = 0.3, optimisation: Optimisation = Optimisation(),
                 validation: Previews = Previews(), initial: str | None = None, seed: int = 0):
        check_between("model.most_noise", most_noise)
        requested, detail_std = detail_std, DETAIL_STD if detail_std is None else detail_std
        check_between("model.detail_std", detail_std, 1e-3, 1000)
        stage = SuperResolution(network or LocalUNet(), cube.grid(), HUWindow(*window), factor,
                               detail_std=detail_std)
        if initial:
            first = load_super_resolution(initial)
            if (not isinstance(first, SuperResolution) or not first.grid.same_as(stage.grid)
                    or first.window != stage.window or first.factor != factor):
                raise ValueError(f"the stage {initial} has another grid, HU window or factor than this training: set "
                                 "model.cube, model.window and model.factor to its own")
            check_network("stage", initial, first.network.settings, network.settings if network else {})
            if requested not in (None, first.detail_std):
                raise ValueError(f"model.detail_std is {requested:g}, but the stage {initial} that training continues "
                                 f"from has {first.detail_std:g}: leave it out, or leave model.initial out")
            stage = first.train().requires_grad_(True)
        super().__init__(stage, stage.detail_std, optimisation, validation.preview_steps, seed, initial=initial)
        self.most_noise = most_noise

    def setup(self, stage: str) -> None:
        super().setup(stage)
        data, divisor = self.trainer.datamodule, self.prior.network.divisor  # type: ignore[attr-defined]
        if isinstance(data, SuperResolutionData) and data.crops.size % divisor:
            raise ValueError(f"data.crops.size is a multiple of {divisor}, by which the network divides, but "
                             f"{data.crops.size} was given")

    def _clean_state(self, batch: dict) -> tuple[Tensor, Tensor]:
        return batch["volume"], torch.ones(len(batch["volume"]), 1, 1, 1, 1, device=self.device)

    def _condition(self, batch: dict, x0: Tensor, generators: list[torch.Generator]) -> tuple[Tensor, ...]:
        coarse = avg_pool3d(x0, self.prior.factor)
        level = self.most_noise * torch.cat([torch.rand(1, generator=g) for g in generators]).to(self.device)
        noise = noise_like(coarse, generators)
        return self.prior.upsample(coarse + level.view(-1, 1, 1, 1, 1) * noise), level

    def _denoiser(self, batch: dict, x0: Tensor) -> Denoiser:
        return self.prior.bind(avg_pool3d(x0, self.prior.factor))

    def validation_step(self, batch: dict, index: int) -> None:
        super().validation_step(batch, index)
        x0 = batch["volume"]
        lacking = (self.prior.upsample(avg_pool3d(x0, self.prior.factor)) - x0).square().mean().sqrt()
        self.log_case(index, "val/rmse_hu_upsampled", lacking * self.prior.window.half_width)

    def _write_preview(self, file: Path, batch: dict, x0: Tensor, sample: Tensor) -> None:
        upsampled = self.prior.upsample(avg_pool3d(x0, self.prior.factor))
        (x, y, z), volumes = x0.shape[2:], {"coarse, upsampled": upsampled, "sample": sample}
        to_hu = self.prior.window.to_hu
        method_panel(file, {name: to_hu(volume[0, 0].cpu()) for name, volume in volumes.items()},
                     to_hu(x0[0, 0].cpu()), Grid((x, y, z), self.prior.grid.spacing), title="crop")
