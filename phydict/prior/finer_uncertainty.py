"""How far a reconstruction on finer voxels may be off, given how far the coarse one that it refines may."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn.functional import silu

from phydict.prior.convolution import lay_out, speed_up
from phydict.prior.local_unet import prolonged, slab_by_slab, unnormalised_unet
from phydict.prior.uncertainty import LEVELS, LOG_SCALE, TISSUES, quantiles_of, steepness, tissue_of

INPUT_CHANNELS = 4
"""The estimate, what it was interpolated from, the coarse interval's half-width, the share of lung."""

INPUT_LEVEL = 0.9
"""The level of the coarse interval that is seen."""

LEAST_WIDTH = 0.003
"""In the prior's range: 3 HU of a window of 2000."""


class FinerUncertainty(nn.Module):
    """The scale b of the error of each finer voxel, and from it the half-widths of intervals.

    A UNet of its INPUT_CHANNELS and of its steepness, joined with these by a head of two convolutions, answers with
    log(b / w), w the coarse interval's half-width: what widens coarse intervals widens these. It learns as
    `Uncertainty` does, and is calibrated as that is, by tissue alone.

    channels: width of each level of the UNet, the first at half the resolution. width: of the head.
    """

    quantiles: Tensor

    def __init__(self, channels: tuple[int, ...] = (8, 16, 32), width: int = 16):
        super().__init__()
        self.settings = {"channels": list(channels), "width": width}
        self.divisor = 2 ** (len(channels) - 1)
        self.unet = unnormalised_unet(INPUT_CHANNELS + 1, width, channels, residual_units=1)
        self.join = nn.Conv3d(width + INPUT_CHANNELS + 1, width, 3, padding=1)
        self.leave = nn.Conv3d(width, 1, 1)
        speed_up(self)
        lay_out(self)
        self.register_buffer("quantiles", -torch.log1p(-torch.tensor(LEVELS)).expand(len(TISSUES), -1).clone())

    def forward(self, seen: Tensor) -> Tensor:
        """log b (B, 1, X, Y, Z) of its input (B, INPUT_CHANNELS, X, Y, Z), both in the prior's range, for any sizes."""
        z, before, width, lung = prolonged(seen, self.divisor).split(1, 1)
        log_width = width.clamp(min=LEAST_WIDTH).log()
        given = torch.cat([z, 2 * (z - before).abs(), 2 * steepness(z), log_width / 2 + 1.5, lung], 1)
        ratio = slab_by_slab(self.unet, self._head, given)
        log_scale = (log_width - 0.8 + ratio.float()).clamp(*LOG_SCALE)
        x, y, z_size = seen.shape[2:]
        return log_scale[..., :x, :y, :z_size]

    def _head(self, found: Tensor, given: Tensor) -> Tensor:
        return self.leave(silu(self.join(torch.cat([found, given], 1))))

    def half_widths(self, seen: Tensor) -> Tensor:
        """Half-widths (B, len(LEVELS), X, Y, Z), in the prior's range, of the intervals around the CT."""
        return self.quantiles[tissue_of_seen(seen)].movedim(-1, 1) * self(seen).exp()

    @torch.no_grad()
    def calibrate(self, ratios: Tensor, tissues: Tensor) -> None:
        """Sets the quantiles to those of held-out patients: ratios |e| / b of voxels (N,), and their tissues (N,)."""
        for t in range(len(TISSUES)):
            self.quantiles[t] = quantiles_of(ratios[tissues == t], ratios)


def tissue_of_seen(seen: Tensor) -> Tensor:
    """The index in TISSUES (B, X, Y, Z) of the voxels of what is seen (B, INPUT_CHANNELS, X, Y, Z)."""
    return tissue_of(torch.cat([seen[:, :1], 2 * seen[:, 3:] - 1], 1))
