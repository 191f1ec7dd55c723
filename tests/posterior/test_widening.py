"""How widely views see a patient, and by how much intervals widen for it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from prior.tiny import tiny_refiner

from phydict.methods import reconstruct
from phydict.posterior import posterior
from phydict.posterior.widening import (
    angular_spread,
    directions,
    limited_angle_factor,
    narrow_arc_widening,
    repeated_widening,
    warn_of_contradictions,
)
from phydict.xray import ConeBeam, Projector
from posterior.hollow import GRID, ORBIT, measured


def seen(views: int, arc_degrees: float = 360.0, start: float = 0.0) -> Projector:
    return Projector(GRID, ConeBeam.orbit(views, 1020, 740, (28, 28), 20.0, arc_degrees=arc_degrees, start=start))


@pytest.mark.parametrize("start", [0.0, 0.4, 2.0])
@pytest.mark.parametrize("degrees", [20.0, 60.0, 90.0, 180.0])
def test_the_spread_of_an_arc_is_its_second_moment_wherever_it_starts(degrees, start):
    """(1 - sin(a) / a) / 2 of the angle a, which many views fill."""
    arc = np.radians(degrees)
    assert angular_spread(seen(1000, degrees, start)) == pytest.approx((1 - np.sin(arc) / arc) / 2, abs=1e-3)


def test_opposite_views_see_along_one_line_and_a_full_orbit_evenly():
    assert angular_spread(seen(2)) == pytest.approx(0, abs=1e-9) == angular_spread(seen(1))
    assert [angular_spread(seen(views)) for views in (3, 4, 17)] == pytest.approx([0.5] * 3)


def test_intervals_widen_with_more_views_of_a_limited_angle_and_never_for_a_full_orbit_or_few_views():
    assert all(limited_angle_factor(seen(views)) == 1 for views in (1, 2, 3, 32, 200))
    assert limited_angle_factor(seen(6, 40.0)) == 1
    more_views = [limited_angle_factor(seen(views, 60.0)) for views in (6, 8, 16, 32)]
    wider = [limited_angle_factor(seen(16, degrees)) for degrees in (40.0, 60.0, 90.0, 140.0, 180.0)]
    assert more_views == sorted(set(more_views)) and wider == sorted(wider, reverse=True) and wider[-1] == 1


def test_a_limited_angle_belongs_to_the_calibration_so_that_nothing_counts_as_widened(monkeypatch):
    refiner = tiny_refiner(uncertain=True)

    def found():
        return reconstruct(measured().y[0], ORBIT, refiner, "phydict_learned", precision="float32")

    usual = found()
    monkeypatch.setattr(posterior, "limited_angle_factor", lambda _: 1.5)
    wider = found()
    assert wider.interval_widening == usual.interval_widening
    for level, half_width in usual.intervals.items():
        torch.testing.assert_close(wider.intervals[level], (1.5 * half_width).clamp(max=2 * refiner.window.half_width))


@pytest.mark.filterwarnings("ignore:.* views come from 1 direction")
def test_a_narrower_arc_than_in_the_calibration_widens_and_is_said():
    wider = []
    for degrees in (30.0, 20.0, 10.0, 0.1):
        with pytest.warns(UserWarning, match="8 views come from a narrower arc .* 40 degrees: they are 1.. times"):
            wider.append(narrow_arc_widening(seen(8, degrees)))
    assert wider[0] > 1 and wider == sorted(set(wider)) and wider[-1] < 2
    with pytest.warns(UserWarning, match="narrower arc"):
        found = reconstruct(measured().y[0][[0] * 4], ORBIT.select([0] * 4), tiny_refiner(uncertain=True),
                            "phydict_learned", precision="float32")
    assert found.interval_widening >= wider[-1]


@pytest.mark.filterwarnings("error")
def test_arcs_of_the_calibration_few_views_and_full_orbits_do_not():
    scenes = *(seen(views, 40.0) for views in (4, 8, 32)), *(seen(views) for views in (1, 2, 3, 4, 200)), seen(3, 10.0)
    assert all(narrow_arc_widening(scene) == 1 for scene in scenes)


@pytest.mark.parametrize("views, times", [(1, 2), (4, 4), (5, 3)])
def test_views_that_repeat_count_once_whatever_their_order_and_widen_intervals_by_the_root_of_how_often(views, times):
    beam = seen(views).beam
    repeated = Projector(GRID, beam.select([*range(views), *reversed(range(views))] + [*range(views)] * (times - 2)))
    assert directions(repeated.beam, GRID.centre) == views
    with pytest.warns(UserWarning, match=f"{times * views} views come from {views} directions? alone.* times as wide"):
        assert repeated_widening(repeated) == pytest.approx(times**0.5)


@pytest.mark.filterwarnings("error")
def test_views_half_a_degree_apart_opposed_ones_and_tiles_of_one_source_are_all_distinct():
    dense, opposed, one = seen(36, 20.0), seen(2), seen(1).beam
    tiles = ConeBeam(*(np.repeat(rows, 2, 0) for rows in (one.sources, one.detectors, one.u, one.v)), one.shape)
    tiles = replace(tiles, detectors=tiles.detectors + 14 * np.array([[1], [-1]]) * tiles.u)
    assert all(repeated_widening(scene) == 1 for scene in (dense, opposed, seen(1), seen(200), Projector(GRID, tiles)))


@pytest.mark.filterwarnings("error")
def test_an_orbit_of_any_number_of_views_repeats_none_and_a_dense_narrow_arc_does():
    assert all(repeated_widening(seen(views)) == 1 for views in (1799, 1800, 3600))
    assert repeated_widening(Projector(GRID, seen(64).beam.select([*range(64)] * 2))) == 1
    for projector, factor in ((seen(200, 40.0), 1.7), (Projector(GRID, seen(63).beam.select([*range(63)] * 2)), 1.4)):
        with pytest.warns(UserWarning, match=r"\d+ views come from \d+ directions alone"):
            assert repeated_widening(projector) == pytest.approx(factor, abs=0.05)


@pytest.mark.parametrize("shares, named", [((1.0, 1.0, 1.5, 1.0), 2), ((0.0, 2.0, 0.0, 0.0), 1),
                                           ((1.0, 1.0, 1.1, 1.0), None), ((1.0, 2.0), None)])
def test_the_view_that_fits_worst_is_named_where_it_stands_out(shares, named):
    m = measured(ConeBeam.orbit(len(shares), 1020, 740, (28, 28), 20.0))
    size = m.y[0].square().mean((1, 2))
    m.model_variance = (0.01 * torch.tensor(shares).square() * size)[:, None, None]
    with pytest.warns(UserWarning, match="no volume explains") as said:
        warn_of_contradictions(m, None)
    words = f"view {named} (counted from 0) fits worst: reconstruct without it and compare"
    assert (words in str(said[0].message)) if named is not None else ("fits worst" not in str(said[0].message))
