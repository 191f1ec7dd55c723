"""Agreement of organs: closed forms of boxes and tubes, and lungs and vessels of a made chest."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from phydict.evaluation import organs
from phydict.evaluation.organs import cl_dice, dice, fine_grid, hd95, organ_scores
from phydict.grid import Grid

GRID = Grid.cube(40, 400.0)


def box(shift: int = 0) -> np.ndarray:
    mask = np.zeros((24, 20, 20), bool)
    mask[4 + shift:14 + shift, 5:15, 5:15] = True
    return mask


def chest(radius: float = 62.0) -> torch.Tensor:
    """HU of a trunk with two lungs that have vessels of 30 mm."""
    x, y, z = torch.meshgrid(*[(torch.arange(40) - 19.5) * 10.0] * 3, indexing="ij")
    trunk = (x / 170) ** 2 + (y / 130) ** 2 < 1
    lungs = ((x.abs() - 80) / radius) ** 2 + (y / 90) ** 2 + (z / 150) ** 2 < 1
    vessels = ((x.abs() - 80).abs() < 15) & (y.abs() < 15) & (z.abs() < 100)
    return torch.where(lungs & ~vessels, -800.0, torch.where(trunk, 40.0, -1000.0))


def test_shifted_boxes_have_closed_forms():
    assert dice(box(), box()) == 1 and hd95(box(), box(), (1, 1, 1)) == 0
    for shift, mm in ((1, 2.0), (3, 1.5)):
        assert dice(box(), box(shift)) == pytest.approx(1 - shift / 10)
        assert hd95(box(), box(shift), (mm, 1, 1)) == pytest.approx(shift * mm)
    assert dice(box(), ~box()) == 0


@pytest.mark.filterwarnings("error")
def test_the_scores_of_organs_warn_of_nothing_that_a_user_could_change():
    hd95(box(), box(1), (1, 1, 1))


def test_a_lost_branch_halves_the_sensitivity_of_cldice_alone():
    tree = np.zeros((20, 20, 30), bool)
    tree[3:6, 3:6] = tree[13:16, 13:16] = True
    branch = tree.copy()
    branch[10:] = False
    assert cl_dice(tree, tree) == pytest.approx(1)
    assert cl_dice(branch, tree) == pytest.approx(2 / 3) == pytest.approx(cl_dice(tree, branch))
    assert cl_dice(branch, tree & ~branch) == 0 == cl_dice(np.zeros_like(tree), tree)
    thicker = tree.copy()
    thicker[2:7, 2:7] = thicker[12:17, 12:17] = True
    assert cl_dice(thicker, tree) > 0.9 > dice(thicker, tree)


@pytest.fixture
def coarse(monkeypatch):
    """Organs compared on the voxels as they are, which takes less time."""
    monkeypatch.setattr(organs, "FINEST_MM", 10.0)


def test_the_truth_scores_best_smaller_lungs_less_and_lost_lungs_nothing(coarse):
    truth = chest()
    same, small, none = (organ_scores(hu, truth, GRID) for hu in (truth, chest(50.0), torch.full(GRID.shape, 40.0)))
    assert same["dice_lung"] == 1 and same["hd95_lung"] == 0 and same["cldice_vessel"] == pytest.approx(1)
    assert 0.6 < small["dice_lung"] < 0.95 and 4 < small["hd95_lung"] < 25
    assert none == {"dice_lung": 0.0, "cldice_vessel": 0.0}
    assert organ_scores(truth, torch.full(GRID.shape, 40.0), GRID) == {}


def test_fine_voxels_are_3_mm_at_most_and_fill_the_same_box():
    fine = fine_grid(GRID)
    assert fine.shape == (160, 160, 160) and fine.extent == pytest.approx(GRID.extent)
    assert fine.centre == pytest.approx(GRID.centre) and fine_grid(fine).same_as(fine)


def test_given_masks_take_the_place_of_the_truths_thresholds(coarse):
    lung = np.zeros(GRID.shape, bool)
    lung[:20] = True
    plain, given = (organ_scores(chest(), chest(), GRID, masks) for masks in (None, {"lung": lung}))
    assert given["dice_lung"] < 0.6 < plain["dice_lung"] and given["cldice_vessel"] == plain["cldice_vessel"]


def test_the_ceiling_of_dice_is_what_a_perfect_reconstruction_has_whatever_the_reconstruction(coarse):
    lung = np.zeros(GRID.shape, bool)
    lung[:20] = True
    for masks in ({"lung": lung}, {"lung": lung, "vessel": lung}):
        perfect, small, none = (organ_scores(hu, chest(), GRID, masks)
                                for hu in (chest(), chest(50.0), torch.full(GRID.shape, 40.0)))
        assert perfect["dice_lung_ct"] == perfect["dice_lung"] < 1
        assert small["dice_lung_ct"] == none["dice_lung_ct"] == perfect["dice_lung_ct"] and none["dice_lung"] == 0
    assert organ_scores(chest(), torch.full(GRID.shape, 40.0), GRID, {"lung": lung})["dice_lung_ct"] == 0
    assert "dice_lung_ct" not in organ_scores(chest(), chest(), GRID)
