"""The scores of a case: the body's leave out couch and air, and keep lungs that the field of view cuts open."""

from __future__ import annotations

import torch

from phydict.grid import Grid
from phydict.inference.scoring import case_scores
from phydict.units import HUWindow

GRID, WINDOW = Grid.cube(32), HUWindow()
X, Y, Z = torch.meshgrid(*[(torch.arange(32) - 15.5) * 12.0] * 3, indexing="ij")


def scene(cut: bool = False) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """HU of a trunk with two lungs above a couch, the lungs, and the couch; `cut`: the left lung open to the side."""
    trunk = (X / 160) ** 2 + (Y / 110) ** 2 < 1
    lungs = ((X.abs() - 75) / 50) ** 2 + (Y / 70) ** 2 + (Z / 130) ** 2 < 1
    couch = ((Y + 165).abs() < 20) & (X.abs() < 180)
    hu = torch.where(couch, -100.0, -1000.0)
    hu = torch.where(lungs, -800.0, torch.where(trunk, 40.0, hu))
    return (torch.where(X > 80, -1000.0, hu) if cut else hu), lungs & ~(cut & (X > 80)), couch


def scores(volume: torch.Tensor, truth: torch.Tensor, lungs: torch.Tensor) -> dict[str, float]:
    masks = torch.stack([lungs, torch.zeros_like(lungs), torch.zeros_like(lungs)]).float()
    case = {"volume": WINDOW.to_range(truth)[None], "masks": masks, "has_masks": torch.tensor([True, False, False])}
    return case_scores(volume, 0.0, case, GRID, WINDOW)


def test_an_error_in_couch_or_air_changes_the_volumes_scores_alone():
    truth, lungs, couch = scene()
    noisy = truth + 30 * torch.randn(truth.shape, generator=torch.Generator().manual_seed(0))
    plain = scores(noisy, truth, lungs)
    for where in (couch, Y > 150):
        spoiled = scores(torch.where(where, 400.0, noisy), truth, lungs)
        for name in ("psnr_body", "mae_hu_body", "psnr_lung", "mae_hu_lung"):
            assert spoiled[name] == plain[name], name
        assert spoiled["psnr"] < plain["psnr"] - 3


def test_an_error_in_tissue_or_lung_changes_the_bodys_scores():
    truth, lungs, _ = scene()
    plain = scores(truth + 10, truth, lungs)
    for where in (lungs, (Y.abs() < 20) & (X.abs() < 20)):
        assert scores(torch.where(where, truth + 200, truth + 10), truth, lungs)["psnr_body"] < plain["psnr_body"] - 3


def test_a_lung_that_the_field_of_view_cuts_open_belongs_to_the_body():
    truth, lungs, _ = scene(cut=True)
    wrong = scores(torch.where(lungs & (X > 60), truth + 500, truth), truth, lungs)
    assert wrong["mae_hu_lung"] > 0 and wrong["mae_hu_body"] > 0
