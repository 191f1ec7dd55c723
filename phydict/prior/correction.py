"""The network of the refinement on finer voxels: what an estimate there lacks."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import silu

from phydict.grid import Grid
from phydict.prior.convolution import lay_out, silence, speed_up
from phydict.prior.evidence_channels import EVIDENCE_CHANNELS
from phydict.prior.finer_uncertainty import FinerUncertainty
from phydict.prior.local_unet import PositionNorm, prolonged, slab_by_slab, unnormalised_unet
from phydict.prior.stage_file import header_start
from phydict.runtime.precision import network_precision
from phydict.units import HUWindow

INPUTS = 1 + EVIDENCE_CHANNELS
"""The estimate and the evidence there."""

TOLERANCE = 0.01
"""A share of the spacing by which voxels may differ from those learnt on."""


class CorrectionNetwork(nn.Module):
    """Learns what an estimate of a CT lacks on fine voxels, from it and from the evidence there.

    A UNet, whose result is normalised voxel by voxel and joined with what it saw by a head of two convolutions: at a
    voxel the answer depends on voxels up to `reach` away alone. Untrained it corrects nothing.

    channels: width of each level of the UNet, the first at half the resolution. width: of the head. grid: of the fine
    voxels. window: HU that the range [-1, 1] stands for. uncertainty: what knows how far the result may be off.
    """

    uncertainty: FinerUncertainty | None

    def __init__(self, channels: tuple[int, ...] = (32, 64, 96), width: int = 16, grid: Grid = Grid.cube(128),
                 window: HUWindow = HUWindow(), uncertainty: FinerUncertainty | None = None):
        super().__init__()
        self.grid, self.window, self.uncertainty = grid, window, uncertainty
        self.settings = {"channels": list(channels), "width": width}
        self.divisor = 2 ** (len(channels) - 1)
        self.unet = unnormalised_unet(INPUTS, width, channels, residual_units=2)
        self.norm = PositionNorm(width)
        self.join = nn.Conv3d(width + INPUTS, width, 3, padding=1)
        self.leave = nn.Conv3d(width, 1, 1)
        silence(self.leave)
        speed_up(self)
        lay_out(self)

    def describe(self) -> dict:
        """What the network is, as plain JSON values, for `build_correction`."""
        uncertainty = {"uncertainty": self.uncertainty.settings} if self.uncertainty else {}
        return header_start("refinement", self.grid, self.window) | {"network": self.settings, **uncertainty}

    @property
    def network(self) -> CorrectionNetwork:
        return self

    def network_inputs(self, shape: Sequence[int]) -> tuple[Tensor]:
        """As for a Prior."""
        return (torch.zeros(1, INPUTS, *shape),)

    @property
    def reach(self) -> int:
        """Voxels beyond which nothing changes the result (a bound)."""
        return 8 * self.divisor - 5

    def suits(self, grid: Grid, window: HUWindow) -> bool:
        """Whether it was trained for this HU window and for voxels of this size, or twice as long ones, wherever they
        are: what it has learnt of these serves voxels half as long as well."""
        return window == self.window and any(self._has_voxels(grid, times) for times in (1, 2))

    def _has_voxels(self, grid: Grid, times: int) -> bool:
        """Whether its own voxels are so many times as long as a grid's."""
        return np.allclose(np.multiply(times, grid.spacing), self.grid.spacing, rtol=TOLERANCE)

    def forward(self, seen: Tensor) -> Tensor:
        """The corrected estimate (B, 1, X, Y, Z) of an estimate and its evidence (B, INPUTS, X, Y, Z), in the prior's
        range, for any sizes."""
        padded = prolonged(seen, self.divisor).contiguous(memory_format=torch.channels_last_3d)
        x, y, z = seen.shape[2:]
        lacking = slab_by_slab(self.unet, self._head, padded)
        return seen[:, :1] + lacking[..., :x, :y, :z].to(seen.dtype)

    def _head(self, found: Tensor, seen: Tensor) -> Tensor:
        return self.leave(silu(self.join(torch.cat([self.norm(found), seen], 1))))

    @torch.no_grad()
    def corrected(self, z: Tensor, evidence: Tensor, precision: str = "auto") -> Tensor:
        """As `forward`, of the estimate z (B, 1, X, Y, Z), held inside the range, in a precision of
        phydict.runtime.precision."""
        with network_precision(precision, z):
            return self.to(z.device)(torch.cat([z, evidence], 1)).clamp(-1, 1)

    @torch.no_grad()
    def half_widths(self, grid: Grid, seen: Tensor, precision: str = "auto") -> Tensor | None:
        """As FinerUncertainty's, where there is one and voxels are those it learnt on, and else None."""
        if self.uncertainty is None or not self._has_voxels(grid, 1):
            return None
        self.to(seen.device)
        with network_precision(precision, seen):
            return self.uncertainty.half_widths(seen)
