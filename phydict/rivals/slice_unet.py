"""A UNet over stacks of slices: convolutions within slices, attention along the stack, as of video diffusion."""

from __future__ import annotations

import math
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn.functional import interpolate, scaled_dot_product_attention, silu

from phydict.prior.convolution import silence

HEADS = 4
GROUPS = 4


def waves(values: Tensor, width: int) -> Tensor:
    """Values (N,) as sines and cosines (N, width) of wavelengths from 2 pi to 10,000 times as long."""
    rates = torch.exp(-math.log(10_000) * torch.arange(width // 2, device=values.device) / (width // 2))
    phase = values[:, None] * rates.to(values)
    return torch.cat([phase.sin(), phase.cos()], 1)


class SliceBlock(nn.Module):
    """x + two convolutions within slices, scaled and shifted by the condition."""

    def __init__(self, channels: int, out: int, condition: int):
        super().__init__()
        self.first = nn.Conv3d(channels, out, (3, 3, 1), padding=(1, 1, 0))
        self.second = nn.Conv3d(out, out, (3, 3, 1), padding=(1, 1, 0))
        self.norms = nn.ModuleList(nn.GroupNorm(GROUPS, n) for n in (channels, out))
        self.modulation = nn.Linear(condition, 2 * out)
        self.past = nn.Conv3d(channels, out, 1) if channels != out else nn.Identity()

    def forward(self, x: Tensor, condition: Tensor) -> Tensor:
        scale, shift = self.modulation(silu(condition))[..., None, None, None].chunk(2, 1)
        h = self.norms[1](self.first(silu(self.norms[0](x)))) * (1 + scale) + shift
        return self.past(x) + self.second(silu(h))


class StackAttention(nn.Module):
    """x + attention of each position of a slice to the same position of all slices."""

    def __init__(self, channels: int):
        super().__init__()
        self.norm = nn.GroupNorm(1, channels)
        self.enter, self.leave = nn.Linear(channels, 3 * channels, bias=False), nn.Linear(channels, channels)
        silence(self.leave)

    def forward(self, x: Tensor) -> Tensor:
        batch, channels, across, down, slices = x.shape
        h = self.norm(x).permute(0, 2, 3, 4, 1).reshape(-1, slices, channels)
        h = h + waves(torch.arange(float(slices), device=x.device), channels).to(h)
        q, k, v = self.enter(h).unflatten(2, (3, HEADS, -1)).permute(2, 0, 3, 1, 4)
        h = self.leave(scaled_dot_product_attention(q, k, v).transpose(1, 2).flatten(2))
        return x + h.view(batch, across, down, slices, channels).permute(0, 4, 1, 2, 3)


class SliceUNet(nn.Module):
    """Noisy stacks (B, C, X, Y, slices) at times, beside a condition (B, D) -> their velocity.

    After the 3D UNet of video diffusion (Ho et al. 2022, arXiv:2204.03458) that X-ray2CTPA uses. Slices are halved from
    level to level, their number stays. channels: of the stack; condition: its width D; widths: of each level.
    """

    def __init__(self, channels: int, condition: int, widths: tuple[int, ...]):
        super().__init__()
        known = condition + 2 * widths[0]
        self.wave, width = widths[0], 2 * widths[0]
        self.time = nn.Sequential(nn.Linear(self.wave, width), nn.SiLU(), nn.Linear(width, width))
        self.enter = nn.Conv3d(channels, widths[0], (3, 3, 1), padding=(1, 1, 0))
        self.blocks = nn.ModuleList(SliceBlock(w, w, known) for w in widths)
        self.attention = nn.ModuleList(StackAttention(w) for w in widths)
        self.down = nn.ModuleList(nn.Conv3d(a, b, (2, 2, 1), (2, 2, 1)) for a, b in pairwise(widths))
        self.back = nn.ModuleList(SliceBlock(a + b, a, known) for a, b in pairwise(widths))
        self.last = SliceBlock(2 * widths[0], widths[0], known)
        self.leave = nn.Conv3d(widths[0], channels, 1)
        silence(self.leave)

    def forward(self, x: Tensor, t: Tensor, condition: Tensor) -> Tensor:
        """x (B, C, X, Y, slices), times t (B,) in [0, 1], condition (B, D) -> velocity of x's shape."""
        known = torch.cat([condition, self.time(waves(1000 * t, self.wave).to(condition))], 1)
        h, levels = self.enter(x), []
        start = h
        for n, (block, attend) in enumerate(zip(self.blocks, self.attention)):
            h = attend(block(self.down[n - 1](h) if n else h, known))
            levels.append(h)
        h = levels.pop()
        for block in reversed(self.back):
            h = block(torch.cat([interpolate(h, scale_factor=(2.0, 2.0, 1.0), mode="nearest"), levels.pop()], 1), known)
        return self.leave(self.last(torch.cat([h, start], 1), known))
