"""MedSyn's two networks, and the priors made of them (Xu et al. 2024, doi:10.1109/TMI.2024.3415032).

| here                | resolution | condition           | parameters  |
|---------------------|------------|---------------------|-------------|
| TextUNet            | 64^3       | report              | 716,215,684 |
| SuperResolutionUNet | 256^3      | state of the 64^3   |  54,307,908 |

Both are UNets over (slice, row, column) that never downsample the slices. Their parameters bear the names of MedSyn's
checkpoints, which are therefore read strictly (`phydict.prior.medsyn.checkpoint`). What names and shapes leave open follows
the convention of the video diffusion UNets that they descend from (Ho et al. 2022, arXiv:2204.03458): attention is
normalised first and added to its input, the time gives scale before shift, sines stand before cosines, a level's own
features before the skipped ones. Going down, both resize before their block across slices, which is known of stage 1
alone. None of this could be compared with MedSyn's trained weights, which are not public.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from einops import rearrange
from torch import Tensor, nn
from torch.nn.functional import interpolate, scaled_dot_product_attention, silu

from phydict.diffusion import CosineSchedule
from phydict.grid import Grid
from phydict.runtime.precision import network_precision
from phydict.prior.prior import BoundPrior
from phydict.prior.text import TextEncoder
from phydict.units import HUWindow

WINDOW = HUWindow(-1024.0, 600.0)
"""The HU of MedSyn's range [-1, 1]."""

FIELD = (316.0, 316.0, 292.0)
"""Edge lengths in mm (x, y, z) of MedSyn's atlas, to which its CTs were registered: mm are the atlas's, not the
patient's."""

STATE_CHANNELS, FACTOR = 4, 4
"""Channels of the state at both stages, and voxels of stage 2 per voxel of stage 1 along an axis."""

GROUPS, HEAD_WIDTH = 8, 32
"""Groups of each group norm, and channels of an attention head."""

IN_SLICE, IN_VOLUME = (1, 3, 3), (3, 3, 3)
"""Kernels of the convolutions within slices and across them."""

RESIZE = {"kernel_size": (1, 4, 4), "stride": (1, 2, 2), "padding": (0, 1, 1)}
"""The convolutions that halve or double rows and columns."""


class Sinusoid(nn.Module):
    """Times (B,) -> (B, width): sines, then cosines, of geometrically spaced frequencies from 1 to 1/10000."""

    def __init__(self, width: int):
        super().__init__()
        self.half = width // 2

    def forward(self, t: Tensor) -> Tensor:
        exponent = torch.arange(self.half, device=t.device, dtype=t.dtype) / (self.half - 1)
        angle = t[:, None] * torch.exp(-math.log(10000) * exponent)
        return torch.cat([angle.sin(), angle.cos()], 1)


class Block(nn.Module):
    """Convolution, group norm, scale and shift, SiLU."""

    def __init__(self, inward: int, outward: int, kernel: tuple[int, int, int]):
        super().__init__()
        self.proj = nn.Conv3d(inward, outward, kernel, padding=tuple(k // 2 for k in kernel))
        self.norm = nn.GroupNorm(GROUPS, outward)

    def forward(self, x: Tensor, scale: Tensor | None = None, shift: Tensor | None = None) -> Tensor:
        x = self.norm(self.proj(x))
        return silu(x if scale is None else torch.addcmul(shift, x, 1 + scale), inplace=True)


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
        heard = rearrange(scaled_dot_product_attention(q, k.to(q.dtype), v.to(q.dtype)),
                          "b h (y x) d -> b (h d) y x", x=x.shape[4])
        return self.to_out(heard).unflatten(2, (slices, -1))


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
        return self.time_mlp(1000 * t.to(self.time_mlp[1].weight.dtype))

    def down(self, x: Tensor, time: Tensor) -> tuple[Tensor, list[Tensor]]:
        """The deepest features, and those that the way up takes back in."""
        skipped = []
        for level in self.downs:
            x = level["1"](level["0"](x, time), time)
            skipped.append(x)
            if self.resize in level:
                x = level[self.resize](x)
            x = level[self.volume](x, time)
        return x, skipped

    def up(self, x: Tensor, skipped: list[Tensor], time: Tensor) -> Tensor:
        for level in self.ups:
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


def atlas_grid(voxels: int) -> Grid:
    """`voxels`^3 voxels over MedSyn's atlas, centred on the isocentre: 64 at stage 1, 256 at stage 2."""
    return Grid((voxels,) * 3, tuple(side / voxels for side in FIELD))


def to_slices(x: Tensor) -> Tensor:
    """A RAS+ state (B, C, X, Y, Z) along MedSyn's axes: inferior to superior, posterior to anterior, right to left."""
    return x.permute(0, 1, 4, 3, 2).flip(4)


def from_slices(x: Tensor) -> Tensor:
    """The inverse of `to_slices`."""
    return x.flip(4).permute(0, 1, 4, 3, 2)


class MedSynPrior(nn.Module):
    """MedSyn's stage 1 as a prior: denoises states (B, 4, X, Y, Z), in RAS+, of CT, lobe, airway and vessel masks.

    network: predicts the clean state; text: reports -> contexts (B, L, D), with or without a mask, such as a
    TextEncoder; load_text: a function that returns it when the first report arrives; grid: where the voxels are.
    The attenuation of the window's low end, -1024 HU, is slightly negative. ends_at_zero: MedSyn's inference descends
    in 50 steps from time 1 to 0 and denoises there once more.
    """

    window, schedule, state_channels = WINDOW, CosineSchedule(), STATE_CHANNELS
    ends_at_zero = True

    def __init__(self, network: TextUNet, text: Callable | None = None,
                 load_text: Callable[[], Callable] | None = None, grid: Grid = atlas_grid(64)):
        super().__init__()
        _check_divisible(network, grid)
        self.network, self.text, self.load_text, self.grid = network, text, load_text, grid

    @property
    def null(self) -> Tensor:
        """The learned context (1, L, D) of no report."""
        return self.network.null_cond_emb

    def context(self, reports: Sequence[str]) -> Tensor:
        """Reports -> contexts (B, L, D); the learned null context for an empty report.

        Raises ValueError where there is no text encoder, or where its contexts have another size.
        """
        null = self.null.expand(len(reports), -1, -1)
        if not any(reports):
            return null
        if self.text is None:
            if self.load_text is None:
                raise ValueError("this MedSyn prior has no text encoder, but a report was given: give MedSyn's "
                                 "language model as its text, or leave the report out")
            self.text = self.load_text()
        if isinstance(self.text, nn.Module):
            self.text.to(null.device)
        states = self.text(list(reports))
        states = states[0] if isinstance(states, tuple) else states
        if states.shape != null.shape:
            raise ValueError(f"MedSyn's contexts have {null.shape[1]} tokens of {null.shape[2]} numbers, but the text "
                             f"encoder gave {tuple(states.shape[1:])}: use MedSyn's language model and its first "
                             f"{null.shape[1]} positions")
        given = torch.tensor([bool(report) for report in reports], device=null.device)
        return torch.where(given[:, None, None], states.to(null), null)

    def forward(self, x: Tensor, t: Tensor, context: Tensor) -> Tensor:
        """Clean estimate of the state x (B, 4, X, Y, Z) at times t (B,), in x's dtype."""
        return from_slices(self.network(to_slices(x).contiguous(), t, context)).to(x.dtype)

    @torch.no_grad()
    def bind(self, report: str = "", guidance: float = 1.0, precision: str = "auto") -> BoundPrior:
        """The denoiser of one report, with classifier-free guidance of the given scale inside (1 = none).

        Warns, once for each report, where a TextEncoder cuts it or does not know its words.
        """
        if guidance < 0:
            raise ValueError(f"the guidance scale is at least 0, but {guidance} was given")
        context = self.context([report])
        if report and isinstance(self.text, TextEncoder):
            self.text.check([report])
        return BoundPrior(self, context, guidance if report else 1.0, precision)


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
                             f"--model.fine_memory {gib:g} (in Python, the stage's `memory` in bytes), else leave the "
                             "super-resolution stage out")

    def bind(self, coarse: Tensor, noise: float = 0.0, precision: str = "auto",
             draw: torch.Generator | None = None) -> BoundSuperResolution:
        """The denoiser of the fine states of a coarse one (B, 4, X/4, Y/4, Z/4), which may be a part of the grid's.

        noise: share in [0, 1] of normal noise in the coarse state (MedSyn trained with up to 0.4); the network is not
        told. draw: what the noise is drawn from, to be (1 - noise) coarse + noise n on the fine voxels, as in MedSyn's
        training; None: `coarse` carries it already.
        """
        if coarse.ndim != 5 or coarse.shape[1] != self.coarse_channels:
            raise ValueError(f"a coarse state is (B, {self.coarse_channels}, X, Y, Z), but {tuple(coarse.shape)} was "
                             "given: give the whole state of MedSyn's first stage, masks included")
        if not 0 <= noise <= 1:
            raise ValueError(f"the coarse state's share of noise lies in [0, 1], but {noise} was given")
        upsampled = self.upsample(coarse)
        if noise and draw is not None:
            upsampled = torch.lerp(upsampled, torch.randn(upsampled.shape, generator=draw).to(upsampled), noise)
        return BoundSuperResolution(self, upsampled, precision)


@dataclass(frozen=True)
class BoundSuperResolution:
    """A Denoiser: stage 2 with its coarse state, repeated to the fine size, fixed."""

    stage: MedSynSuperResolution
    coarse: Tensor
    precision: str = "auto"

    @property
    def schedule(self) -> CosineSchedule:
        return self.stage.schedule

    @property
    def ends_at_zero(self) -> bool:
        return self.stage.ends_at_zero

    @torch.no_grad()
    def denoise(self, x: Tensor, t: float) -> Tensor:
        """E[x_0 | x_t = x, coarse]."""
        if x.shape[2:] != self.coarse.shape[2:]:
            raise ValueError(f"the coarse state belongs to {tuple(self.coarse.shape[2:])} fine voxels, but "
                             f"{tuple(x.shape[2:])} were given: bind the coarse state of the same region")
        times = torch.full((len(x),), float(t), device=x.device)
        with network_precision(self.precision, x):
            return self.stage(x, times, self.coarse.to(x).expand(len(x), -1, -1, -1, -1))


def _check_divisible(network: SliceUNet, grid: Grid) -> None:
    if any(n % network.divisor for n in grid.shape[:2]):
        raise ValueError(f"this network needs X and Y sizes divisible by {network.divisor}, but the grid is "
                         f"{grid.shape}")
