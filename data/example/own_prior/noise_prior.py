"""A prior of one's own whose network predicts the noise, as DDPM's do (arXiv:2006.11239)."""

import math
from dataclasses import dataclass

import torch

from phydict.diffusion import CosineSchedule
from phydict.grid import Grid
from phydict.prior import PriorContract
from phydict.units import HUWindow


@dataclass(frozen=True)
class LinearDDPM(CosineSchedule):
    """beta rises linearly from 1e-4 to 0.02 in 1000 steps: -log(alpha_bar) is 0.1 t + 9.95 t^2 at t = step / 1000."""

    floor: float = 1e-5

    def alpha_bar(self, t):
        t = torch.as_tensor(t, dtype=None if isinstance(t, torch.Tensor) else torch.float64)
        return torch.exp(-0.1 * t - 9.95 * t**2).clamp(self.floor, 1 - self.floor)

    def time(self, sigma):
        return min((math.sqrt(0.01 + 39.8 * math.log1p(sigma**2)) - 0.1) / 19.9, 1.0)


class Network(torch.nn.Module):
    """In the place of a trained one: the noise in x (B, 1, X, Y, Z) at steps (B,)."""

    def __init__(self):
        super().__init__()
        self.layer = torch.nn.Conv3d(2, 1, 3, padding=1)

    def forward(self, x, steps):
        return self.layer(torch.cat([x, (steps / 1000).view(-1, 1, 1, 1, 1).expand_as(x)], 1))


@dataclass(frozen=True)
class NoiseDenoiser:
    network: torch.nn.Module
    schedule: LinearDDPM = LinearDDPM()

    def denoise(self, x, t):
        signal, noise = (float(weight) for weight in self.schedule.scales(t))
        predicted = self.network(x, torch.full((len(x),), 1000 * float(t)).to(x))
        return ((x - noise * predicted) / signal).clamp(-1, 1)


class NoisePrior(PriorContract, torch.nn.Module):
    """file: of the network's state_dict; none leaves it untrained."""

    grid, window = Grid.cube(32), HUWindow()  # of the volumes that it learnt from
    precision = "float32"

    def __init__(self, file: str = ""):
        super().__init__()
        self.network = Network()
        if file:
            self.network.load_state_dict(torch.load(file))

    def bind(self, report, guidance, precision):
        return NoiseDenoiser(self.network)
