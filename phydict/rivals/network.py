"""What a rival's network promises: X-rays and their geometry in, a CT in [-1, 1] out."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

from phydict.grid import Grid
from phydict.xray import ConeBeam

Geometry = tuple[Tensor, ...]
"""Grid and beam, as inputs of a network."""


class RivalNetwork(nn.Module, ABC):
    """A network that maps X-rays to a CT.

    stage: what a file's header and a training call it. bound: whether its weights hold for the geometry alone that it
    was trained for. settings: the arguments that build it again, plain JSON values. divisor: of the grid's sizes.
    X-rays y (B, K, V, U) are line integrals in units of 200 mm of water, so that those of a chest lie near 1.
    """

    stage = ""
    bound = False
    settings: dict
    divisor = 1

    def check(self, grid: Grid) -> None:
        """Raises ValueError unless the network can be run on this grid."""
        if any(size % self.divisor for size in grid.shape):
            raise ValueError(f"this network needs sizes divisible by {self.divisor}, but the grid has {grid.shape}: "
                             "set model.cube.voxels to a multiple, or give the network fewer levels")

    @abstractmethod
    def geometry(self, grid: Grid, beam: ConeBeam, like: Tensor) -> Geometry:
        """What the network needs to know of grid and beam, as tensors of the type and on the device of `like`."""

    @abstractmethod
    def forward(self, *inputs: Any, **named: Any) -> Tensor:
        """X-rays y (B, K, V, U) -> CT (B, 1, X, Y, Z) in [-1, 1], without clipping; of a diffusion, what a step of its
        training calls, with the arguments of `inputs`."""

    def steps(self) -> int:
        """How often `reconstruct` calls on_step."""
        return 1

    def reconstruct(self, y: Tensor, geometry: Geometry, generator: torch.Generator,
                    on_step: Callable[[], None] = lambda: None) -> Tensor:
        """The CT of y, as `forward`; the generator is the only source of randomness."""
        ct = self(y, *geometry)
        on_step()
        return ct

    def inputs(self, grid: Grid, beam: ConeBeam) -> tuple[Tensor, ...]:
        """Arguments of `forward` for one case, all zeros but for what they tell of the geometry."""
        y = torch.zeros(1, beam.views, *beam.shape)
        return y, *self.geometry(grid, beam, y)
