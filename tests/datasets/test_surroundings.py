"""Laws of what lies around a chest: the body stays, the couch is below, grids agree, shares of 0 change nothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from phydict.datasets import Augmentation, Surroundings, augment, phantom_case, surround
from phydict.datasets.cts.girth import Girth
from phydict.datasets.surroundings.arms import Arm
from phydict.datasets.surroundings.couches import Couch
from phydict.datasets.surroundings.covers import Cover
from phydict.datasets.surroundings.leads import Lead
from phydict.datasets.surroundings.scene import Scene
from phydict.grid import Grid

GRID = Grid.cube(48)
ALL = Surroundings(couch=1.0, cover=1.0, leads=1.0, arms=1.0)


def chest(voxels: int = 48, half: tuple[float, float] = (120.0, 90.0)) -> tuple[np.ndarray, np.ndarray, Grid]:
    """HU and body of an elliptic cylinder of water, wholly seen, its surface on the voxels' faces."""
    grid = Grid.cube(voxels)
    axis = (np.arange(48) - 23.5) * 8
    inside = (np.hypot(axis[:, None] / half[0], axis / half[1]) < 1)[..., None] & (np.abs(axis) < 150)
    body = np.kron(inside, np.ones((voxels // 48,) * 3)).astype(bool)
    return np.where(body, 0.0, -1000.0).astype(np.float32), body, grid


def things(seed: int) -> list:
    rng = np.random.default_rng(seed)
    return [Couch.draw(rng), Cover.draw(rng), *Lead.draw_set(rng), *Arm.draw_pair(rng)]


@pytest.mark.parametrize("seed", range(8))
def test_nothing_inside_the_body_changes_and_nothing_becomes_thinner(seed):
    hu, body, grid = chest()
    new = surround(hu, body, grid, seed, ALL)
    assert np.array_equal(new[body], hu[body]) and (new >= hu).all() and (new > hu).any() and np.isfinite(new).all()
    assert not (new != hu)[..., ~body.any((0, 1))].any(), "nothing beyond the scan's ends"


def test_the_same_seed_gives_the_same_and_another_another():
    hu, body, grid = chest()
    first, again, other = (surround(hu, body, grid, seed, ALL) for seed in (3, 3, 4))
    assert np.array_equal(first, again) and not np.array_equal(first, other)


@pytest.mark.parametrize("name", ["couch", "cover", "leads", "arms"])
def test_each_kind_is_put_in_by_its_share_alone(name):
    hu, body, grid = chest()
    assert np.array_equal(surround(hu, body, grid, 0, Surroundings.none()), hu)
    one = replace(Surroundings.none(), **{name: 0.5})
    changed = [not np.array_equal(surround(hu, body, grid, seed, one), hu) for seed in range(60)]
    assert 0.3 < np.mean(changed) < 0.7


@pytest.mark.parametrize("seed", range(6))
def test_fine_and_coarse_grids_agree(seed):
    coarse, fine = (Scene(*chest(voxels)) for voxels in (48, 96))
    for thing in things(seed):
        before = coarse.hu.copy(), fine.hu.copy()
        for scene in (coarse, fine):
            thing.add_to(scene)
        low, high = coarse.hu - before[0], (fine.hu - before[1]).reshape(48, 2, 48, 2, 48, 2).mean((1, 3, 5))
        assert low.sum() == pytest.approx(high.sum(), rel=0.15, abs=2000), type(thing).__name__
        assert np.abs(low - high).sum() < 0.35 * high.sum() + 4000, type(thing).__name__


def section_of(couch: Couch, scene: Scene) -> np.ndarray:
    return couch.section(scene.axes[0] - scene.middle[0], scene.axes[1] - scene.back)


@pytest.mark.parametrize("seed", range(30))
def test_a_couch_lies_below_the_back_and_weakens_rays_as_couches_do(seed):
    hu, body, grid = chest(half=(120.0, 60.0))
    scene, couch = Scene(hu, body, grid), replace(Couch.draw(np.random.default_rng(seed)), rest=None)
    assert scene.back == pytest.approx(-56, abs=0.1)
    section = section_of(couch, scene)
    straight = section_of(replace(couch, curve=0.0), scene)
    low = 8 * np.flatnonzero(straight.any(0))[-1] - 188 - 4
    assert low <= scene.back + max(-couch.gap, 0) + 1e-6
    through = 8 * section[20:28].sum(1).mean()
    assert 2 < through < 25, "mm of water"
    assert section.max() < 1.4


def test_couches_of_many_draws_weaken_rays_like_those_of_ct_scanners():
    hu, body, grid = chest(half=(120.0, 40.0))
    scene = Scene(hu, body, grid)
    couches = [Couch.draw(np.random.default_rng(seed)) for seed in range(60)]
    through = [8 * section_of(couch, scene)[20:28].sum(1).mean() for couch in couches]
    assert 5 < np.median(through) < 12


def test_an_arm_lies_on_its_side_of_the_body():
    for side in (1, -1):
        hu, body, grid = chest(half=(80.0, 90.0))
        scene = Scene(hu.copy(), body, grid)
        Arm.draw(np.random.default_rng(1), side).add_to(scene)
        x = np.nonzero(scene.hu != hu)[0] - 23.5
        assert len(x) and (side * x > 0).all()


def test_a_cover_lies_on_the_body_and_leads_too():
    hu, body, grid = chest()
    for thing in (Cover.draw(np.random.default_rng(0)), Lead.draw(np.random.default_rng(0))):
        scene = Scene(hu.copy(), body, grid)
        thing.add_to(scene)
        middle = np.argwhere(scene.hu != hu)
        middle = middle[np.abs(middle[:, 0] - 23.5) < 6]
        assert len(middle) and (middle[:, 1] > 23).all()


def test_bad_shares_and_a_scene_without_a_body_are_refused():
    for name, share in (("couch", 1.5), ("leads", -0.1), ("ends", float("nan"))):
        with pytest.raises(ValueError, match=f"surroundings.{name} lies between 0 and 1,"):
            Surroundings(**{name: share})
    hu, body, grid = chest()
    with pytest.raises(ValueError, match="a scene needs a body"):
        Scene(hu, 0 * body, grid)
    assert surround(hu, 0 * body, grid, 0, ALL) is hu


@pytest.mark.parametrize("seed", range(3))
def test_augmentation_puts_surroundings_around_an_unchanged_body(seed):
    case, bare = phantom_case(4, GRID), replace(Surroundings.none(), table=1.0)
    plain = augment(case, seed, GRID, strength=replace(Augmentation.none(), surroundings=bare))
    full = augment(case, seed, GRID, strength=replace(Augmentation.none(), surroundings=replace(
        ALL, table=1.0, field=0.0, ends=0.0)))
    body = -torch.nn.functional.max_pool3d(-plain["volume"][None], 3, 1, 1)[0] > -0.3
    assert body.sum() > 5000
    assert full["volume"][body].equal(plain["volume"][body]) and full["masks"].equal(plain["masks"])
    assert ((full["volume"] - plain["volume"]) > 0.05).sum() > 500


def test_girth_moves_the_skin_by_its_growth_and_spares_what_is_inside():
    girth = Girth((0.0, 0.0), (100.0, 80.0), 0.2, 0.3)
    inside = torch.tensor([[99.0, 0, 5], [0, -79.0, 3], [30.0, 40.0, -9]])
    assert girth.source(inside).equal(inside)
    assert girth.source(torch.tensor([[160.0, 0.0, 0.0]]))[0].tolist() == pytest.approx([130, 0, 0])
    assert girth.source(torch.tensor([[0.0, 120.0, 0.0]]))[0, 1] > girth.source(torch.tensor([[0.0, -120.0, 0]]))[0, 1]


def test_girth_of_a_case_keeps_its_lungs_and_changes_its_size():
    case = phantom_case(4, GRID)
    plain = augment(case, 0, GRID, strength=Augmentation.none())
    sizes = []
    for seed in range(6):
        new = augment(case, seed, GRID, strength=replace(Augmentation.none(), girth=1.0))
        torch.testing.assert_close(new["masks"], plain["masks"], atol=0.02, rtol=0)
        sizes.append(int((new["volume"] > -0.3).sum()))
    assert max(sizes) > 1.05 * min(sizes)
