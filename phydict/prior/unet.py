"""The network behind a prior: MONAI's 3D diffusion UNet between a space-to-depth stem and its inverse."""

from __future__ import annotations

import torch
from einops import rearrange
from monai.networks.nets import DiffusionModelUNet
from torch import Tensor, nn


class VolumeUNet(nn.Module):
    """MONAI's DiffusionModelUNet run on blocks of `block`^3 voxels, conditioned on time and on a text context.

    The stem folds each block into channels (a 1x1x1 convolution follows), the last layer unfolds it: the expensive
    top level then runs on (X/block)^3 positions, which is what makes a 64^3 denoiser affordable on a CPU.

    state_channels: channels of the state (CT and masks).
    channels, attention: width of each level, and whether it attends to itself and to the text.
    context_dim: width D of the text context (B, L, D).
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
    ):
        super().__init__()
        self.settings = {
            "state_channels": state_channels, "block": block, "channels": list(channels),
            "attention": list(attention), "res_blocks": res_blocks, "head_channels": head_channels,
            "context_dim": context_dim}
        self.block, self.context_dim, self.state_channels = block, context_dim, state_channels
        self.divisor = block * 2 ** (len(channels) - 1)
        self.fold = nn.Conv3d(state_channels * block**3, channels[0], 1)
        self.unet = DiffusionModelUNet(
            spatial_dims=3, in_channels=channels[0], out_channels=channels[0], channels=tuple(channels),
            attention_levels=tuple(attention), num_res_blocks=res_blocks, norm_num_groups=8,
            num_head_channels=head_channels, with_conditioning=True, cross_attention_dim=context_dim,
            use_flash_attention=True)
        self.unfold = nn.Conv3d(channels[0], state_channels * block**3, 1)
        # MONAI's output convolution starts at zero; two zero layers in a row would never learn.
        nn.init.xavier_uniform_(self.unet.out[-1].conv.weight)
        nn.init.zeros_(self.unfold.weight)
        nn.init.zeros_(self.unfold.bias)
        self.to(memory_format=torch.channels_last_3d)

    def forward(self, x: Tensor, t: Tensor, context: Tensor) -> Tensor:
        """x (B, C, X, Y, Z), t (B,) in [0, 1], context (B, L, D) -> (B, C, X, Y, Z)."""
        n = self.block
        h = rearrange(x, "b c (x i) (y j) (z k) -> b (c i j k) x y z", i=n, j=n, k=n)
        h = self.fold(h.contiguous(memory_format=torch.channels_last_3d))
        h = self.unfold(self.unet(h, 1000 * t, context=context))
        return rearrange(h, "b (c i j k) x y z -> b c (x i) (y j) (z k)", i=n, j=n, k=n)
