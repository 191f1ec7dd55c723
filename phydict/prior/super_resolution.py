"""The second stage of a cascade: a diffusion prior of the fine CT, given the coarse one."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn.functional import interpolate

from phydict.diffusion import CosineSchedule, noise_like
from phydict.grid import Grid
from phydict.prior.local_unet import LocalUNet
from phydict.prior.prior import STATE, preconditioning
from phydict.prior.stage_file import header_start
from phydict.prior.tiles import Tiles
from phydict.runtime.precision import network_precision
from phydict.runtime.ranges import check_between
from phydict.units import HUWindow


class SuperResolution(nn.Module):
    """x0-predicting denoiser of the fine state, conditioned on the coarse state and on how noisy that is.

    x0 = k x_t / a + (1 - k) u + c_out F(c_in (x_t - a u), u, t, level): u is the coarse state upsampled trilinearly,
    and the network F predicts what it lacks, in units of that detail's expected size. Only below the noise level
    `skip_std` does the input itself take over, k = skip_std^2 / (sigma^2 + skip_std^2), as in Prior.

    In training the coarse state carries Gaussian noise of a random level (noise augmentation; Ho et al. 2022,
    arXiv:2106.15282), which F is given: at a level above 0 it relies less on the coarse state's details.

    network: F, with state_channels + coarse_channels inputs; grid, window: where and in which HU range the fine volumes
    live; factor: fine voxels along each side of a coarse one; coarse_channels: how many of the coarse state's
    channels are used; detail_std: standard deviation of x0 - u; memory: bytes that denoising may take beside the
    volumes, which decides whether it runs on the whole or in tiles; overlap: voxels that neighbouring tiles share at
    least. Tiles that share 48 changed the shipped stage's estimates and a sample, on 144^3 voxels of a held-out CT, by
    0.06 HU in the root mean square and 0.9 HU at most; bfloat16 changes estimates by 0.3 and 2.5 HU. default_noise: the
    level of the noise that a cascade gives the coarse state by default.
    """

    default_noise = 0.05

    def __init__(self, network: LocalUNet, grid: Grid, window: HUWindow, factor: int = 4, coarse_channels: int = 1,
                 schedule: CosineSchedule = CosineSchedule(), detail_std: float = 0.08, skip_std: float = 0.1,
                 memory: int = 2**32, overlap: int = 48):
        super().__init__()
        check_between("the factor of a super-resolution stage", factor, 1, math.inf)
        if any(n % network.divisor or n % factor for n in grid.shape):
            raise ValueError(f"this network needs sizes divisible by {network.divisor} and by the factor {factor}, but "
                             f"the grid is {grid.shape}")
        if not network.out_channels <= coarse_channels:
            raise ValueError(f"the coarse state must have the fine one's {network.out_channels} channels, but "
                             f"{coarse_channels} were given")
        if network.in_channels != network.out_channels + coarse_channels:
            raise ValueError(f"a network for {network.out_channels} fine and {coarse_channels} coarse channels has "
                             f"{network.out_channels + coarse_channels} inputs, but this one has {network.in_channels}")
        self.network, self.grid, self.window, self.schedule = network, grid, window, schedule
        self.factor, self.coarse_channels, self.state_channels = factor, coarse_channels, network.out_channels
        self.detail_std, self.skip_std = detail_std, skip_std
        self.memory, self.overlap = memory, math.ceil(overlap / network.divisor) * network.divisor

    def describe(self) -> dict:
        """What the stage is, as plain JSON values, for `build_super_resolution`."""
        return header_start("super_resolution", self.grid, self.window) | {
            "factor": self.factor, "state": STATE[:self.state_channels], "coarse_state": STATE[:self.coarse_channels],
            "detail_std": self.detail_std, "skip_std": self.skip_std, "schedule": vars(self.schedule),
            "network": self.network.settings}

    def forward(self, x: Tensor, t: Tensor, upsampled: Tensor, level: Tensor) -> Tensor:
        """Clean estimate of the fine state x (B, C, X, Y, Z) at times t (B,), in x's dtype.

        upsampled: the coarse state on x's voxels; level (B,): standard deviation of the noise that was added to it.
        """
        a, s = (w.to(x.dtype).view(-1, 1, 1, 1, 1) for w in self.schedule.scales(t.double()))
        share, out = self.preconditioning(t)
        coarse = upsampled[:, :self.state_channels]
        inward = (s**2 + (a * self.detail_std) ** 2).rsqrt()
        conditioning = torch.cat([inward * (x - a * coarse), 2 * upsampled], 1)
        return share * x / a + (1 - share) * coarse + out * self.network(conditioning, t, level).to(x.dtype)

    def network_inputs(self, shape: Sequence[int]) -> tuple[Tensor, Tensor, Tensor]:
        """As for a Prior."""
        return torch.zeros(1, self.network.in_channels, *shape), torch.zeros(1), torch.zeros(1)

    def preconditioning(self, t: Tensor) -> tuple[Tensor, Tensor]:
        """As for a Prior."""
        return preconditioning(self.schedule, t, self.detail_std, self.skip_std)

    def upsample(self, coarse: Tensor) -> Tensor:
        """The coarse state (B, C, x, y, z), of which the first coarse_channels count, on the fine voxels."""
        return interpolate(coarse[:, :self.coarse_channels], scale_factor=self.factor, mode="trilinear")

    def tiles(self) -> Tiles:
        """The tiles in which denoising stays within `memory`."""
        return Tiles.within(self.memory, self.network.bytes_per_voxel, self.overlap, self.network.divisor)

    def check_memory(self, dtype: torch.dtype) -> None:
        """Raises ValueError where no tile fits into `memory`, whatever the network computes in."""
        self.tiles()

    @torch.no_grad()
    def bind(self, coarse: Tensor, noise: float = 0.0, precision: str = "auto",
             generator: torch.Generator | None = None) -> BoundSuperResolution:
        """The denoiser given a coarse state (B, C, x, y, z) with Gaussian noise of the level `noise`.

        precision: see phydict.runtime.precision. generator: what the noise, added here, is drawn from; None: `coarse`
        carries it already. Raises ValueError for a level outside [0, 1] or too few channels.
        """
        check_between("the noise level of the coarse state", noise)
        if coarse.shape[1] < self.coarse_channels:
            raise ValueError(f"this super-resolution stage needs {self.coarse_channels} coarse channels, but "
                             f"{coarse.shape[1]} were given")
        if generator is not None:
            coarse = coarse + noise * noise_like(coarse, generator)
        return BoundSuperResolution(self, self.upsample(coarse), noise, precision)


@dataclass(frozen=True)
class BoundSuperResolution:
    """A Denoiser: a super-resolution stage with its coarse state fixed. Splits into tiles inside every call."""

    stage: SuperResolution
    upsampled: Tensor
    noise: float = 0.0
    precision: str = "auto"

    @property
    def schedule(self) -> CosineSchedule:
        return self.stage.schedule

    @torch.no_grad()
    def denoise(self, x: Tensor, t: float) -> Tensor:
        """E[x_0 | x_t = x, coarse state]."""
        times = torch.full((len(x),), float(t), device=x.device)
        level = torch.full((len(x),), float(self.noise), device=x.device)
        with network_precision(self.precision, x):
            return self.stage.tiles()(lambda part, coarse: self.stage(part, times, coarse, level), x,
                                      self.upsampled.to(x.dtype).expand(len(x), -1, -1, -1, -1))
