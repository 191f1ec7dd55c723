"""The network behind a prior: MONAI's 3D diffusion UNet between a space-to-depth stem and its inverse."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from types import MethodType

import torch
from einops import rearrange
from torch import Tensor, nn
from torch.nn.functional import interpolate, pad
from torch.utils.checkpoint import checkpoint

from phydict.prior.convolution import lay_out, silence, speed_up
from phydict.prior.kind_map import KindMap


class TextMap(nn.Module):
    """Where in the chest a report speaks of: learned positions attend to its tokens and answer with a coarse map.

    context_dim: width D of the context; channels: of the map; cells: the map has cells^3 positions.
    """

    def __init__(self, context_dim: int, channels: int = 8, cells: int = 8, heads: int = 4):
        super().__init__()
        self.cells, self.channels = cells, channels
        self.positions = nn.Parameter(0.02 * torch.randn(cells**3, context_dim))
        self.attention = nn.MultiheadAttention(context_dim, heads, batch_first=True)
        self.answer = nn.Sequential(nn.LayerNorm(context_dim), nn.Linear(context_dim, 2 * context_dim), nn.GELU(),
                                    nn.Linear(2 * context_dim, channels))
        self.to_sketch = nn.Conv3d(channels, 1, 1)  # of priors up to 0.2, which learnt the map by it

    def forward(self, context: Tensor) -> Tensor:
        """Context (B, L, D) -> map (B, channels, cells, cells, cells)."""
        positions = self.positions.expand(len(context), -1, -1)
        attended = positions + self.attention(positions, context, context, need_weights=False)[0]
        return self.answer(attended).transpose(1, 2).unflatten(2, (self.cells,) * 3)


NORM_GROUPS = 8
"""Into how many groups channels are divided to be normalised."""


def folded(x: Tensor, n: int) -> Tensor:
    """Voxels (B, C, X, Y, Z) with each block of n^3 folded into channels: (B, C n^3, X/n, Y/n, Z/n)."""
    return rearrange(x, "b c (x i) (y j) (z k) -> b (c i j k) x y z", i=n, j=n, k=n)


def unfolded(h: Tensor, n: int) -> Tensor:
    """The voxels (B, C, X, Y, Z) that `folded` took apart."""
    return rearrange(h, "b (c i j k) x y z -> b c (x i) (y j) (z k)", i=n, j=n, k=n)


def check_sizes(**sizes: int | Sequence[int]) -> None:
    """Raises ValueError, naming the setting, unless each of a network's sizes is one number above 0 or some."""
    for name, size in sizes.items():
        numbers = [size] if isinstance(size, int) else list(size)
        if not numbers or min(numbers) < 1:
            raise ValueError(f"a network's {name} must be above 0, but {size} was given")


class VolumeUNet(nn.Module):
    """MONAI's DiffusionModelUNet run on blocks of `block`^3 voxels, conditioned on time and on a text context.

    The text enters twice: by cross-attention in the UNet's attention levels, and as a map laid over its input, which
    gives it the report's content early and in place: a KindMap where `kinds` are named, else a TextMap.

    The stem folds each block into channels (a 1x1x1 convolution follows), the last layer unfolds it: the expensive
    top level then runs on (X/block)^3 positions, which is what makes a 64^3 denoiser affordable on a CPU.

    state_channels: channels of the state (CT and masks).
    channels, attention: width of each level, and whether it attends to itself and to the text.
    context_dim: width D of the text context (B, L, D).
    kinds: of findings, each with a map of its own. map_shape: how many blocks along each axis the map of a report
    covers; None: as many as a state has.
    Spatial sizes must be divisible by block * 2^(levels - 1).
    """

    def __init__(
        self,
        state_channels: int = 4,
        block: int = 2,
        channels: tuple[int, ...] = (32, 64, 128),
        attention: tuple[bool, ...] = (False, False, True),
        res_blocks: int = 1,
        head_channels: int = 32,
        context_dim: int = 64,
        kinds: tuple[str, ...] = (),
    ):
        from monai.networks.nets import DiffusionModelUNet

        super().__init__()
        check_sizes(block=block, channels=channels, res_blocks=res_blocks, head_channels=head_channels)
        if len(attention) != len(channels):
            raise ValueError("a network's attention says for each level of its channels whether it attends, but "
                             f"attention {list(attention)} and channels {list(channels)} were given")
        attending = [*(width for width, attends in zip(channels, attention) if attends), channels[-1]]
        if min(attending) < head_channels or any(width % NORM_GROUPS for width in channels):
            raise ValueError(f"a network's channels are multiples of {NORM_GROUPS}, the last and those that attend not "
                             f"below head_channels, but {list(channels)} and head_channels {head_channels} were given")
        self.settings: dict = {
            "state_channels": state_channels, "block": block, "channels": list(channels),
            "attention": list(attention), "res_blocks": res_blocks, "head_channels": head_channels,
            "context_dim": context_dim}
        self.block, self.context_dim, self.state_channels = block, context_dim, state_channels
        self.divisor = block * 2 ** (len(channels) - 1)
        self.map_shape: tuple[int, ...] | None = None
        self.fold = nn.Conv3d(state_channels * block**3, channels[0], 1)
        self.draw_kinds(kinds)
        self.unet = DiffusionModelUNet(
            spatial_dims=3, in_channels=channels[0], out_channels=channels[0], channels=tuple(channels),
            attention_levels=tuple(attention), num_res_blocks=res_blocks, norm_num_groups=NORM_GROUPS,
            num_head_channels=head_channels, with_conditioning=True, cross_attention_dim=context_dim,
            use_flash_attention=True)
        self.unfold = nn.Conv3d(channels[0], state_channels * block**3, 1)
        # MONAI's output convolution starts at zero; two zero layers in a row would never learn.
        nn.init.xavier_uniform_(self.unet.out[-1].get_parameter("conv.weight"))
        silence(self.unfold)
        speed_up(self)
        self.run_with()

    def draw_kinds(self, kinds: Sequence[str]) -> None:
        """A new, untaught map of what reports say: a KindMap, or without kinds a TextMap.

        What the network makes of a map stays where it had one of the same kinds; else the new one changes nothing yet.
        """
        same = bool(kinds) and self.settings.get("kinds") == list(kinds)
        self.text_map = KindMap(self.context_dim, kinds) if kinds else TextMap(self.context_dim)
        if same:
            return
        self.hint = nn.Conv3d(self.text_map.channels, self.settings["channels"][0], 1)
        silence(self.hint)
        speed_up(self.hint)
        if kinds:  # which older files do not name
            self.settings["kinds"] = list(kinds)

    def blocks(self) -> list[nn.Module]:
        """The residual and attention blocks of the UNet, which hold nearly all of its weights and activations."""
        from monai.networks.nets.diffusion_model_unet import DiffusionUNetResnetBlock, SpatialTransformer

        return [m for m in self.unet.modules() if isinstance(m, (DiffusionUNetResnetBlock, SpatialTransformer))]

    def run_with(self, gradient_checkpointing: bool = False, channels_last: bool = True,
                 compiled: bool = False) -> VolumeUNet:
        """Chooses how this network computes; what it computes and the names of its weights stay as they are.

        gradient_checkpointing: keep what enters each block alone, and compute the block again in the backward pass.
        channels_last: lay channels side by side in memory. compiled: torch.compile, anew for each shape of input.
        """
        self.memory_format = torch.channels_last_3d if channels_last else torch.contiguous_format
        lay_out(self, self.memory_format)
        for block in self.blocks():
            vars(block).pop("forward", None)
            if gradient_checkpointing:
                block.forward = partial(checkpoint, MethodType(type(block).forward, block), use_reentrant=False)
        if compiled:
            self.compile(dynamic=False)
        else:
            self._compiled_call_impl = None
        return self

    def blocked(self, x: Tensor) -> Tensor:
        """Voxels (B, C, X, Y, Z) folded into channels, as `fold` takes them: (B, C n^3, X/n, Y/n, Z/n), n = block."""
        return folded(x, self.block).contiguous(memory_format=self.memory_format)

    def hint_over(self, context: Tensor, shape: Sequence[int]) -> Tensor:
        """What the map of a report adds to states of so many blocks: it lies over `map_shape` in their middle, and goes
        on beyond as at its ends."""
        own = self.map_shape or tuple(shape)
        hint = interpolate(self.hint(self.text_map(context)), own, mode="trilinear")
        more = [(n - there) // 2 for n, there in zip(shape, own)]
        return pad(hint, [n for n in reversed(more) for _ in range(2)], mode="replicate") if any(more) else hint

    def forward(self, x: Tensor, t: Tensor, context: Tensor, offset: Tensor | None = None) -> Tensor:
        """x (B, C, X, Y, Z), t (B,) in [0, 1], context (B, L, D) -> (B, C, X, Y, Z).

        offset: (B, channels[0], X/block, ...), added to what enters the UNet; None for none.
        """
        h = self.fold(self.blocked(x))
        h = h if offset is None else h + offset
        h = h + self.hint_over(context, h.shape[2:])
        h = self.unfold(self.unet(h, 1000 * t, context=context))
        return unfolded(h, self.block)
