"""The slices of a volume (X, Y, Z) in RAS+ in its three planes, named as in MAISI's script."""

from __future__ import annotations

from torch import Tensor

PLANES = {"xy": 2, "yz": 0, "zx": 1}
"""Plane -> the axis across it: axial, sagittal, coronal."""


def slices(volume: Tensor, plane: str) -> Tensor:
    """Every slice (N, H, W) of a volume (X, Y, Z) in one plane."""
    return volume.movedim(PLANES[plane], 0)
