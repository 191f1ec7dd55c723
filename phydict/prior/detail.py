"""The network that adds to a prior's estimate what its blocks of voxels cannot hold."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn.functional import silu

from phydict.prior.convolution import lay_out, silence, speed_up

FREQUENCIES = 8


class DetailNetwork(nn.Module):
    """A few convolutions over single voxels, scaled and shifted by an embedding of the time.

    state_channels: channels of the state. width: channels between the convolutions. layers: convolutions between the
    first and the last. Untrained it answers with zeros.
    """

    def __init__(self, state_channels: int = 4, width: int = 16, layers: int = 2):
        super().__init__()
        self.settings = {"state_channels": state_channels, "width": width, "layers": layers}
        self.enter = nn.Conv3d(2 * state_channels, width, 3, padding=1)
        self.middle = nn.ModuleList(nn.Conv3d(width, width, 3, padding=1) for _ in range(layers))
        self.leave = nn.Conv3d(width, state_channels, 3, padding=1)
        self.time = nn.Sequential(nn.Linear(2 * FREQUENCIES, 64), nn.SiLU(), nn.Linear(64, 2 * width * (layers + 1)))
        silence(self.leave)
        lay_out(self)
        speed_up(self)

    def forward(self, difference: Tensor, estimate: Tensor, t: Tensor, offset: Tensor | None = None) -> Tensor:
        """Difference of state and estimate, and the estimate (B, C, X, Y, Z), at times t (B,) -> (B, C, X, Y, Z).

        offset: (B, width, X, Y, Z), added to what the first convolution gives; None for none.
        """
        phase = math.pi * t[:, None] * torch.arange(1, FREQUENCIES + 1, device=t.device).to(t)
        embedded = self.time(torch.cat([phase.sin(), phase.cos()], 1).to(difference.dtype))
        scales, shifts = embedded[..., None, None, None].unflatten(1, (len(self.middle) + 1, 2, -1)).unbind(2)
        h = torch.cat([difference, 2 * estimate], 1).contiguous(memory_format=torch.channels_last_3d)
        h = self.enter(h) if offset is None else self.enter(h) + offset
        h = silu(torch.addcmul(shifts[:, 0], h, 1 + scales[:, 0]), inplace=True)
        for i, layer in enumerate(self.middle, 1):
            h = silu(torch.addcmul(shifts[:, i], layer(h), 1 + scales[:, i]), inplace=True).add_(h)
        return self.leave(h)
