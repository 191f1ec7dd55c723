"""Sharpness: widths of blurred edges in closed form, and contrasts that scale as they must."""

import math

import numpy as np
import pytest
import torch

from phydict.evaluation.sharpness import (
    edge_spread,
    edge_width,
    rib_profile,
    sharpness_scores,
    vessel_visibility,
)
from phydict.grid import Grid

GRID = Grid.box((40, 24, 60), (120.0, 72.0, 120.0))  # 3, 3 and 2 mm


def chest(sigma: float) -> tuple[torch.Tensor, torch.Tensor]:
    """HU of a box of lung in tissue, its faces blurred by a Gaussian of sigma mm, and the lung's mask."""
    shares, inside = [], []
    for axis, half in ((0, 36.0), (1, 24.0), (2, 33.0)):
        places = (np.arange(GRID.shape[axis]) - (GRID.shape[axis] - 1) / 2) * GRID.spacing[axis]
        shares.append(torch.tensor([(math.erf((half - p) / sigma / 2**0.5) + math.erf((half + p) / sigma / 2**0.5)) / 2
                                    for p in places]))
        inside.append(torch.from_numpy(abs(places) < half))
    share, mask = (x[0][:, None, None] * x[1][:, None] * x[2] for x in (shares, inside))
    return 50 - 850 * share, mask.float()


@pytest.mark.parametrize("edge", ["diaphragm", "chest_wall"])
@pytest.mark.parametrize("sigma", [4.0, 6.0])
def test_a_blurred_step_is_as_wide_as_its_gaussian(edge, sigma):
    hu, lung = chest(sigma)
    inner = lung.clone()
    inner[:, :9] = inner[:, -9:] = 0  # away from the other edges
    assert edge_spread(hu, inner, GRID, edge) == pytest.approx(2.5631 * sigma, rel=0.1)


def test_a_width_depends_on_neither_contrast_nor_direction_and_is_in_mm():
    profile = torch.linspace(0, 1, 11) ** 2
    width = edge_width(profile, 1.0)
    assert width == pytest.approx(10 * (0.9**0.5 - 0.1**0.5), rel=0.02)
    assert edge_width(700 - 300 * profile, 1.0) == pytest.approx(width, rel=1e-5)
    assert edge_width(1 - profile.flip(0), 3.0) == pytest.approx(3 * width, rel=1e-5)


def test_an_edge_that_no_line_crosses_is_refused():
    with pytest.raises(ValueError, match="no line crosses the diaphragm"):
        edge_spread(torch.zeros(GRID.shape), torch.zeros(GRID.shape), GRID, "diaphragm")


def test_scores_are_shares_of_the_truths_and_what_is_not_there_has_none():
    (truth, lung), (blurred, _) = chest(4.0), chest(8.0)
    assert sharpness_scores(truth, truth, lung, GRID) == pytest.approx(
        {"edge_diaphragm": 1, "edge_chest_wall": 1, "vessels": 1})
    found = sharpness_scores(blurred, truth, lung, GRID)
    assert 1.5 < found["edge_diaphragm"] < 2.2 and 1.5 < found["edge_chest_wall"] < 2.2
    assert sharpness_scores(truth, truth, torch.zeros_like(lung), GRID) == {}


def walled(sigma: float, share: float = 1.0) -> tuple[torch.Tensor, torch.Tensor]:
    """HU of a lung beside a wall with a rib every 30 mm of its height, a Gaussian of sigma mm and share * 600 HU high,
    and the lung's mask."""
    lung = torch.zeros(GRID.shape)
    lung[8:32] = 1
    height = (torch.arange(GRID.shape[2]) - 30) * GRID.spacing[2]
    ribs = torch.exp(-(torch.remainder(height + 15, 30) - 15) ** 2 / (2 * sigma**2))
    hu = torch.where(lung > 0, -850.0, 0.0)
    hu[5:8] = 600 * share * ribs
    return hu, lung


def test_ribs_are_found_and_their_width_and_contrast_are_their_own():
    truth, lung = walled(4.0)
    profile = rib_profile(truth, truth, lung, GRID)
    assert profile[0] == 600 and profile[-1] == pytest.approx(600 * math.exp(-(12**2) / 32), rel=1e-3)
    flat = sharpness_scores(walled(4.0, 0.5)[0], truth, lung, GRID)
    assert flat["ribs"] == pytest.approx(0.5)
    wide = sharpness_scores(walled(6.0)[0], truth, lung, GRID)
    assert 0.8 < wide["ribs"] < 1
    assert "ribs" not in sharpness_scores(truth.clamp(max=100), truth.clamp(max=100), lung, GRID)


def test_ribs_that_are_as_bright_above_and_below_as_in_their_middle_have_no_score():
    truth, lung = walled(4.0)
    truth[5:8] = 500.0
    for volume in (truth, walled(4.0)[0]):
        assert "ribs" not in sharpness_scores(volume, truth, lung, GRID)


def test_vessels_show_in_proportion_to_their_contrast():
    lung = torch.zeros(GRID.shape)
    lung[8:32, 6:18, 10:50] = 1
    truth = torch.where(torch.rand(GRID.shape, generator=torch.Generator().manual_seed(0)) < 0.02, -300.0, -850.0)
    for share in (1.0, 0.4, 0.0):
        assert vessel_visibility(-850 + share * (truth + 850), truth, lung) == pytest.approx(share, abs=1e-5)
    assert vessel_visibility(truth + 200, truth, lung) == pytest.approx(1, abs=1e-5)


def test_vessels_of_a_box_of_air_alone_have_no_score():
    air, lung = torch.full(GRID.shape, -1000.0), torch.ones(GRID.shape)
    assert sharpness_scores(air + torch.rand(GRID.shape), air, lung, GRID) == {}
