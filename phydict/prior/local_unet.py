"""The network of the super-resolution stage: a UNet that sees only a voxel's neighbourhood."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn
from torch.nn.functional import layer_norm, pad

from phydict.prior.convolution import lay_out, silence, speed_up
from phydict.prior.unet import check_sizes, folded, unfolded

if TYPE_CHECKING:
    from monai.networks.nets import UNet

SLAB_VOXELS = 2**20
"""Voxels, up to those of whole planes, that `slab_by_slab` shows its last layers at once: four times as many take a
sixth more time on an AVX2 core, most of it to get their memory."""


class PositionNorm(nn.Module):
    """Normalisation over the channels of each position. Unlike group normalisation it looks at no other position."""

    def __init__(self, channels: int):
        super().__init__()
        self.weight, self.bias = nn.Parameter(torch.ones(channels)), nn.Parameter(torch.zeros(channels))

    def forward(self, x: Tensor) -> Tensor:
        """x (B, C, X, Y, Z) -> the same shape."""
        return layer_norm(x.movedim(1, -1), self.weight.shape, self.weight, self.bias, 1e-6).movedim(-1, 1)


class LocalUNet(nn.Module):
    """MONAI's DiffusionModelUNet on blocks of `block`^3 voxels, without attention and normalised position by position.

    Its result at a voxel depends on voxels up to `reach` away alone, so that it runs on crops and tiles as on a whole
    volume; it learns from crops whose border is no part of the anatomy.

    in_channels, out_channels: per voxel. channels: width of each level. res_blocks: residual blocks per level.
    Spatial sizes must be divisible by block * 2^(levels - 1).
    """

    def __init__(self, in_channels: int = 2, out_channels: int = 1, block: int = 4,
                 channels: tuple[int, ...] = (64, 96), res_blocks: int = 1):
        from monai.networks.nets import DiffusionModelUNet

        super().__init__()
        check_sizes(block=block, channels=channels, res_blocks=res_blocks)
        self.settings: dict = {"in_channels": in_channels, "out_channels": out_channels, "block": block,
                               "channels": list(channels), "res_blocks": res_blocks}
        self.in_channels, self.out_channels, self.block = in_channels, out_channels, block
        self.divisor = block * 2 ** (len(channels) - 1)
        self.fold = nn.Conv3d(in_channels * block**3 + 1, channels[0], 1)
        self.unet = DiffusionModelUNet(
            spatial_dims=3, in_channels=channels[0], out_channels=channels[0], channels=tuple(channels),
            attention_levels=(False,) * len(channels), num_res_blocks=res_blocks, norm_num_groups=1,
            num_head_channels=channels[-1])
        self.unet.middle_block.attention = nn.Identity()
        for module in list(self.unet.modules()):
            for name, child in module.named_children():
                if isinstance(child, nn.GroupNorm):
                    setattr(module, name, PositionNorm(child.num_channels))
        self.unfold = nn.Conv3d(channels[0], out_channels * block**3, 1)
        # MONAI's output convolution starts at zero; two zero layers in a row would never learn.
        nn.init.xavier_uniform_(self.unet.out[-1].get_parameter("conv.weight"))
        silence(self.unfold)
        speed_up(self)
        lay_out(self)

    @property
    def reach(self) -> int:
        """Voxels beyond which nothing changes the result (a bound)."""
        levels, blocks = len(self.settings["channels"]), self.settings["res_blocks"]
        positions = 2  # first and last convolution
        for level in range(levels):
            bottom = level == levels - 1
            convolutions = 2 * blocks + 2 * (blocks + 1) + (4 if bottom else 3)  # with middle, or down and up
            positions += 2**level * convolutions
        return self.block * (positions + 1) - 1

    @property
    def bytes_per_voxel(self) -> float:
        """Memory that a call without gradients takes per voxel, in bytes: about a dozen float32 maps of the top level
        and the folded input and output."""
        return 4 * (12 * self.settings["channels"][0] / self.block**3 + 3 * self.in_channels + 2 * self.out_channels)

    def forward(self, x: Tensor, t: Tensor, level: Tensor) -> Tensor:
        """x (B, in_channels, X, Y, Z), times t (B,) and noise levels (B,) in [0, 1] -> (B, out_channels, X, Y, Z)."""
        if any(size % self.divisor for size in x.shape[2:]):
            raise ValueError(f"this network needs sizes divisible by {self.divisor}, but {tuple(x.shape[2:])} came")
        n = self.block
        h = folded(x, n)
        h = torch.cat([h, level.to(h).view(-1, 1, 1, 1, 1).expand(-1, 1, *h.shape[2:])], 1)
        h = self.fold(h.contiguous(memory_format=torch.channels_last_3d))
        h = self.unfold(self.unet(h, 1000 * t))
        return unfolded(h, n)


def unnormalised_unet(inputs: int, outputs: int, channels: Sequence[int], residual_units: int) -> UNet:
    """MONAI's UNet without norms, (B, inputs, X, Y, Z) -> (B, outputs, X, Y, Z); channels: width of each level."""
    from monai.networks.nets import UNet

    return UNet(3, inputs, outputs, tuple(channels), (2,) * (len(channels) - 1), num_res_units=residual_units,
                act="swish", norm=None)  # type: ignore[arg-type]  # which MONAI takes for no norm


def slab_by_slab(unet: UNet, head: Callable[[Tensor, Tensor], Tensor], x: Tensor) -> Tensor:
    """head(unet(x), x) (B, C, X, Y, Z) of an unnormalised UNet and x, whose sides it divides, for a head that knows no
    voxels but the next. The layers of full resolution see slabs alone: the UNet's last knows one plane before and one
    behind of its input (B, C, X / 2, Y / 2, Z / 2), and the head one more of both."""
    down, below, up = unet.model.children()
    coarse = below(down(x))
    planes, slab = coarse.shape[2], max(SLAB_VOXELS // x[0, 0, :2].numel(), 1)
    slabs = []
    for start in range(0, planes, slab):
        stop = min(start + slab, planes)
        first, last = max(start - 1, 0), min(stop + 2, planes)
        found = head(up(coarse[:, :, first:last]), x[:, :, 2 * first:2 * last])
        slabs.append(found[:, :, 2 * (start - first):2 * (stop - first)])
    return torch.cat(slabs, 2)


def prolonged(x: Tensor, divisor: int) -> Tensor:
    """x (B, C, X, Y, Z) with its last voxels repeated at the end of each axis, up to the next multiple of `divisor`."""
    missing = [n for size in reversed(x.shape[2:]) for n in (0, -size % divisor)]
    return pad(x, missing, mode="replicate") if any(missing) else x
