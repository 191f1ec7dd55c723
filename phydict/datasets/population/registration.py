"""Registration of one prepared CT to another by a stationary velocity field.

    v = argmin  10 |I_moving(exp(v)) - I_fixed|^2 + LNCC / 2 + BENDING |grad v|^2,    v smoothed by a Gaussian

over HU in tissue, the lungs' mask and bone, on voxels that both scans have seen; Adam, coarse to fine. The flow of v
takes places of the fixed CT to those of the moving one. LNCC is MONAI's (Avants et al. 2008,
10.1016/j.media.2007.06.004); tables and clothes are taken away from both before.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from phydict.datasets.case import Case
from phydict.datasets.cts.acquisition import without_table
from phydict.datasets.population.velocity import flow, jacobian, places, resize, sample, smooth
from phydict.grid import Grid
from phydict.units import AIR, HUWindow

MOST_VOXELS = 64
"""Voxels along each side on which CTs are registered; finer ones are averaged."""

LEVELS = ((2, 40, 0.02), (1, 25, 0.01))
"""By how much voxels are averaged, steps of Adam, and its step size in half-widths of the box."""

WIDTH, BENDING = 1.5, 0.6
"""Voxels of the velocity's lattice, twice as wide as those of the images, of the Gaussian; weight of its gradient."""

LEAST_OVERLAP = 0.85
"""Dice coefficient of the lungs below which a CT counts as not registered."""


@dataclass(frozen=True)
class Registered:
    """velocity: (3, x, y, z). overlap: Dice coefficient of the lungs afterwards. least: smallest Jacobian."""

    velocity: Tensor
    overlap: float
    least: float

    @classmethod
    def template(cls, case: Tensor) -> Registered:
        """Of the CT itself to which the others are registered, `features` (4, X, Y, Z)."""
        return cls(torch.zeros(3, *(n // 2 for n in case.shape[1:])), 1.0, 1.0)

    @property
    def fault(self) -> str:
        """Why it is of no use, or ""."""
        if not self.overlap >= LEAST_OVERLAP:
            return f"its lungs overlap the template's by {self.overlap:.2f}, less than {LEAST_OVERLAP}"
        return "" if self.least > 0 else "its deformation tears"


def features(case: Case, grid: Grid, window: HUWindow) -> Tensor:
    """What is registered of a Case: HU of tissue, lungs, bone and what was scanned, (4, X, Y, Z) in [0, 1]."""
    hu = window.to_hu(case["volume"])
    body = without_table(hu, grid)
    whole = torch.cat([(body.clamp(AIR, 300) - AIR) / 1300, case["masks"][:1], (body.clamp(150, 700) - 150) / 550,
                       scanned(hu).expand_as(hu)])
    return resize(whole, [min(n, MOST_VOXELS) for n in grid.shape])


def scanned(hu: Tensor) -> Tensor:
    """1 for the slices of HU (1, X, Y, Z) that the scan reached, (1, 1, 1, Z)."""
    return (hu > AIR + 0.7).any(2, keepdim=True).any(1, keepdim=True).to(hu)


def register(fixed: Tensor, moving: Tensor) -> Registered:
    """Registers `features` (4, X, Y, Z) of two CTs on the same voxels."""
    from monai.losses import LocalNormalizedCrossCorrelationLoss

    correlation = LocalNormalizedCrossCorrelationLoss(kernel_size=5, smooth_dr=1e-3, reduction="none")
    weights = torch.tensor([1.0, 2.0, 1.0]).view(3, 1, 1, 1)
    free = torch.zeros(0)
    for factor, steps, rate in LEVELS:
        shape = [max(n // factor, 8) for n in fixed.shape[1:]]
        lattice = [n // 2 for n in shape]
        f, m, start = resize(fixed, shape), resize(moving, shape), places(shape)
        free = (torch.zeros(3, *lattice) if not free.numel() else resize(free.detach(), lattice)).requires_grad_()
        optimizer = torch.optim.Adam([free], rate)
        for _ in range(steps):
            velocity = smooth(free, WIDTH)
            moved = sample(m, start + resize(flow(velocity), shape))
            coverage = f[3:] * moved[3:]
            error = ((moved[:3] - f[:3]) ** 2 * weights * coverage).sum() + 1e-9
            alike = (correlation(moved[None, :1], f[None, :1])[0] * coverage).sum()
            bent = sum((velocity.diff(dim=a + 1) ** 2).mean() * n**2 for a, n in enumerate(lattice))
            loss = (10 * error + 0.5 * alike) / coverage.sum().clamp(min=1) + BENDING * bent
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
    velocity = smooth(free.detach(), WIDTH)
    points = places(fixed.shape[1:]) + resize(flow(velocity), fixed.shape[1:])
    return Registered(velocity, overlap(sample(moving[1:2], points), fixed[1:2]), float(jacobian(points).min()))


def overlap(a: Tensor, b: Tensor) -> float:
    """Dice coefficient of two masks (...) of shares; 0 where both are empty."""
    a, b = a > 0.5, b > 0.5
    return float(2 * (a & b).sum() / (a.sum() + b.sum()).clamp(min=1))


def medoid(cases: list[Tensor]) -> int:
    """Which of several CTs' features (4, X, Y, Z) is nearest to all: least sum of RMSE of coarse HU and lungs."""
    coarse = torch.stack([resize(case[:2], [16] * 3).flatten() for case in cases])
    return int(torch.cdist(coarse, coarse).sum(1).argmin())
