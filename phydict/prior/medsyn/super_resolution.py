"""MedSyn's second stage as a super-resolution stage."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn.functional import interpolate

from phydict.diffusion import noise_like
from phydict.diffusion.schedule import CosineSchedule
from phydict.grid import Grid
from phydict.prior.medsyn.networks import FACTOR, STATE_CHANNELS, SuperResolutionUNet, from_slices, to_slices
from phydict.prior.medsyn.prior import WINDOW, _check_divisible, atlas_grid
from phydict.runtime.precision import network_precision
from phydict.runtime.ranges import check_between


class MedSynSuperResolution(nn.Module):
    """MedSyn's stage 2: denoises fine states (B, 4, X, Y, Z), in RAS+, that belong to given coarse ones.

    network: predicts the clean state; grid: where the fine voxels are; memory: bytes that denoising the whole grid may
    take, see `check_memory`.

    It is never run in tiles. Its group norms take mean and variance from the whole region, its attention looks at whole
    slices, and below 8-fold downsampling its convolutions reach far, so that tiles would give another result than
    MedSyn's inference, which runs on the whole; how far another, only the trained weights could tell. (MedSyn trained
    on 72 rows and columns of all slices: if any tiles, then these.)
    ends_at_zero: as for MedSynPrior, after 20 steps. default_noise: MedSyn's inference gives the coarse state none.
    """

    window, schedule = WINDOW, CosineSchedule()
    state_channels = coarse_channels = STATE_CHANNELS
    factor, default_noise, ends_at_zero = FACTOR, 0.0, True

    def __init__(self, network: SuperResolutionUNet, grid: Grid = atlas_grid(256), memory: int = 2**32):
        super().__init__()
        _check_divisible(network, grid)
        self.network, self.grid, self.memory = network, grid, memory

    def forward(self, x: Tensor, t: Tensor, coarse: Tensor) -> Tensor:
        """Clean estimate of x (B, 4, X, Y, Z) at times t (B,), given a coarse state repeated to x's size."""
        return from_slices(self.network(to_slices(x).contiguous(), t, to_slices(coarse))).to(x.dtype)

    def upsample(self, coarse: Tensor) -> Tensor:
        """The coarse state (B, C, x, y, z), repeated to the fine voxels."""
        return interpolate(coarse, scale_factor=self.factor, mode="nearest")

    def check_memory(self, dtype: torch.dtype) -> None:
        """Raises ValueError where denoising the whole grid, computed in `dtype`, takes more than `memory`."""
        needed = math.prod(self.grid.shape) * self.network.bytes_per_voxel(dtype)
        if needed > self.memory:
            gib = math.ceil(10 * needed / 2**30) / 10
            raise ValueError(f"MedSyn's super-resolution stage denoises its {self.grid.shape} voxels at once, not in "
                             f"tiles, which takes about {gib:g} GiB in {str(dtype).removeprefix('torch.')}, but "
                             f"{self.memory / 2**30:g} GiB are allowed: where there is so much memory, allow it with "
                             f"--model.super_resolution.memory {gib:g} (in Python, the stage's `memory` in bytes), "
                             "else leave the super-resolution stage out")

    def bind(self, coarse: Tensor, noise: float = 0.0, precision: str = "auto",
             generator: torch.Generator | None = None) -> BoundMedSynSuperResolution:
        """The denoiser of the fine states of a coarse one (B, 4, X/4, Y/4, Z/4), which may be a part of the grid's.

        noise: share in [0, 1] of normal noise in the coarse state (MedSyn trained with up to 0.4), no input of the
        network. generator: what the noise is drawn from, to be (1 - noise) coarse + noise n on the fine voxels, as in
        MedSyn's training; None: `coarse` carries it already.
        """
        if coarse.ndim != 5 or coarse.shape[1] != self.coarse_channels:
            raise ValueError(f"a coarse state is (B, {self.coarse_channels}, X, Y, Z), but {tuple(coarse.shape)} was "
                             "given: give the whole state of MedSyn's first stage, masks included")
        check_between("the noise level of the coarse state", noise)
        upsampled = self.upsample(coarse)
        if noise and generator is not None:
            upsampled = torch.lerp(upsampled, noise_like(upsampled, generator), noise)
        return BoundMedSynSuperResolution(self, upsampled, precision)


@dataclass(frozen=True)
class BoundMedSynSuperResolution:
    """A Denoiser: stage 2 with its coarse state, repeated to the fine size, fixed."""

    stage: MedSynSuperResolution
    coarse: Tensor
    precision: str = "auto"

    @property
    def schedule(self) -> CosineSchedule:
        return self.stage.schedule

    @torch.no_grad()
    def denoise(self, x: Tensor, t: float) -> Tensor:
        """E[x_0 | x_t = x, coarse]."""
        if x.shape[2:] != self.coarse.shape[2:]:
            raise ValueError(f"the coarse state belongs to {tuple(self.coarse.shape[2:])} fine voxels, but "
                             f"{tuple(x.shape[2:])} were given: bind the coarse state of the same region")
        times = torch.full((len(x),), float(t), device=x.device)
        with network_precision(self.precision, x):
            return self.stage(x, times, self.coarse.to(x).expand(len(x), -1, -1, -1, -1))
