"""Laws of changed scans: contrast agent reaches blood alone, the table goes and the body stays, a field is a circle."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from phydict.datasets.cts.acquisition import LEAST_BLOOD, change_contrast, cut_ends, cut_field, without_table
from phydict.datasets.cts.augment import Augmentation, augment
from phydict.datasets.phantoms.phantom import build, phantom_case
from phydict.datasets.phantoms.thorax import Thorax, without
from phydict.datasets.surroundings.couches import Couch
from phydict.datasets.surroundings.surroundings import Surroundings
from phydict.grid import Grid
from phydict.units import HUWindow

GRID = Grid.cube(48)
COUCH = Couch.draw(np.random.default_rng(2))


def chest(seed: int = 5, **changes) -> tuple[torch.Tensor, torch.Tensor]:
    """HU (1, 48, 48, 48) and masks of a healthy thorax scanned as a whole, without noise."""
    thorax = replace(without(Thorax.draw(seed)), noise=0.0, scan=(-400.0, 400.0), field=470.0, **changes)
    hu, masks = build(thorax, GRID)
    return torch.from_numpy(hu)[None], torch.from_numpy(masks)


def place(x: float, y: float, z: float, reach: float) -> tuple[torch.Tensor, ...]:
    """Where the voxels within `reach` mm of a point of the world are."""
    axes = [(torch.arange(48) - 23.5) * 8 - centre for centre in (x, y, z)]
    return (axes[0][:, None, None] ** 2 + axes[1][:, None] ** 2 + axes[2] ** 2 < reach**2)[None]


@pytest.mark.parametrize("amount", [40.0, -40.0])
def test_contrast_agent_changes_blood_and_spares_lung_fat_and_spine(amount):
    thorax = replace(without(Thorax.draw(5)), contrast=True, blood=(200.0, 200.0), offset=(0.0, 0.0, 0.0))
    hu, masks = chest(contrast=True, blood=(200.0, 200.0), offset=(0.0, 0.0, 0.0))
    change = change_contrast(hu, masks, amount) - hu
    heart = place(*thorax.heart_ellipsoid(thorax.heart)[0], 18)
    assert change[heart].mean() == pytest.approx(amount, abs=0.1 * abs(amount))
    spine = place(0, float(thorax.spine_y(0.0)), 0, 8)
    lung = (masks[0] > 0.99) & (masks[2] < 0.01) & (hu[0] < -800)
    assert change[spine].abs().max() < 1 and change[0][lung].abs().max() < 1
    fat = (hu > -120) & (hu < -80) & (masks[:1] == 0)
    assert fat.any() and change[fat].abs().max() < 1 and not change[hu < -999].any()


def test_blood_without_contrast_agent_is_not_lowered():
    hu, masks = chest(contrast=False, blood=(42.0, 42.0))
    change = change_contrast(hu, masks, -60.0) - hu
    soft = (hu < LEAST_BLOOD) & (masks[2:3] == 0)
    assert soft.any() and not change[soft].any()


def test_without_lungs_there_is_no_blood():
    hu, masks = chest()
    assert change_contrast(hu, 0 * masks, 80.0).equal(hu)


@pytest.mark.parametrize("seed", [5, 6])
def test_the_table_goes_and_the_body_stays(seed):
    with_table, _ = chest(seed, couch=COUCH)
    bare, _ = chest(seed, couch=None)
    assert (with_table - bare).abs().max() > 200
    new = without_table(with_table, GRID)
    body = bare > -300
    assert new[body].equal(with_table[body])
    assert ((new - bare).abs() > 100).sum() < 0.1 * ((with_table - bare).abs() > 100).sum()
    air = torch.full((1, *GRID.shape), -1000.0)
    assert without_table(air, GRID).equal(air)


def test_a_field_of_view_is_a_circle_of_its_diameter():
    hu, masks = chest()
    new, seen = cut_field(hu, masks, GRID, 300.0, (10.0, -20.0))
    axis = (torch.arange(48) - 23.5) * 8
    away = torch.hypot(axis[:, None] - 10, axis + 20)[..., None].expand(hu.shape)
    assert (new[away > 155] == -1000).all() and not seen[:, away[0] > 155].any()
    assert new[away < 145].equal(hu[away < 145]) and seen[:, away[0] < 145].equal(masks[:, away[0] < 145])
    area = float((cut_field(0 * hu, masks, GRID, 300.0)[0] + 1000).sum()) / 1000 / 48 * 64
    assert area == pytest.approx(np.pi * 150**2, rel=0.01)


def only(**shares: float) -> Augmentation:
    return replace(Augmentation.none(), surroundings=replace(Surroundings.none(), **shares))


@pytest.mark.parametrize("name", ["table", "field", "ends"])
def test_augmentation_changes_the_scan_of_its_share_of_the_cases(name):
    case = phantom_case(1, GRID) | {"report": ""}
    plain = augment(case, 3, GRID, strength=Augmentation.none())["volume"]
    assert augment(case, 3, GRID, strength=only(**{name: 0.0}))["volume"].equal(plain)
    changed = augment(case, 3, GRID, strength=only(**{name: 1.0}))["volume"]
    taken = changed < plain - 1e-6
    assert taken.any() and not (changed > plain + 1e-6).any(), "all only take away"
    taken = [not augment(case, seed, GRID, strength=only(**{name: 0.5}))["volume"].equal(plain) for seed in range(20)]
    assert 0.2 < np.mean(taken) < 0.8


def test_a_case_with_a_report_keeps_its_ends():
    case = phantom_case(1, GRID)
    plain, shorter = (augment(case, 3, GRID, strength=only(ends=share))["volume"] for share in (0.0, 1.0))
    assert case["report"] and shorter.equal(plain)


def test_a_shorter_scan_is_air_beyond_its_ends_and_itself_between():
    hu, masks = chest()
    new, seen = cut_ends(hu, masks, GRID, -60.0, 84.0)
    z = (torch.arange(48) - 23.5) * 8
    beyond, within = (z < -64) | (z > 88), (z > -56) & (z < 80)
    assert (new[..., beyond] == -1000).all() and not seen[..., beyond].any()
    assert new[..., within].equal(hu[..., within]) and seen[..., within].equal(masks[..., within])
    height = float((cut_ends(0 * hu, masks, GRID, -60.0, 84.0)[0] + 1000)[0, 0, 0].sum()) * 8 / 1000
    assert height == pytest.approx(144, abs=1e-3)


def test_augmentation_of_contrast_stays_within_its_strength():
    case, strength = phantom_case(1, GRID), replace(Augmentation.none(), contrast=60.0)
    plain = augment(case, 0, GRID, strength=Augmentation.none())["volume"]
    largest = []
    for seed in range(6):
        change = HUWindow().half_width * (augment(case, seed, GRID, strength=strength)["volume"] - plain)
        largest.append(float(change.abs().max()))
        assert largest[-1] <= 60.01
    assert max(largest) > 15
