"""A prior of one's own: smooth volumes around one HU value."""

from dataclasses import dataclass

import torch

from phydict.diffusion import CosineSchedule
from phydict.grid import Grid
from phydict.prior import PriorContract
from phydict.units import HUWindow


@dataclass(frozen=True)
class Smooth:
    """Answers with smoothed states, the more drawn towards `level` in [-1, 1] the noisier they are."""

    level: float
    schedule: CosineSchedule = CosineSchedule()

    def denoise(self, x, t):
        signal, noise = (float(w) for w in self.schedule.scales(t))
        smooth = torch.nn.functional.avg_pool3d(x, 3, 1, 1, count_include_pad=False) / signal
        return torch.lerp(smooth, torch.full_like(x, self.level), noise**2)


class MyPrior(PriorContract):
    grid, window = Grid.cube(32), HUWindow()

    def __init__(self, hu: float = -500.0):
        self.hu = hu

    def bind(self, report, guidance, precision):
        return Smooth(float(self.window.to_range(torch.tensor(self.hu))))
