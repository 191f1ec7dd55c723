"""A rival's network with all that it was trained for: grid, HU window and, where it is bound to one, geometry."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn

from phydict.grid import Grid
from phydict.prior.stage_file import header_start
from phydict.rivals.network import RivalNetwork
from phydict.units import HUWindow
from phydict.xray import ConeBeam, binning
from phydict.xray.binning import benchmark_orbit

WATER_MM = 200.0
"""mm of water that the networks take as 1."""

SAME_MM = 0.01
"""mm by which sources, detectors' centres and pixels' sides may differ from those of the training."""


def bound_orbit(grid: Grid, views: int, arc_degrees: float = 360.0) -> ConeBeam:
    """The benchmarks' orbit with its detector binned to what the grid can hold."""
    beam = benchmark_orbit(grid, views, arc_degrees)
    return beam.binned(binning(grid, beam))


class Rival(nn.Module):
    """A network, and what it holds for.

    beam: the geometry of a bound network, its detector binned to what the grid can hold; None for others. budget: the
    steps and samples of its training, as its file tells; empty where nothing does.
    Raises ValueError where the grid does not suit the network, or where one of beam and network is bound alone.
    """

    def __init__(self, network: RivalNetwork, grid: Grid, window: HUWindow, beam: ConeBeam | None = None):
        super().__init__()
        network.check(grid)
        if network.bound != (beam is not None):
            raise ValueError(f"{type(network).__name__} is {'' if network.bound else 'not '}bound to one geometry, "
                             f"but {'none' if beam is None else 'one'} was given")
        self.network, self.grid, self.window, self.beam = network, grid, window, beam
        self.budget: dict[str, int] = {}

    def describe(self) -> dict:
        """What the rival is, as plain JSON values; `phydict.rivals.build_rival` builds it again."""
        return header_start(self.network.stage, self.grid, self.window) | {
            "network": self.network.settings, "beam": None if self.beam is None else self.beam.to_dict()}

    def network_inputs(self, shape: Sequence[int]) -> tuple[Tensor, ...]:
        """Arguments of the network for X-rays of a volume of `shape`, its grid's: eight views where any number do."""
        return self.network.inputs(self.grid, self.beam or bound_orbit(self.grid, 8))

    def check(self, grid: Grid, beam: ConeBeam) -> None:
        """Raises ValueError unless X-rays of this beam can be reconstructed on this grid."""
        if not self.grid.same_as(grid):
            raise ValueError(
                f"the rival was trained on {self.grid.shape} voxels of {self.grid.spacing} mm, but {grid.shape} of "
                f"{grid.spacing} mm were given: give its own")
        if self.beam is None:
            return
        if self.beam.views != beam.views:
            raise ValueError(f"the rival was trained for {self.beam.views} X-rays, but {beam.views} were given: give "
                             "as many, or a rival's file for this number")
        if not self.beam.same_as(beam, SAME_MM):
            raise ValueError(f"the rival was trained for one geometry of its {beam.views} views, detectors of "
                             f"{self.beam.shape[0]} x {self.beam.shape[1]} pixels, but another was given: give X-rays "
                             "of its own, or use a method for any geometry")

    def forward(self, water: Tensor, beam: ConeBeam) -> Tensor:
        """Line integrals (B, K, V, U) in mm of water -> CT (B, 1, X, Y, Z) in [-1, 1], without clipping."""
        y = water / WATER_MM
        return self.network(y, *self.network.geometry(self.grid, beam, y))

    def reconstruct(self, water: Tensor, beam: ConeBeam, generator: torch.Generator,
                    on_step: Callable[[], None] = lambda: None) -> Tensor:
        """As `forward`, within [-1, 1], by as many steps as the network takes."""
        y = water / WATER_MM
        ct = self.network.reconstruct(y, self.network.geometry(self.grid, beam, y), generator, on_step)
        return ct.to(water).clamp(-1, 1)
