"""Laws of the procedural thorax: replay, grids that agree, orientation, findings on their side, honest reports."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scenes import voxel_centres

from phydict.datasets.phantoms.findings import KINDS, Finding
from phydict.datasets.phantoms.phantom import build, change_by_findings, pathology_region, phantom_case
from phydict.datasets.phantoms.thorax import Thorax, without
from phydict.grid import Grid

COARSE = Grid.cube(32)
EXAMPLES = [Finding("nodule", "left", "lower", 28, 5), Finding("mass", "right", "upper", 55, 6),
            Finding("effusion", "left", "", 0.25, 7), Finding("consolidation", "right", "lower", 0.6, 8),
            Finding("consolidation", "right", "middle", 1.0, 8), Finding("opacity", "left", "upper", 0.6, 8),
            Finding("atelectasis", "right", "lower", 0.2, 8), Finding("pneumothorax", "right", "", 0.3, 9)]


def quiet(seed: int, *findings: Finding) -> Thorax:
    """A thorax without noise, wholly inside the scan, with the given findings."""
    return replace(Thorax.draw(seed), noise=0.0, scan=(-400.0, 400.0), field=470.0, findings=findings)


def test_replays_bit_for_bit():
    first, second = phantom_case(7, COARSE), phantom_case(7, COARSE)
    assert torch.equal(first["volume"], second["volume"]) and torch.equal(first["masks"], second["masks"])
    assert first["report"] == second["report"] and first["id"] == "phantom-000007"
    assert not torch.equal(first["volume"], phantom_case(8, COARSE)["volume"])
    assert first["volume"].shape == (1, 32, 32, 32) and first["volume"].dtype == torch.float32
    assert first["volume"].abs().max() <= 1 and first["has_masks"].all()


def test_grids_agree():
    thorax = quiet(3, *EXAMPLES[1:3])
    coarse, coarse_masks = build(thorax, Grid.cube(48))
    fine, fine_masks = build(thorax, Grid.cube(96))
    pooled = fine.reshape(48, 2, 48, 2, 48, 2).mean((1, 3, 5))
    assert np.abs(coarse - pooled).mean() < 10
    assert np.quantile(np.abs(coarse - pooled), 0.99) < 160
    for ours, theirs in zip(coarse_masks, fine_masks):
        assert ours.sum() == pytest.approx(theirs.sum() / 8, rel=0.08)


def test_any_orientation_of_the_grid_shows_the_same_thorax():
    thorax = quiet(4, EXAMPLES[2])
    straight = Grid.cube(32)
    permuted = straight.affine[:, [1, 0, 2, 3]].copy()
    assert np.allclose(build(thorax, Grid((32, 32, 32), affine=permuted))[0].transpose(1, 0, 2),
                       build(thorax, straight)[0], atol=0.5)
    turned = straight.affine.copy()
    turned[:2, :2] = 12 * np.array([[np.cos(0.3), -np.sin(0.3)], [np.sin(0.3), np.cos(0.3)]])
    turned[:2, 3] = -turned[:2, :2] @ [15.5, 15.5]
    assert build(thorax, Grid((32, 32, 32), affine=turned))[0].mean() == pytest.approx(
        build(thorax, straight)[0].mean(), abs=25)


@pytest.mark.parametrize("seed", range(4))
def test_orientation_and_size(seed):
    thorax, grid = quiet(seed), Grid.cube(48)
    hu, masks = build(thorax, grid)
    place = voxel_centres(grid) - thorax.offset
    x, y, z = np.moveaxis(place, -1, 0)
    assert 2.5e6 < masks[0].sum() * np.prod(grid.spacing) < 7e6
    bone = hu > 250
    assert np.median(y[bone & (np.abs(x) < 25)]) < -25, "the spine lies at low j"
    below = (z < -0.5 * thorax.height + 20) & (z > -0.5 * thorax.height - 20) & (np.abs(hu - thorax.liver_hu) < 15)
    assert x[below & (np.abs(y) < 0.6 * thorax.depth) & (np.abs(x) < 0.8 * thorax.width)].mean() > 5, "liver is right"
    enlarged = np.abs(build(quiet(seed, Finding("cardiomegaly", "", "", 0.66)), grid)[0] - hu) > 100
    assert x[enlarged].mean() < -10, "the heart grows to the left"
    widths = [np.ptp(x[:, 0, 0][(masks[0][:, :, k] > 0.5).any(1)]) for k in range(48) if masks[0][:, :, k].max() > 0.9]
    assert widths[-1] < 0.8 * max(widths), "the apices lie at high k"
    assert masks[0][:, :, 24].sum() > masks[0][:, :, 38].sum()


@pytest.fixture(scope="module")
def healthy() -> np.ndarray:
    return build(quiet(11), COARSE)[0]


@pytest.mark.parametrize("finding", EXAMPLES, ids=lambda f: f.kind + f.lobe)
def test_a_finding_changes_its_own_side_only(finding, healthy):
    for case in (finding, finding.mirrored):
        thorax = quiet(11, case)
        change = build(thorax, COARSE)[0] - healthy
        region = np.abs(change) > 30
        assert region.sum() * np.prod(COARSE.spacing) > 0.3 * np.pi / 6 * 20**3
        x = voxel_centres(COARSE)[..., 0] - thorax.offset[0]
        own = x > 0 if case.side == "right" else x < 0
        assert np.abs(change[~own]).max() < 1e-3
        assert (change[region].mean() < 0) == (case.kind == "pneumothorax")


def test_the_region_of_findings_is_where_they_change_the_thorax(healthy):
    thorax = quiet(11, *EXAMPLES[:2])
    changed = np.abs(build(thorax, COARSE)[0] - healthy) > 30
    assert changed.any() and np.array_equal(changed, pathology_region(thorax, COARSE))


@pytest.mark.parametrize("finding, sign", [
    (Finding("emphysema", "both", "", 0.9, 3), -1), (Finding("cardiomegaly", "", "", 0.66), 1),
    (Finding("pericardial effusion", "", "", 20.0), 1)], ids=lambda value: getattr(value, "kind", ""))
def test_findings_of_both_sides(finding, sign):
    thorax = quiet(12, finding)
    change = change_by_findings(thorax, COARSE)
    x = voxel_centres(COARSE)[..., 0] - thorax.offset[0]
    assert sign * change[x > 0].sum() > 0 and sign * change[x < 0].sum() > 0


@pytest.mark.parametrize("size", [0.1, 0.25, 0.5])
def test_effusion_fills_its_fraction_of_the_cavity(size):
    thorax, grid = quiet(13, Finding("effusion", "right", "", size)), Grid.cube(48)
    lung = build(thorax, grid)[1][0][24:].sum() / build(without(thorax), grid)[1][0][24:].sum()
    assert 1 - lung == pytest.approx(size, abs=0.06)


@pytest.mark.parametrize("finding", [Finding("opacity", "left", "lower", 0.6, 8),
                                     Finding("consolidation", "left", "lower", 0.6, 8)], ids=lambda f: f.kind)
def test_ground_glass_is_half_aerated_and_consolidation_is_not(finding):
    thorax, grid = quiet(15, finding), Grid.cube(48)
    hu = build(thorax, grid)[0][pathology_region(thorax, grid, 200.0)]
    assert -750 < np.median(hu) < -350 if finding.kind == "opacity" else np.median(hu) > -100


def test_pericardial_fluid_of_the_stated_depth_surrounds_the_heart():
    grid = Grid.cube(96)
    for depth in (6.0, 20.0):
        thorax = replace(Thorax.standard(), findings=(Finding("pericardial effusion", "", "", depth),))
        fluid = np.abs(build(thorax, grid)[0] - 12) < 8
        centre, axes, half = thorax.heart_ellipsoid(thorax.heart)
        points = (voxel_centres(grid) - centre) @ axes.T
        shells = [(np.linalg.norm(points / (half + depth * share), axis=-1) < 1) for share in (0.0, 0.4, 0.8)]
        assert fluid[shells[2] & ~shells[1]].mean() > 0.5


@pytest.mark.parametrize("ratio", [0.55, 0.66])
def test_heart_has_the_stated_cardiothoracic_ratio(ratio):
    thorax = quiet(14, Finding("cardiomegaly", "", "", ratio))
    _, axes, half = thorax.heart_ellipsoid(ratio)
    assert np.sqrt(((axes[:, 0] * half) ** 2).sum()) / thorax.width == pytest.approx(ratio)
    assert thorax.cage_axes(np.linspace(-150, 150, 300))[0].max() == pytest.approx(thorax.width, rel=0.01)


@pytest.mark.parametrize("seed", range(5))
def test_masks_are_shares_and_air_is_air(seed):
    hu, masks = build(Thorax.draw(seed), Grid.cube(64))
    lung, airway, vessel = masks
    assert np.isfinite(hu).all() and hu.min() >= -1000 and masks.min() >= 0 and masks.max() <= 1
    assert hu[airway > 0.95].max() < -700 and (airway > 0.95).any()
    assert (lung + airway).max() <= 1 + 1e-6 and (vessel <= lung + 1e-6).all()


def test_thoraces_are_finite_and_plausible():
    draws = [Thorax.draw(seed) for seed in range(100)]
    assert all(np.isfinite(build(t, Grid.cube(12))[0]).all() for t in draws[:12])
    abnormal = [len(t.findings) for t in draws]
    assert 0.12 < abnormal.count(0) / 100 < 0.4 and max(abnormal) <= 3
    assert {f.kind for seed in range(400) for f in Thorax.draw(seed).findings} == set(KINDS)


def test_bad_input_is_refused():
    with pytest.raises(ValueError, match="seed"):
        Thorax.draw(-1)
    with pytest.raises(ValueError, match="no kind"):
        Finding("fracture", "left", "", 1.0)
    with pytest.raises(ValueError, match="lobe"):
        Finding("nodule", "left", "middle", 12)
