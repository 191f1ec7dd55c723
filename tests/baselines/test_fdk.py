"""FDK: the value of a ball from its exact line integrals, linear, indifferent to where all stands, alike to RTK."""

import math

import numpy as np
import pytest
import torch
from laws import assert_linear
from scenes import ball, voxel_centres

from phydict.baselines import FDK
from phydict.baselines.fdk import ramp
from phydict.baselines.orbit import CircularOrbit
from phydict.grid import Grid
from phydict.units import MU_WATER
from phydict.xray import ConeBeam, Projector

GRID = Grid.cube(32)
CENTRE, RADIUS = np.array([30.0, -20.0, 0.0]), 80.0
LINEAR = FDK(window=None)


def orbit(views: int, start: float = 0.3, arc: float = 360.0) -> ConeBeam:
    return ConeBeam.orbit(views, 1020, 740, (48, 60), 12.0, start, math.radians(arc))


def views(beam: ConeBeam) -> torch.Tensor:
    return ball(beam, RADIUS, CENTRE)


def density(beam: ConeBeam, xrays=None, grid: Grid = GRID, method: FDK = LINEAR) -> torch.Tensor:
    """Relative to water (X, Y, Z)."""
    xrays = views(beam) if xrays is None else xrays
    return 1 + method.reconstruct(xrays, Projector(grid, beam, full_detector=True)).volume / 1000


def distance(grid: Grid = GRID, centre=CENTRE) -> torch.Tensor:
    return torch.as_tensor(np.linalg.norm(voxel_centres(grid) - centre, axis=-1))


@pytest.mark.parametrize("arc, views", [(360, 180), (300, 150), (230, 115), (216, 108)])
@pytest.mark.parametrize("hann", [False, True])
def test_a_balls_value_is_found_from_many_views_of_full_and_short_scans(arc, views, hann):
    found, far = density(orbit(views, arc=arc), method=FDK(hann, window=None)), distance()
    level = far[:, :, 12:20]  # off the sources' plane FDK is an approximation
    assert found[far < RADIUS - 20].mean() == pytest.approx(1, abs=0.02)
    assert found[:, :, 12:20][level < RADIUS - 20].sub(1).abs().max() < 0.06
    assert found[:, :, 12:20][(level > RADIUS + 30) & (level < 160)].abs().mean() < 0.03


@pytest.mark.parametrize("arc", [360, 216])
@pytest.mark.parametrize("again", [[7], [0, 0, 35], [*range(24)], 3 * [*range(24)]])
def test_views_that_repeat_change_nothing_of_full_and_short_scans(arc, again):
    beam = orbit(24, arc=arc)
    repeated = beam.select([*range(24), *(k % 24 for k in again)])
    torch.testing.assert_close(density(repeated), density(beam), atol=1e-5, rtol=0)


def test_views_that_repeat_share_alike_and_views_in_pairs_are_a_full_circle():
    beam = orbit(8)
    shares = CircularOrbit.of(beam.select([*range(8), 3, 3]), GRID).shares()
    assert shares[[3, 8, 9]] == pytest.approx(math.pi / 4 / 3) and shares[:3] == pytest.approx(math.pi / 4)
    pairs = ConeBeam.at_angles([10.0 * (k // 2) + k % 2 for k in range(72)], 1020, 740, (48, 60), 12.0)
    assert CircularOrbit.of(pairs, GRID).shares().sum() == pytest.approx(2 * math.pi)
    assert density(pairs)[distance() < RADIUS - 20].mean() == pytest.approx(1, abs=0.02)


def test_few_views_have_the_right_mean_and_streaks():
    errors = [float((density(orbit(k)) - (distance() < RADIUS).double()).norm()) for k in (4, 12, 36, 108)]
    assert errors == sorted(errors, reverse=True)
    assert density(orbit(12))[distance() < RADIUS - 20].mean() == pytest.approx(1, abs=0.05)


def test_without_bounds_it_is_linear_in_the_x_rays():
    beam = orbit(5)
    assert_linear(lambda y: density(beam, y), (5, 48, 60))
    bounded = FDK().reconstruct(views(beam), Projector(GRID, beam)).volume
    torch.testing.assert_close(bounded, (1000 * (density(beam) - 1)).clamp(-1000, 1000))


def test_turning_the_gantry_and_the_object_turns_the_volume():
    turned = density(orbit(9, 0.3 + math.pi / 2), views(orbit(9)))  # the source goes from posterior to left: -y to -x
    torch.testing.assert_close(turned, torch.rot90(density(orbit(9)), -1, (0, 1)))


def test_moving_and_tilting_everything_alike_changes_nothing():
    turn, _ = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))
    turn *= np.linalg.det(turn)
    shift = np.array([100.0, -50.0, 20.0])
    beam, affine = orbit(11), np.eye(4)
    moved = ConeBeam(beam.sources @ turn.T + shift, beam.detectors @ turn.T + shift, beam.u @ turn.T, beam.v @ turn.T,
                     beam.shape)
    affine[:3, :3], affine[:3, 3] = turn @ GRID.affine[:3, :3], turn @ GRID.affine[:3, 3] + shift
    torch.testing.assert_close(density(moved, views(beam), Grid(GRID.shape, affine=affine)), density(beam), rtol=0,
                               atol=1e-6)


def test_shifted_detectors_see_the_same():
    beam = orbit(90)
    shifted = ConeBeam(beam.sources, beam.detectors + 3 * beam.u - 2 * beam.v, beam.u, beam.v, beam.shape)
    torch.testing.assert_close(density(shifted), density(beam), rtol=0, atol=0.05)


def test_the_order_of_views_and_mirrored_detectors_do_not_matter():
    beam = orbit(10, arc=230)
    order = np.random.default_rng(1).permutation(10)
    torch.testing.assert_close(density(beam.select(order)), density(beam))
    mirrored = ConeBeam(beam.sources, beam.detectors, -beam.u, beam.v, beam.shape)
    torch.testing.assert_close(density(mirrored, views(beam).flip(2)), density(beam))


def test_a_view_given_twice_counts_once():
    beam = orbit(8)
    torch.testing.assert_close(density(beam.select([*range(8), 3])), density(beam))


@pytest.mark.parametrize("arc", [60, 180, 230, 300, 345])
def test_the_angles_of_an_open_arc_add_up_to_it(arc):
    assert CircularOrbit.of(orbit(15, arc=arc), GRID).shares().sum() == pytest.approx(math.radians(arc))


def test_the_angles_of_a_circle_add_up_to_it_and_a_missing_view_opens_it():
    full = CircularOrbit.of(orbit(8), GRID)
    assert full.shares() == pytest.approx(np.full(8, math.pi / 4))
    assert (full.redundancy(np.zeros((8, 3))) == 0.5).all()
    missing = CircularOrbit.of(orbit(8).select([0, 1, 2, 4, 5, 6, 7]), GRID)
    assert missing.shares().sum() == pytest.approx(math.radians(315))


@pytest.mark.parametrize("arc", [200, 230, 300])
def test_lines_seen_from_both_sides_count_once_in_all_and_lines_seen_once_too(arc):
    """Between whole views the weight is a function of the angle: compare it at the conjugate angle."""
    views = 3600
    beam = ConeBeam.orbit(views, 1020, 740, (2, 2), 12.0, 0.3, math.radians(arc))
    scan, step = CircularOrbit.of(beam, GRID), math.radians(arc) / views
    tangents = np.tan(np.linspace(-0.25, 0.25, 11))
    weights = scan.redundancy(np.tile(tangents, (views, 1)))
    seen_twice = 0
    for j, fan in enumerate(np.arctan(tangents)):
        partner = np.arange(views) + (math.pi + 2 * scan.turns[0] * fan) / step
        partner = partner % (2 * math.pi / step)
        inside = partner < views - 1
        there = np.interp(partner[inside], np.arange(views), weights[:, len(tangents) - 1 - j])
        assert abs(weights[inside, j] + there - 1).max() < 0.002
        alone = (partner > views) & (partner < 2 * math.pi / step - 1)
        assert (weights[alone, j] == 1).all()
        seen_twice += int(inside.sum())
    assert seen_twice > 100


def test_a_limited_arc_weighs_every_line_fully():
    assert (CircularOrbit.of(orbit(8, arc=60), GRID).redundancy(np.tile(np.linspace(-0.3, 0.3, 9), (8, 1))) == 1).all()


@pytest.mark.parametrize("beam", [orbit(1), orbit(2), orbit(2, arc=180), orbit(6, arc=60), orbit(1).select([0, 0])])
def test_few_views_and_short_arcs_are_finite(beam):
    found = density(beam)
    assert found.isfinite().all() and found.abs().max() < 10


def test_opposed_views_give_in_a_box_beside_their_axis_what_they_give_around_it():
    beam = orbit(2, start=0.0)
    beside = Grid.box(32, 384.0, (0.0, 24.0, 0.0))
    of = CircularOrbit.of(beam, beside)
    assert of.centre == pytest.approx([0, 0, 0], abs=1e-6) and of.radius == pytest.approx(740)
    torch.testing.assert_close(density(beam, grid=beside)[:, :-2], density(beam)[:, 2:], rtol=0, atol=1e-6)


def test_the_axis_of_a_single_view_is_the_one_nearest_to_the_grids_centre():
    grid = Grid.box(32, 384.0, (5.0, 24.0, 0.0))
    for beam in (orbit(1, 0.0), orbit(1, 0.0).select([0, 0])):
        assert CircularOrbit.of(beam, grid).centre == pytest.approx([0, 24, 0], abs=1e-6)


def test_the_ramp_removes_the_mean_and_keeps_half_at_nyquist():
    response = ramp(1024)
    assert response[0] == pytest.approx(0, abs=1e-3) and response[-1] == pytest.approx(0.5, rel=1e-3)
    torch.testing.assert_close(response[50:450], torch.arange(50, 450).double() / 1024, rtol=5e-3, atol=0)
    assert ramp(1024, True)[-1] == pytest.approx(0, abs=1e-12)
    assert ramp(1024, True)[256] == pytest.approx(float(response[256]) / 2, rel=1e-6)


def tilted() -> ConeBeam:
    beam, turn = orbit(4), math.radians(5)
    v = beam.v.copy()
    v[2] = math.cos(turn) * beam.v[2] + math.sin(turn) * 12.0 * beam.normals[2]
    return ConeBeam(beam.sources, beam.detectors, beam.u, v, beam.shape)


def moved(**by) -> ConeBeam:
    beam = orbit(4)
    poses = {name: getattr(beam, name).copy() for name in ("sources", "detectors", "u", "v")}
    for name, step in by.items():
        poses[name][2] += step(beam)
    return ConeBeam(**poses, shape=beam.shape)


@pytest.mark.parametrize("beam, what", [
    (tilted(), "view 2 has a detector whose columns are tilted"),
    (moved(sources=lambda b: 100 * b.normals[2], detectors=lambda b: 100 * b.normals[2]), "another distance"),
    (moved(sources=lambda b: [0, 0, 50.0]), "another height"),
    (moved(u=lambda b: 3 * b.normals[2]), "faces no axis|another distance")])
def test_views_off_the_orbit_are_refused_in_one_sentence(beam, what):
    with pytest.raises(ValueError, match=what) as error:
        LINEAR.reconstruct(torch.zeros(4, 48, 60), Projector(GRID, beam))
    assert "use sirt, cgls or tv" in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize("hann", [False, True])
def test_it_gives_what_rtk_gives(hann):
    """The same views through RTK's FDK (package itk-rtk), on a full circle."""
    rtk_fdk = pytest.importorskip("baselines.rtk_fdk").rtk_fdk
    beam = orbit(60)
    theirs = rtk_fdk(views(beam).float(), GRID, beam, hann) / MU_WATER
    ours = density(beam, views(beam).float(), method=FDK(hann, window=None))
    inner = distance(centre=np.zeros(3)) < 150
    assert (ours - theirs)[inner].abs().max() < 0.02
