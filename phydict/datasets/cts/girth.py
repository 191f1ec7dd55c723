"""A wider or narrower body around unchanged lungs."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from phydict.grid import Grid

WIDTH_MM = (300.0, 600.0)
"""Widths of the bodies drawn; GROWTH lets those of nine CTs reach 300 to 465."""

BAND, GROWTH = 0.7, (-0.6, 1.2)
"""Inner share of the wall that grows; the range of its growth. The skin moves without stretching."""

RIBS_MM = 12.0
"""What lies outside the box around the lungs and keeps its size: ribs and sternum."""

FRONT, BACK = 0.8, 0.4
"""Growth at the front, and at the back, on which the body lies, over that at the sides."""

POWER = 2.4
"""Exponent of the superellipse around lungs and ribs."""


@dataclass(frozen=True)
class Girth:
    """Growth of what lies outside a superellipse around lungs and ribs, along rays from its axis.

    centre, half: (x, y) and half-axes in mm, from the grid's centre along its axes. band: thickness of the layer that
    grows, and growth: what it gains at the sides, both over the superellipse's half-axis.
    """

    centre: tuple[float, ...]
    half: tuple[float, ...]
    band: float
    growth: float

    @classmethod
    def draw(cls, chance: float, body: torch.Tensor, lung: torch.Tensor, grid: Grid) -> Girth | None:
        """A body of the width at `chance`, in [0, 1], of WIDTH_MM; None without lungs.

        body: (X, Y, Z) bool. lung: (X, Y, Z) share. A body that the grid cuts at its sides does not become narrower.
        """
        places = [(lung > 0.5).any(2).any(axis).nonzero()[:, 0] for axis in (1, 0)]
        if not len(places[0]) or not body.any():
            return None
        ends = [[(float(place[i]) - (n - 1) / 2) * s for i in (0, -1)]
                for place, n, s in zip(places, grid.shape, grid.spacing)]
        half = tuple((high - low + s) / 2 + RIBS_MM for (low, high), s in zip(ends, grid.spacing))
        columns = body.any(2).any(1).nonzero()[:, 0]
        width = (int(columns[-1] - columns[0]) + 1) * grid.spacing[0]
        target = WIDTH_MM[0] + chance * (WIDTH_MM[1] - WIDTH_MM[0])
        if body[0].any() or body[-1].any():
            target = max(target, width)
        band = BAND * max(width / 2 - half[0], 2 * grid.spacing[0])
        growth = min(max((target - width) / 2, GROWTH[0] * band), GROWTH[1] * band)
        return cls(tuple(sum(pair) / 2 for pair in ends), half, band / half[0], growth / half[0])

    def source(self, points: torch.Tensor) -> torch.Tensor:
        """Where points (..., 3) in mm of the changed body lie in the unchanged one."""
        across = points[..., :2] - torch.tensor(self.centre)
        u, v = (across / torch.tensor(self.half)).unbind(-1)
        size = (u.abs() ** POWER + v.abs() ** POWER) ** (1 / POWER)
        slope = (v / size.clamp(min=1e-6)).clamp(-1, 1)
        growth = self.growth * (1 - slope.clamp(min=0) * (1 - FRONT) + slope.clamp(max=0) * (1 - BACK))
        outside, grown = (size - 1).clamp(min=0), self.band + growth
        outside = torch.where(outside < grown, outside * self.band / grown, outside - growth)
        factor = torch.where(size > 1, (1 + outside) / size.clamp(min=1), 1.0)
        moved = across * factor[..., None] + torch.tensor(self.centre)
        return torch.cat([moved, points[..., 2:]], -1)
