"""Where organs lie in a CT, roughly, and fields that make one of them larger or smaller.

    heart    soft tissue between the lungs, in front of the spine, from 0.15 to 0.55 of the lungs' height
    liver    soft tissue under the right lung, down to 80 mm below the lungs
"""

from __future__ import annotations

import torch
from torch import Tensor

from phydict.grid import Grid

ORGANS = ("lungs", "heart", "liver")
SPINE_SHARE = 0.4
"""Hindmost share of the lungs' depth that does not belong to the heart."""

PULL = {"lungs": (0.6, 0.8, 1.6), "heart": (1.0, 1.0, 1.0), "liver": (0.8, 0.8, 1.4)}
"""How easily the surroundings give way along x, y and z: the diaphragm moves more than the ribs."""


def organs(hu: Tensor, masks: Tensor, grid: Grid) -> dict[str, Tensor]:
    """Shares (X, Y, Z) of each of ORGANS by HU (X, Y, Z) and masks (3, X, Y, Z); of zeros without lungs."""
    lung = masks[0] > 0.5
    shares = {"lungs": masks[0], "heart": torch.zeros_like(hu), "liver": torch.zeros_like(hu)}
    if not lung.any():
        return shares
    rows, heights = (lung.any(2).any(0).nonzero()[:, 0], lung.any(0).any(0).nonzero()[:, 0])
    front = int(rows[0] + SPINE_SHARE * (rows[-1] - rows[0]))
    low, high = int(heights[0]), int(heights[-1])
    soft = (hu > -30) & (hu < 400) & ~lung
    between = lung.int().cummax(0).values * lung.int().flip(0).cummax(0).values.flip(0) > 0
    heart = soft & between
    heart[:, :front] = False
    heart[..., :low + round(0.15 * (high - low))] = False
    heart[..., low + round(0.55 * (high - low)):] = False
    liver = soft & (lung.int().flip(2).cummax(2).values.flip(2) > 0)
    liver[..., :max(0, low - round(80 / grid.spacing[2]))] = False
    liver[..., (low + high) // 2:] = False
    middle = int(lung.any(2).any(1).nonzero()[:, 0].float().mean())
    liver[:max(0, middle - round(20 / grid.spacing[0]))] = False
    return shares | {"heart": heart.to(hu), "liver": liver.to(hu)}


def expansion(organ: Tensor, extent, pull: tuple[float, float, float]) -> Tensor:
    """The velocity (3, X, Y, Z), in half-widths of the box, with a mean divergence of 1 in an organ, and 0 around it.

    It is the flow of a fluid that wells up in the organ: v = D grad p, div(D grad p) = organ, D = diag(pull), solved by
    Fourier transform in a box twice as wide. exp(s v) multiplies the organ's volume by about e^s.
    organ: shares (X, Y, Z). extent: (3,) mm.
    """
    organ = organ * organ.sum() / organ.square().sum().clamp(min=1e-6)
    extent = torch.as_tensor(extent, dtype=torch.float32)
    double = [2 * n for n in organ.shape]
    frequencies = torch.meshgrid(*[torch.fft.fftfreq(n, float(length) / half) for n, half, length in zip(
        double, organ.shape, extent)], indexing="ij")
    waves = 2 * torch.pi * torch.stack(frequencies)
    eased = torch.tensor(pull).view(3, 1, 1, 1) * waves
    source = torch.fft.fftn(organ, double)
    potential = source / (waves * eased).sum(0).clamp(min=1e-12)
    potential[0, 0, 0] = 0
    velocity = torch.fft.ifftn(-1j * eased * potential, dim=(1, 2, 3)).real
    return velocity[(slice(None), *(slice(0, n) for n in organ.shape))] * 2 / extent.view(3, 1, 1, 1)
