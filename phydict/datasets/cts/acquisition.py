"""Changes of how a chest was scanned, on a prepared volume: contrast agent, table, field of view, height."""

from __future__ import annotations

import numpy as np
import torch

from phydict.datasets.cts.anatomy import body_mask
from phydict.grid import Grid
from phydict.units import AIR

LEAST_BLOOD = 45.0
"""HU of blood without contrast agent, below which none is lowered."""

SPINE_SHARE = 0.33
"""Hindmost share of the lungs' depth, where the spine lies between the lungs."""

BODY_MARGIN = 1
"""Voxels around the body that are kept when the table is taken away, for its partial volume."""


def change_contrast(hu: torch.Tensor, masks: torch.Tensor, amount: float) -> torch.Tensor:
    """HU (1, X, Y, Z) with `amount` HU more contrast agent in the blood, or less if negative.

    masks: (3, X, Y, Z), lung, airway and vessel shares. Blood is what lies between the lungs in front of the spine with
    more than 20 HU, fully so from 60 HU, and the vessels in the lungs. Blood is not lowered below LEAST_BLOOD. Without
    lungs nothing changes. The axes are taken to run as RAS+.
    """
    lung = masks[0] > 0.5
    rows = lung.any(2).any(0).nonzero()
    if not len(rows):
        return hu
    right, left = lung.int().cummax(0).values, lung.int().flip(0).cummax(0).values.flip(0)
    between = (right * left * ~lung).float()
    front = float(rows[0]) + SPINE_SHARE * float(rows[-1] - rows[0])
    between[:, :int(np.ceil(front))] = 0
    between = torch.nn.functional.avg_pool3d(between[None, None], 3, 1, 1)[0]
    blood = between * ((hu - 20) / 40).clamp(0, 1)
    changed = hu + amount * blood
    if amount < 0:
        changed = torch.maximum(changed, hu.clamp(max=LEAST_BLOOD))
    return changed + amount * masks[2:3] * (1 - between)


def without_table(hu: torch.Tensor, grid: Grid, body: torch.Tensor | None = None) -> torch.Tensor:
    """HU (1, X, Y, Z) with air for all that does not belong to the body: table, clothes, cables.

    body: (X, Y, Z) bool, found in `hu` if left out.
    """
    body = torch.from_numpy(body_mask(hu[0].numpy(), grid.spacing)) if body is None else body
    around = torch.nn.functional.max_pool3d(body[None, None].float(), 2 * BODY_MARGIN + 1, 1, BODY_MARGIN)[0]
    return torch.where(around > 0, hu, AIR) if body.any() else hu


def cut_field(hu: torch.Tensor, masks: torch.Tensor, grid: Grid, diameter: float,
              centre: tuple[float, float] = (0.0, 0.0)) -> tuple[torch.Tensor, torch.Tensor]:
    """HU and masks seen through a scanner's circular field of view: air, and masks of 0, outside.

    diameter: mm. centre: (x, y) mm from the grid's centre, along its axes.
    """
    x, y = ((torch.arange(n) - (n - 1) / 2) * s - c for n, s, c in zip(grid.shape, grid.spacing, centre))
    edge = (torch.hypot(x[:, None], y) - diameter / 2) / float(np.mean(grid.spacing[:2]))
    inside = (0.5 - edge).clamp(0, 1)[..., None]
    return AIR + inside * (hu - AIR), masks * inside


def cut_ends(hu: torch.Tensor, masks: torch.Tensor, grid: Grid, low: float,
             high: float) -> tuple[torch.Tensor, torch.Tensor]:
    """HU and masks of a scan from z = `low` to `high`, mm from the grid's centre: air, and masks of 0, beyond."""
    z = (torch.arange(grid.shape[2]) - (grid.shape[2] - 1) / 2) * grid.spacing[2]
    inside = (0.5 + torch.minimum(z - low, high - z) / grid.spacing[2]).clamp(0, 1)
    return AIR + inside * (hu - AIR), masks * inside
