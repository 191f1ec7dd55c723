"""Augmentation of CTs: small, replayed by its seed, the same for volume and masks."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from ct_files import AFFINE

from phydict.datasets.cts.augment import Augmentation, Deformation, augment
from phydict.datasets.cts.ct_case import prepare_ct
from phydict.datasets.surroundings.surroundings import Surroundings
from phydict.grid import Grid
from phydict.units import HUWindow

GRID = Grid.cube(32)


@pytest.fixture(scope="module")
def case(chest):
    return prepare_ct((chest.astype(np.float32), AFFINE), GRID)


def test_augmentation_is_replayed_by_its_seed(case):
    a, b, c = (augment(case, seed, GRID) for seed in (5, 5, 6))
    assert a["volume"].equal(b["volume"]) and a["masks"].equal(b["masks"]) and not a["volume"].equal(c["volume"])
    d = augment(case, torch.Generator().manual_seed(5), GRID)
    assert a["volume"].equal(d["volume"])


def test_augmentation_moves_volume_and_masks_together(case):
    copies = case | {"masks": ((case["volume"] + 1) / 2).expand(3, -1, -1, -1)}
    for seed in range(5):
        move = dataclasses.replace(Deformation.draw(seed), hu_scale=1.0, hu_offset=0.0)
        new = move.apply(copies, GRID, HUWindow())
        torch.testing.assert_close(new["masks"], ((new["volume"] + 1) / 2).expand(3, -1, -1, -1), atol=1e-5, rtol=0)


def test_augmentation_stays_small_and_never_mirrors(case):
    start = np.argwhere(case["volume"][0].numpy() > 0.4).mean(0)
    lung = float(case["masks"][0].sum())
    whole = dataclasses.replace(Augmentation(), surroundings=dataclasses.replace(Surroundings(), ends=0.0, field=0.0))
    moves = []
    for seed in range(10):
        new = augment(case, seed, GRID, strength=whole)
        assert new["volume"].min() >= -1 and new["volume"].max() <= 1
        assert new["masks"].min() >= 0 and new["masks"].max() <= 1
        assert new["volume"][0, 0, 0, 0] == -1, "air stays air"
        assert 0.65 < float(new["masks"][0].sum()) / lung < 1.5
        moves.append(np.argwhere(new["volume"][0].numpy() > 0.4).mean(0) - start)
    millimetres = 12 * np.linalg.norm(moves, axis=1)
    assert millimetres.mean() > 3 and millimetres.max() < 60


def test_a_deformation_of_nothing_changes_nothing(case):
    still = Deformation(torch.zeros(3), torch.ones(3), torch.zeros(3), torch.zeros(3, 4, 4, 4), 1.0, 0.0)
    new = still.apply(case, GRID, HUWindow())
    torch.testing.assert_close(new["volume"], case["volume"], atol=1e-4, rtol=0)
    torch.testing.assert_close(new["masks"], case["masks"], atol=1e-4, rtol=0)


def test_augmentation_of_no_strength_changes_nothing_and_each_strength_is_its_own_bound(case):
    new = augment(case, 3, GRID, strength=Augmentation.none())
    torch.testing.assert_close(new["volume"], case["volume"], atol=1e-4, rtol=0)
    for name in ("rotation", "scale", "shift", "elastic_mm", "hu_scale", "hu_offset"):
        weak = dataclasses.replace(Augmentation(), **{name: getattr(Augmentation(), name) / 100})
        for seed in range(10):
            usual, less = (vars(Deformation.draw(seed, strength)) for strength in (Augmentation(), weak))
            rest = 1 if name in ("scale", "hu_scale") else 0
            for part in ("rotation", "scale", "shift", "elastic_mm", "hu_scale", "hu_offset"):
                factor = 0.01 if part == name else 1
                torch.testing.assert_close(torch.as_tensor(less[part] - rest * (part == name)),
                                           factor * torch.as_tensor(usual[part] - rest * (part == name)),
                                           atol=1e-6, rtol=1e-3)


def test_hu_changes_spare_air_and_scale_tissue(case):
    strength = dataclasses.replace(Augmentation.none(), hu_scale=0.03, hu_offset=20.0)
    old = HUWindow().to_hu(case["volume"])
    for seed in range(5):
        move = Deformation.draw(seed, strength)
        new = HUWindow().to_hu(augment(case, seed, GRID, strength=strength)["volume"])
        air, tissue = old < -999.9, (old > -790) & (old < 900)
        assert air.any() and tissue.any()
        torch.testing.assert_close(new[air], old[air], atol=0.3, rtol=0)
        expected = move.hu_scale * (old[tissue] + 1000) - 1000 + move.hu_offset
        torch.testing.assert_close(new[tissue], expected, atol=0.5, rtol=0)


@pytest.mark.parametrize("report, may", [
    ("", True), ("No focal consolidation.", True), ("Bilateral pleural effusion.", True),
    ("Nodule, right lung.", False), ("LEFT-sided effusion", False),
    ("Consolidation of the middle lobe.", False), ("Middle-lobe nodule.", False), ("Middle  lobe syndrome.", False),
    ("Nodule of the middle lung lobe.", False), ("Mid lobe scar.", False), ("An azygos lobe.", False),
    ("Opacity in the LLL.", False), ("Lingular atelectasis", False),
    ("Rt lower lobe nodule", False), ("Lt. pleural effusion", False), ("Leftward shift", False),
    ("Levoscoliosis", False), ("Mild dextroscoliosis.", False), ("leftsided effusion", False),
    ("Upright, brighter, altered.", True)])
def test_only_a_report_without_side_may_be_mirrored_and_only_on_demand(case, report, may):
    case = case | {"report": report}
    for strength, mirrored in ((0.0, False), (1.0, may)):
        new = augment(case, 0, GRID, strength=dataclasses.replace(Augmentation.none(), mirror=strength))
        for key in ("volume", "masks"):
            torch.testing.assert_close(new[key], case[key].flip(1) if mirrored else case[key], atol=1e-4, rtol=0)


@pytest.mark.parametrize("strength, words", [({"shift": -1.0}, "shift is -1"), ({"scale": 0.9}, "small changes"),
                                                 ({"mirror": 1.5}, "mirror lies between 0 and 1"),
                                                 ({"girth": 1.5}, "girth lies between 0 and 1"),
                                                 ({"girth": float("nan")}, "girth is nan")])
def test_augmentation_refuses_impossible_strengths(strength, words):
    with pytest.raises(ValueError, match=words):
        Augmentation(**strength)


def test_a_shift_moves_by_its_millimetres(case):
    shift = Deformation(torch.zeros(3), torch.ones(3), torch.tensor([24.0, 0, -12]), torch.zeros(3, 4, 4, 4), 1.0, 0.0)
    new = shift.apply(case, GRID, HUWindow())["volume"]
    torch.testing.assert_close(new[0, :28, :, 2:], case["volume"][0, 2:30, :, 1:31], atol=1e-3, rtol=0)


def test_augmentation_refuses_other_grids_and_cases_with_xrays(case):
    with pytest.raises(ValueError, match="give the grid the case was prepared on"):
        augment(case, 0)
    with pytest.raises(ValueError, match="deform it before projecting"):
        augment(case | {"xrays": torch.zeros(1, 2, 2)}, 0, GRID)
