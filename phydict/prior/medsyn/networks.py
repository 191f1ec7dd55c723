"""MedSyn's networks."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import cast

import torch
from einops import rearrange
from torch import Tensor, nn
from torch.nn.functional import scaled_dot_product_attention, silu

STATE_CHANNELS, FACTOR = 4, 4
"""Channels of the state at both stages, and voxels of stage 2 per voxel of stage 1 along an axis."""

GROUPS, HEAD_WIDTH = 8, 32
"""Groups of each group norm, and channels of an attention head."""

IN_SLICE, IN_VOLUME = (1, 3, 3), (3, 3, 3)
"""Kernels of the convolutions within slices and across them."""

RESIZE: dict = {"kernel_size": (1, 4, 4), "stride": (1, 2, 2), "padding": (0, 1, 1)}
"""The convolutions that halve or double rows and columns."""


class Sinusoid(nn.Module):
    """Times (B,) -> (B, width): sines, then cosines, of geometrically spaced frequencies from 1 to 1/10000."""

    def __init__(self, width: int):
        super().__init__()
        self.frequencies = width // 2

    def forward(self, t: Tensor) -> Tensor:
        exponent = torch.arange(self.frequencies, device=t.device, dtype=t.dtype) / (self.frequencies - 1)
        angle = t[:, None] * torch.exp(-math.log(10000) * exponent)
        return torch.cat([angle.sin(), angle.cos()], 1)


class Block(nn.Module):
    """Convolution, group norm, scale and shift (`modulation`, where there is one), SiLU."""

    def __init__(self, inward: int, outward: int, kernel: tuple[int, int, int]):
        super().__init__()
        self.proj = nn.Conv3d(inward, outward, kernel, padding=(kernel[0] // 2, kernel[1] // 2, kernel[2] // 2))
        self.norm = nn.GroupNorm(GROUPS, outward)

    def forward(self, x: Tensor, *modulation: Tensor) -> Tensor:
        x = self.norm(self.proj(x))
        return silu(torch.addcmul(modulation[1], x, 1 + modulation[0]) if modulation else x, inplace=True)


class ResidualBlock(nn.Module):
    """Two blocks added to their input; the time, where there is one, scales and shifts the first."""

    def __init__(self, inward: int, outward: int, kernel: tuple[int, int, int], time_width: int = 0):
        super().__init__()
        self.mlp = nn.Sequential(nn.SiLU(), nn.Linear(time_width, 2 * outward)) if time_width else None
        self.block1, self.block2 = Block(inward, outward, kernel), Block(outward, outward, kernel)
        self.res_conv = nn.Conv3d(inward, outward, 1) if inward != outward else nn.Identity()

    def forward(self, x: Tensor, time: Tensor | None = None) -> Tensor:
        modulation = () if self.mlp is None else self.mlp(time)[..., None, None, None].chunk(2, dim=1)
        return self.block2(self.block1(x, *modulation)).add_(self.res_conv(x))


class ChannelNorm(nn.Module):
    """Layer norm over the channels of each voxel, with a gain and no bias."""

    def __init__(self, channels: int):
        super().__init__()
        self.gamma = nn.Parameter(torch.ones(1, channels, 1, 1, 1))

    def forward(self, x: Tensor) -> Tensor:
        variance, mean = torch.var_mean(x, 1, correction=0, keepdim=True)
        return (x - mean) * (variance + 1e-5).rsqrt() * self.gamma


class SelfAttention(nn.Module):
    """Tokens (B, N, channels) attend to each other."""

    def __init__(self, channels: int, heads: int):
        super().__init__()
        self.heads = heads
        self.to_qkv = nn.Linear(channels, 3 * heads * HEAD_WIDTH, bias=False)
        self.to_out = nn.Linear(heads * HEAD_WIDTH, channels, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        q, k, v = rearrange(self.to_qkv(x), "b n (part h d) -> part b h n d", part=3, h=self.heads)
        return self.to_out(rearrange(scaled_dot_product_attention(q, k, v), "b h n d -> b n (h d)"))


class PerSlice(nn.Module):
    """A function of tokens, run on the voxels of each slice."""

    def __init__(self, fn: nn.Module):
        super().__init__()
        self.fn = fn

    def forward(self, x: Tensor) -> Tensor:
        n, _, _, rows, columns = x.shape
        tokens = self.fn(rearrange(x, "b c z y x -> (b z) (y x) c"))
        return rearrange(tokens, "(b z) (y x) c -> b c z y x", b=n, y=rows, x=columns)


class CrossAttention(nn.Module):
    """Voxels (B, C, Z, Y, X) attend to a context (B, L, D), padding included."""

    def __init__(self, channels: int, context_dim: int, heads: int):
        super().__init__()
        self.heads = heads
        self.to_q = nn.Conv2d(channels, heads * HEAD_WIDTH, 1, bias=False)
        self.to_kv = nn.Linear(context_dim, 2 * heads * HEAD_WIDTH, bias=False)
        self.to_out = nn.Conv2d(heads * HEAD_WIDTH, channels, 1)

    def forward(self, x: Tensor, context: Tensor) -> Tensor:
        slices = x.shape[2]
        q = rearrange(self.to_q(x.flatten(2, 3)), "b (h d) y x -> b h (y x) d", h=self.heads)
        k, v = rearrange(self.to_kv(context), "b l (part h d) -> part b h l d", part=2, h=self.heads)
        attended = rearrange(scaled_dot_product_attention(q, k.to(q.dtype), v.to(q.dtype)),
                          "b h (y x) d -> b (h d) y x", x=x.shape[4])
        return self.to_out(attended).unflatten(2, (slices, -1))


class Normed(nn.Module):
    """A function of the channel-normed input."""

    def __init__(self, channels: int, fn: nn.Module):
        super().__init__()
        self.norm, self.fn = ChannelNorm(channels), fn

    def forward(self, x: Tensor, *context: Tensor) -> Tensor:
        return self.fn(self.norm(x), *context)


class Added(nn.Module):
    """A channel-normed function, added to its input."""

    def __init__(self, channels: int, fn: nn.Module):
        super().__init__()
        self.fn = Normed(channels, fn)

    def forward(self, x: Tensor, *context: Tensor) -> Tensor:
        return x + self.fn(x, *context)


class SliceUNet(nn.Module):
    """What both networks share: time, and the levels down and up, whose blocks are named as in the checkpoints.

    upsample_first: a level going up doubles rows and columns after its first block instead of at its end. Both orders
    are found in MedSyn's files (training and inference), with the same names and shapes: only one suits given weights.
    volume, resize: the names, within a level, of the block across slices and of the convolution that resizes.
    """

    def __init__(self, width: int, multipliers: Sequence[int], upsample_first: bool, volume: str, resize: str):
        super().__init__()
        time = 4 * width
        self.upsample_first, self.volume, self.resize, self.time_width = upsample_first, volume, resize, time
        self.widths = [width * m for m in multipliers]
        self.divisor = 2 ** (len(multipliers) - 1)
        self.time_mlp = nn.Sequential(Sinusoid(width), nn.Linear(width, time), nn.GELU(), nn.Linear(time, time))
        steps = list(zip([width, *self.widths], self.widths))
        self.downs = nn.ModuleList(
            self._level(a, b, nn.Conv3d(b, b, **RESIZE) if i < len(steps) - 1 else None)
            for i, (a, b) in enumerate(steps))
        self.ups = nn.ModuleList(
            self._level(2 * b, a, nn.ConvTranspose3d(a, a, **RESIZE) if i else None)
            for i, (a, b) in reversed(list(enumerate(steps))))

    def _level(self, inward: int, outward: int, resize: nn.Module | None) -> nn.ModuleDict:
        blocks = {"0": self.block(inward, outward, IN_SLICE), "1": self.block(outward, outward, IN_SLICE),
                  self.volume: self.block(outward, outward, IN_VOLUME)}
        return nn.ModuleDict(blocks | ({self.resize: resize} if resize else {}))

    def block(self, inward: int, outward: int, kernel: tuple[int, int, int]) -> ResidualBlock:
        return ResidualBlock(inward, outward, kernel, self.time_width)

    def time(self, t: Tensor) -> Tensor:
        """Times (B,) in [0, 1] -> (B, time_width)."""
        return self.time_mlp(1000 * t.to(self.time_mlp[1].get_parameter("weight").dtype))

    def down(self, x: Tensor, time: Tensor) -> tuple[Tensor, list[Tensor]]:
        """The deepest features, and those that the way up takes back in."""
        skipped = []
        for level in cast("Sequence[nn.ModuleDict]", self.downs):
            x = level["1"](level["0"](x, time), time)
            skipped.append(x)
            if self.resize in level:
                x = level[self.resize](x)
            x = level[self.volume](x, time)
        return x, skipped

    def up(self, x: Tensor, skipped: list[Tensor], time: Tensor) -> Tensor:
        for level in cast("Sequence[nn.ModuleDict]", self.ups):
            x = torch.cat([x, skipped.pop()], 1)
            x = level["0"](x, time)
            if self.upsample_first and self.resize in level:
                x = level[self.resize](x)
            x = level[self.volume](level["1"](x, time), time)
            if not self.upsample_first and self.resize in level:
                x = level[self.resize](x)
        return x


class TextUNet(SliceUNet):
    """Stage 1: predicts the clean state from a noisy one and a report.

    width: channels of the first level; multipliers: channels of each level, in units of it; heads: of all attention;
    tokens, context_dim: size (L, D) of a context; upsample_first: see SliceUNet.
    """

    REPEATS = 4

    def __init__(self, width: int = 160, multipliers: Sequence[int] = (1, 2, 4, 8), heads: int = 8,
                 tokens: int = 192, context_dim: int = 768, upsample_first: bool = False):
        super().__init__(width, multipliers, upsample_first, volume="2", resize="3")
        deep = self.widths[-1]
        self.null_cond_emb = nn.Parameter(torch.randn(1, tokens, context_dim))
        self.init_conv = nn.Conv3d(STATE_CHANNELS, width, 7, padding=3)
        self.mid_block1 = self.block(deep, deep, IN_SLICE)
        shared = SelfAttention(deep, heads)
        for n in range(1, self.REPEATS + 1):
            self.add_module(f"mid_spatial_attn{n}", Added(deep, PerSlice(shared)))
            self.add_module(f"mid_cross_attn{n}", Added(deep, CrossAttention(deep, context_dim, heads)))
            self.add_module(f"mid_temporal_attn{n}", self.block(deep, deep, IN_VOLUME))
        self.mid_block2 = self.block(deep, deep, IN_SLICE)
        self.final_conv = nn.Sequential(ResidualBlock(2 * width, width, IN_SLICE), nn.Conv3d(width, STATE_CHANNELS, 1))

    def forward(self, x: Tensor, t: Tensor, context: Tensor) -> Tensor:
        """x (B, 4, slices, rows, columns), t (B,) in [0, 1], context (B, L, D) -> clean state of x's shape."""
        first, time = self.init_conv(x), self.time(t)
        x, skipped = self.down(first, time)
        x = self.mid_block1(x, time)
        for n in range(1, self.REPEATS + 1):
            x = self.get_submodule(f"mid_spatial_attn{n}")(x)
            x = self.get_submodule(f"mid_cross_attn{n}")(x, context)
            x = self.get_submodule(f"mid_temporal_attn{n}")(x, time)
        x = self.up(self.mid_block2(x, time), skipped, time)
        return self.final_conv(torch.cat([x, first], 1))


class SuperResolutionUNet(SliceUNet):
    """Stage 2: predicts the clean state from a noisy one and a coarse one of the same size. It reads no report.

    Arguments as for TextUNet.
    """

    def __init__(self, width: int = 56, multipliers: Sequence[int] = (1, 2, 4, 8), heads: int = 4,
                 upsample_first: bool = False):
        super().__init__(width, multipliers, upsample_first, volume="4", resize="5")
        deep = self.widths[-1]
        self.init_conv0 = nn.Conv3d(2 * STATE_CHANNELS, width, 7, padding=3)
        self.mid_block1 = self.block(deep, deep, IN_SLICE)
        self.mid_spatial_attn = Added(deep, PerSlice(SelfAttention(deep, heads)))
        self.mid_temporal_conv = self.block(deep, deep, IN_VOLUME)
        self.mid_block2 = self.block(deep, deep, IN_SLICE)
        self.final_conv0 = nn.Sequential(ResidualBlock(2 * width, width, IN_SLICE),
                                         nn.Conv3d(width, STATE_CHANNELS, 1))

    def bytes_per_voxel(self, dtype: torch.dtype) -> float:
        """Memory that a call without gradients, computed in `dtype`, takes per voxel, in bytes: of the first level's
        width seven maps and three more that a convolution may lay out anew, and sixteen float32 maps of the states.
        (Calls on a CPU took 0.7 to 1.1 times as much.)"""
        return 10 * self.widths[0] * dtype.itemsize + 64

    def forward(self, x: Tensor, t: Tensor, coarse: Tensor) -> Tensor:
        """x and coarse (B, 4, slices, rows, columns), t (B,) in [0, 1] -> clean state of x's shape."""
        first, time = self.init_conv0(torch.cat([coarse.to(x), x], 1)), self.time(t)
        x, skipped = self.down(first, time)
        x = self.mid_temporal_conv(self.mid_spatial_attn(self.mid_block1(x, time)), time)
        x = self.up(self.mid_block2(x, time), skipped, time)
        return self.final_conv0(torch.cat([x, first], 1))


def to_slices(x: Tensor) -> Tensor:
    """A RAS+ state (B, C, X, Y, Z) along MedSyn's axes: inferior to superior, posterior to anterior, right to left."""
    return x.permute(0, 1, 4, 3, 2).flip(4)


def from_slices(x: Tensor) -> Tensor:
    """The inverse of `to_slices`."""
    return x.flip(4).permute(0, 1, 4, 3, 2)
