"""Rivals small enough for tests, whose networks answer to their X-rays although they are untrained."""

from __future__ import annotations

from collections.abc import Callable

import torch
from scenes import WINDOW

from phydict.grid import Grid
from phydict.rivals import LiftedNetwork, Rival, X2CTNetwork, XrayToCTPANetwork
from phydict.rivals.network import RivalNetwork
from phydict.rivals.rival import bound_orbit
from phydict.xray import ConeBeam

GRID = Grid.cube(16)


def lively(make: Callable[[], RivalNetwork], seed: int = 0) -> RivalNetwork:
    """A new network with random weights where layers that start at zero would let nothing show."""
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        network = make()
        for weight in network.parameters():
            if weight.ndim > 1:
                torch.nn.init.normal_(weight, std=0.1)
    return network


def tiny_lifted(grid: Grid = GRID, seed: int = 0) -> Rival:
    network = lively(lambda: LiftedNetwork((4, 6), 2, 4, (4, 6, 8)), seed)
    return Rival(network, grid, WINDOW).eval().requires_grad_(False)


def tiny_x2ct(grid: Grid = GRID, views: int = 2) -> Rival:
    network = lively(lambda: X2CTNetwork(8, 4, (2, 2), (4, 8, 8)))
    return Rival(network, grid, WINDOW, bound_orbit(grid, views)).eval().requires_grad_(False)


def tiny_xray2ctpa(grid: Grid = GRID, views: int = 2) -> Rival:
    network = lively(lambda: XrayToCTPANetwork((4, 4), 8, (4, 8), (4, 8), 4))
    network.latent_size.fill_(1.0)
    return Rival(network, grid, WINDOW, bound_orbit(grid, views)).eval().requires_grad_(False)


def tilted(views: int, shape: tuple[int, int] = (31, 28)) -> ConeBeam:
    """Views of an orbit whose detectors are turned in their plane and moved off the central ray."""
    beam = ConeBeam.orbit(views, 1020, 740, shape, 20.0, arc_degrees=200)
    u, v = beam.u + 0.3 * beam.v, beam.v - 0.3 * beam.u
    return ConeBeam(beam.sources, beam.detectors + 2 * beam.u - beam.v, u, v, beam.shape)
