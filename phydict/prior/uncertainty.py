"""How far a refiner's reconstruction may be off, voxel by voxel."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn

from phydict.prior.convolution import speed_up
from phydict.prior.evidence_channels import COVERAGE_SCALE, EVIDENCE_CHANNELS
from phydict.prior.local_unet import unnormalised_unet

LEVELS = (0.5, 0.8, 0.9, 0.95)
"""The shares of voxels that intervals are to hold."""

TISSUES = ("lung", "body", "air")
"""What a voxel may be: by the lung's mask, else by its HU on the two sides of AIR_BELOW."""

AIR_BELOW = -0.6
"""In the prior's range."""

COVERAGES = 6
"""Bins of log2(1 + n), rounded, n the number of views that see a voxel: 0, 1, 2 to 4, 5 to 10, 11 to 21 and more."""

LOG_SCALE = (-7.0, 2.0)
"""Least and most log b."""

UNBOUNDED = 1e4
"""The most residual of a network that was not calibrated."""

INPUTS = 3
"""Beside state and evidence: the steepness of the CT and the sizes of two channels of the evidence, the changes."""


class Uncertainty(nn.Module):
    """The scale b of the error e of each voxel's CT, and from it the half-widths of intervals.

    A UNet of the state z (B, C, X, Y, Z) and the evidence there (B, EVIDENCE_CHANNELS, X, Y, Z) answers with log b; it
    learns to by the likelihood of a Laplace distribution, |e| / b + log b. An interval of level p is z -+ q b, where q
    is the p-quantile of |e| / b over voxels of the same tissue and coverage of patients that were not learnt from
    (split conformal prediction: Angelopoulos & Bates 2023, doi:10.1561/2200000101); before calibration it is the
    distribution's own, -log(1 - p).

    state_channels: C; channels: width of each level of the UNet.
    """

    quantiles: Tensor
    most_residual: Tensor

    def __init__(self, state_channels: int = 4, channels: tuple[int, ...] = (16, 32, 64)):
        super().__init__()
        self.settings = {"state_channels": state_channels, "channels": list(channels)}
        self.unet = unnormalised_unet(state_channels + EVIDENCE_CHANNELS + INPUTS, 1, channels, residual_units=2)
        speed_up(self)
        quantiles = -torch.log1p(-torch.tensor(LEVELS))
        self.register_buffer("quantiles", quantiles.expand(len(TISSUES), COVERAGES, -1).clone())
        self.register_buffer("most_residual", torch.tensor(UNBOUNDED))

    def forward(self, z: Tensor, evidence: Tensor) -> Tensor:
        """log b (B, 1, X, Y, Z), b in the prior's range."""
        sizes = evidence[:, 2:4].abs()
        return self.unet(torch.cat([z, evidence, 2 * steepness(z[:, :1]), sizes], 1)).float().sub(3.5).clamp(*LOG_SCALE)

    def half_widths(self, z: Tensor, evidence: Tensor) -> Tensor:
        """Half-widths (B, len(LEVELS), X, Y, Z), in the prior's range, of the intervals around the CT of z."""
        factors = self.quantiles[tissue_of(z), coverage_of(evidence)]
        return factors.movedim(-1, 1) * self(z, evidence).exp()

    @torch.no_grad()
    def calibrate(self, ratios: Tensor, tissues: Tensor, coverages: Tensor, residuals: Tensor) -> None:
        """Sets the quantiles to those of held-out patients.

        ratios: |e| / b of voxels (N,); tissues, coverages: what `tissue_of` and `coverage_of` say of them (N,);
        residuals: of the reconstructions' X-rays, in units of their noise. A tissue or coverage of few
        voxels takes the quantiles of all. ORDINARY of the residuals are no larger than `most_residual`.
        """
        for t in range(len(TISSUES)):
            of_tissue = ratios[tissues == t]
            for n in range(COVERAGES):
                self.quantiles[t, n] = quantiles_of(ratios[(tissues == t) & (coverages == n)], of_tissue, ratios)
        self.most_residual.copy_(residuals.quantile(ORDINARY))


FEWEST = 2000
"""Voxels from which a tissue and a coverage have quantiles of their own."""
ORDINARY = 0.9
"""The share of a calibration's scenes whose residual widens nothing: the largest of 48 was twice the next."""


def quantiles_of(*ratios: Tensor) -> Tensor:
    """Those of LEVELS (len(LEVELS),), of the first of several sets of values (N,) that are not few, or the last;
    torch's own take no more than 2^24 values."""
    enough = next((values for values in ratios if len(values) >= FEWEST), ratios[-1])
    return torch.from_numpy(np.quantile(enough.cpu().numpy(), LEVELS)).to(enough)


def steepness(ct: Tensor) -> Tensor:
    """The size of the differences along the three axes, summed, of a CT (B, 1, X, Y, Z)."""
    return sum((torch.gradient(ct, dim=d)[0].abs() for d in (2, 3, 4)), start=torch.zeros_like(ct))


def tissue_of(z: Tensor) -> Tensor:
    """The index in TISSUES (B, X, Y, Z) of the voxels of a state (B, C, X, Y, Z)."""
    outside = (z[:, 0] < AIR_BELOW).long() + 1
    return torch.where(z[:, 1] > 0, 0, outside) if z.shape[1] > 1 else outside


def coverage_of(evidence: Tensor) -> Tensor:
    """The bin of coverage (B, X, Y, Z) of the voxels of an evidence."""
    return (evidence[:, 1] / COVERAGE_SCALE).round().long().clamp(0, COVERAGES - 1)
