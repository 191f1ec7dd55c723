"""Balls that benchmarks put into lungs: their volume and place, and the share of their contrast that is shown."""

import math

import numpy as np
import pytest
import torch
from benchmark.balls import nodule, recovered_contrast

from phydict.grid import Grid

GRID = Grid.box((40, 24, 60), (120.0, 72.0, 120.0))  # 3, 3 and 2 mm


@pytest.mark.parametrize("diameter", [6.0, 12.0, 20.0])
def test_a_nodule_has_its_volume_and_its_contrast_is_recovered(diameter):
    centre = (10.0, -5.0, 7.0)
    ball = nodule(GRID, centre, diameter)
    assert float(ball.sum()) * math.prod(GRID.spacing) == pytest.approx(math.pi / 6 * diameter**3, rel=0.15)
    without = torch.full(GRID.shape, -850.0)
    index = torch.stack(torch.meshgrid(*map(torch.arange, GRID.shape), indexing="ij"), -1)
    found = (ball[..., None] * index).sum((0, 1, 2)) / ball.sum()
    np.testing.assert_allclose(found, GRID.index(centre), atol=0.1)
    shares = [recovered_contrast(without + part * 400 * ball, without, GRID, centre, diameter, 400.0)
              for part in (0.0, 0.5, 1.0)]
    assert shares[0] == 0 and shares[1] == pytest.approx(shares[2] / 2) and 0.3 < shares[2] <= 1
    everywhere = recovered_contrast(without + 100, without, GRID, centre, diameter, 400.0)
    assert everywhere == pytest.approx(0, abs=1e-5)
