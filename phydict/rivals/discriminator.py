"""The adversary that X2CT-GAN's generator learns against."""

from __future__ import annotations

from itertools import pairwise

import torch
from torch import Tensor, nn

from phydict.prior.convolution import channels_last, speed_up


class PatchDiscriminator(nn.Module):
    """Whether each patch of a CT looks real beside the X-rays lifted into it (Isola et al. 2017, arXiv:1611.07004).

    views: channels of X-rays; width: channels of the first layer, doubled by each of `layers`.
    """

    def __init__(self, views: int, width: int, layers: int):
        super().__init__()
        widths = [1 + views, *(width * 2**n for n in range(layers + 1))]
        self.layers = nn.ModuleList(nn.Conv3d(a, b, 4, 2 if n < layers else 1, 1 if n < layers else 2)
                                    for n, (a, b) in enumerate(pairwise(widths)))
        self.leave = nn.Conv3d(widths[-1], 1, 4, 1, 1)
        for layer in (*self.layers, self.leave):
            nn.init.normal_(layer.weight, std=0.02)
        speed_up(self)
        channels_last(self)

    def forward(self, ct: Tensor, lifted: Tensor) -> Tensor:
        """CT (B, 1, X, Y, Z) and lifted X-rays (B, K, X, Y, Z) -> one score for each patch."""
        h = torch.cat([ct, lifted.to(ct)], 1)
        for n, layer in enumerate(self.layers):
            h = layer(h)
            h = nn.functional.leaky_relu(h if n == 0 else nn.functional.instance_norm(h), 0.2)
        return self.leave(h)
