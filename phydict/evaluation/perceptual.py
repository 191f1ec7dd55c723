"""LPIPS of a reconstructed volume: its slices in three planes against the truth's."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from phydict.evaluation.metrics import RANGE
from phydict.evaluation.planes import PLANES, slices
from phydict.runtime.lpips_networks import load_lpips, lpips_distances
from phydict.units import HUWindow

BACKBONES = ("alex", "squeeze")
OTHERWISE = "leave lpips out of the metrics"
BATCH = 32
LEAST_SIDE = 31
"""Pixels along each side of the smallest images that all backbones take."""


def load_networks() -> nn.ModuleDict:
    """LPIPS by each of the backbones. Raises FileNotFoundError, in one sentence, where one is not there."""
    return nn.ModuleDict({backbone: load_lpips(backbone, False, OTHERWISE) for backbone in BACKBONES})


def check_sides(shape: Sequence[int]) -> None:
    """Raises ValueError where the slices of volumes of a shape are too small for a backbone."""
    if min(shape) < LEAST_SIDE:
        raise ValueError(f"slices of {' x '.join(map(str, shape))} voxels are too small for LPIPS, which needs "
                         f"{LEAST_SIDE} along each side: give more voxels, or {OTHERWISE}")


@torch.no_grad()
def lpips_scores(hu: Tensor, true_hu: Tensor, device: torch.device | str = "cpu",
                 scored: HUWindow = RANGE) -> dict[str, float]:
    """{"lpips_alex", "lpips_squeeze"}: means over a plane's slices, then over the planes, of volumes (X, Y, Z).

    Both are clipped to the HU range `scored` and mapped to [-1, 1]. Computed in float32 on `device`. Raises as
    `check_sides`.
    """
    check_sides(hu.shape)
    x, y = (scored.to_range(volume.float()).to(device) for volume in (hu, true_hu))
    scores = {}
    for backbone in BACKBONES:
        network = load_lpips(backbone, False, OTHERWISE).to(device)
        means = []
        with torch.autocast(torch.device(device).type, enabled=False):
            for plane in PLANES:
                pairs = zip(slices(x, plane).split(BATCH), slices(y, plane).split(BATCH))
                distances = torch.cat([lpips_distances(network, a, b, OTHERWISE) for a, b in pairs])
                means.append(distances.double().mean())
        scores[f"lpips_{backbone}"] = float(torch.stack(means).mean())
    return scores
