"""Poses found with the volume: what is marginalised, the true poses stay, and wrong ones are found."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from laws import assert_adjoint, random_like

from phydict.datasets import Thorax, build
from phydict.grid import Grid
from phydict.poses import find_poses
from phydict.poses.blind import BlindMeasurement
from phydict.poses.search import PoseSearch, State, Views, carried, middle_points
from phydict.posterior import Measurement
from phydict.units import HUWindow, hu_to_mu
from phydict.xray import ConeBeam, Projector
from phydict.xray.poses.gauge import aligned, drawn_back, moved_as_a_whole, reprojection_errors
from phydict.xray.poses.uncertain import Uncertain
from phydict.xray.poses.unknowns import moved

GRID = Grid.cube(24)
BEAM = ConeBeam.orbit(8, 1150, 740, (48, 48), 12.5)
UNCERTAIN = Uncertain(detector_shift_mm=5, source_shift_mm=5, source_to_detector_mm=5, rotation_degrees=2)
POINTS = middle_points(GRID)
SEARCH = PoseSearch(coarse=0, fine=8)


@pytest.fixture(scope="module")
def thorax():
    return hu_to_mu(torch.from_numpy(build(Thorax.standard(), GRID)[0]))[None, None]


def xrays(mu, beam):
    return Projector(GRID, beam, "siddon", full_detector=True)(mu)[0]


def error(beam, true):
    """mm on the detector, root mean square over views, once the scene is carried to where it was."""
    return float(np.sqrt((reprojection_errors(aligned(beam, true, POINTS), true, POINTS) ** 2).mean()))


def blind(spread: float, now=None):
    grid, beam = Grid.cube(6), ConeBeam.orbit(3, 1150, 740, (7, 9), 60.0)
    plain = Measurement(Projector(grid, beam), random_like((3, 7, 9), seed=1).abs(), HUWindow())
    changes = spread * random_like((3, 4, 7, 9), seed=2)
    now = torch.zeros(3, 4, dtype=torch.float64) if now is None else now
    return plain, changes, BlindMeasurement(plain, changes, now, 0.5)


def test_what_is_left_of_the_data_term_is_its_minimum_over_the_unknowns():
    now, x = random_like((3, 4), seed=3), random_like((1, 1, 6, 6, 6), seed=4).clamp(-1, 1)
    plain, changes, marginal = blind(0.3, now)
    residual = plain.y - plain.project(x) + torch.einsum("km,kmvu->kvu", now, changes)
    columns, flat = changes.flatten(2).transpose(1, 2), residual.flatten(2)[0][..., None]
    normal = columns.transpose(1, 2) @ columns / 0.25 + torch.eye(4)
    best = torch.linalg.solve(normal, columns.transpose(1, 2) @ flat / 0.25)
    least = ((flat - columns @ best).square().sum() / 0.25 + best.square().sum())
    torch.testing.assert_close((marginal.y - marginal.project(x)).square().sum() / 0.25, least)


def test_a_blind_measurement_has_an_exact_adjoint_and_does_not_see_large_unknowns():
    plain, changes, marginal = blind(1e5)
    assert_adjoint(marginal.linear, marginal.adjoint, (1, 1, 6, 6, 6))
    assert marginal.filtered(changes[:, 1][None]).norm() < 1e-3 * changes[:, 1].norm()
    torch.testing.assert_close(blind(0.0)[2].y, plain.y)


def test_random_errors_of_every_view_are_found(thorax):
    true = moved(BEAM, np.random.default_rng(2).normal(0, 1, (8, 8)) * UNCERTAIN.poses)
    found = find_poses(xrays(thorax, true), BEAM, UNCERTAIN, GRID, search=SEARCH)
    before, after = error(BEAM, true), error(found.beam, true)
    assert before > 8 and after < 3
    assert found.misfits[1] < 0.5 * found.misfits[0]
    assert not found.warnings()  # though single unknowns, which others make up for, were moved by more than is stated
    np.testing.assert_allclose(found.shift[0], reprojection_errors(aligned(true, BEAM, POINTS), BEAM, POINTS), atol=3)


def test_true_poses_stay(thorax):
    y = Projector(GRID, BEAM, full_detector=True)(thorax)[0]  # as the search projects: voxels are as coarse as pixels
    y = y + 0.02 * y.max() * random_like(y.shape, seed=0).to(y)
    found = find_poses(y, BEAM, UNCERTAIN, GRID, search=SEARCH)
    assert found.beam.same_as(BEAM) and not found.corrections.any()


def test_one_wrong_view_is_found_corrected_and_named(thorax):
    wrong = np.zeros((8, 8))
    wrong[5, 0] = 40.0
    true = moved(BEAM, wrong)
    found = find_poses(xrays(thorax, true), BEAM, UNCERTAIN, GRID, search=SEARCH)
    assert error(found.beam, true) < 3
    said = found.warnings()
    assert len(said) == 1 and said[0].startswith("view 5 (counted from 0) was corrected by")


def test_breathing_between_the_views_is_said(thorax):
    still = xrays(thorax, BEAM)
    lower = xrays(torch.cat([thorax[..., 1:12], thorax[..., 12:13], thorax[..., 12:]], -1), BEAM)
    breathed = torch.where((torch.arange(8) % 2 == 1)[:, None, None], lower, still)
    said = [find_poses(y, BEAM, UNCERTAIN, GRID, search=SEARCH).warnings() for y in (still, breathed)]
    assert not said[0] and any("the patient breathed or moved" in words for words in said[1])


def test_gains_are_found_and_taken_out(thorax):
    clean = xrays(thorax, BEAM)
    drifted = (clean * torch.linspace(0.9, 1.1, 8)[:, None, None]).float()
    found = find_poses(drifted, BEAM, Uncertain(gain=0.1), GRID, search=SEARCH)
    assert found.beam.same_as(BEAM) and set(found.record()["corrections"]) == {"gain"}
    assert (found.corrected(drifted) - clean).norm() < 0.3 * (drifted - clean).norm()


def test_dead_pixels_pull_the_poses_along_less_than_least_squares_would_let_them(thorax):
    """Residuals far beyond a view's own count less (Huber)."""
    true = moved(BEAM, np.random.default_rng(0).normal(0, 1, (8, 8)) * UNCERTAIN.poses)
    y = xrays(thorax, true)
    y[torch.rand(y.shape, generator=torch.Generator().manual_seed(1)) < 0.003] = 0
    huber, squares = (error(find_poses(y, BEAM, UNCERTAIN, GRID, search=search).beam, true)
                      for search in (SEARCH, replace(SEARCH, huber=1e9)))
    assert huber < 0.95 * squares and huber < 0.5 * error(BEAM, true)


def test_a_detector_past_the_middle_of_the_volume_shortens_the_step_of_its_view_alone(thorax):
    views = Views(xrays(thorax, BEAM), BEAM, GRID, torch.ones(10), 0.02, SEARCH)
    step = torch.zeros(8, 10)
    step[:, 4] = -150.0  # towards the source, some into corners of the box
    assert not moved(BEAM, step[:, :8].double().numpy()).has_room_for(GRID)
    assert torch.equal(views.clear(torch.zeros(8, 10), step), step)
    step[3, 4] = -900.0
    clear = views.clear(torch.zeros(8, 10), step)
    assert torch.equal(clear[[0, 1, 2, 4, 5, 6, 7]], step[[0, 1, 2, 4, 5, 6, 7]]) and -900 < clear[3, 4] < 0
    assert drawn_back(moved(BEAM, clear[:, :8].double().numpy()), GRID).has_room_for(GRID)
    step[3, 4] = -1e5  # half of it, and half of that, is still too far
    assert not views.clear(torch.zeros(8, 10), step)[3].any()


def test_views_drawn_back_measure_the_same_and_those_with_room_stay_as_they_are(thorax):
    beam = moved(BEAM, np.outer([0, -200, 0, 0, 0, -150, 0, 0], np.eye(8)[4]))
    small = GRID.grown(-4, -4, 0)
    back = drawn_back(beam, GRID)
    assert not beam.has_room_for(GRID) and back.has_room_for(GRID)
    inside = thorax[..., 4:-4, 4:-4, :]
    padded = torch.nn.functional.pad(inside, (0, 0, 4, 4, 4, 4))
    torch.testing.assert_close(xrays(padded, back), Projector(small, beam, "siddon", full_detector=True)(inside)[0])
    assert back.select([0, 2, 3, 4, 6, 7]).same_as(beam.select([0, 2, 3, 4, 6, 7]), tolerance=0)


def test_detectors_near_the_corners_of_the_volume_stop_no_search_and_lie_behind_it_at_the_end(thorax):
    close = ConeBeam.orbit(8, 1020, 740, (48, 48), 11.0)  # 8 mm behind the corners
    true = moved(close, np.random.default_rng(4).normal(0, 1, (8, 8)) * UNCERTAIN.poses)
    found = find_poses(xrays(thorax, drawn_back(true, GRID)), close, UNCERTAIN, GRID, search=replace(SEARCH, fine=7))
    found.beam.check(GRID)
    assert error(found.beam, true) < 0.3 * error(close, true)


def test_a_beam_is_not_carried_to_where_its_source_lies_in_the_volume():
    outside = ConeBeam.orbit(1, 1150, 210, (48, 48), 60.0)  # 18 mm before the volume
    near, inside = (moved_as_a_whole(outside, np.array([0, mm, 0, 0, 0, 0])) for mm in (10.0, 30.0))
    assert carried(outside, near, POINTS, GRID).same_as(near, tolerance=0.1)
    assert carried(outside, inside, POINTS, GRID) is outside


def test_a_search_that_goes_astray_on_finer_voxels_ends_in_the_nominal_poses(thorax, monkeypatch):
    true = moved(BEAM, np.random.default_rng(0).normal(0, 1, (8, 8)) * UNCERTAIN.poses)
    improve = Views.improve

    def astray(views, state):
        improve(views, state)
        state.theta = state.theta + (views.grid.shape == GRID.shape) * 60.0 * torch.eye(10)[:8]

    monkeypatch.setattr(Views, "improve", astray)
    found = find_poses(xrays(thorax, true), BEAM, UNCERTAIN, GRID, search=PoseSearch(coarse=3, fine=1))
    assert found.beam.same_as(BEAM) and not found.corrections.any() and found.misfits[0] == found.misfits[1]


def test_x_rays_of_nothing_have_no_poses_and_a_volume_of_air_sways_by_nothing():
    with pytest.raises(ValueError, match="are 0 in every pixel"):
        find_poses(torch.zeros(8, 48, 48), BEAM, UNCERTAIN, GRID)
    views = Views(torch.rand(8, 48, 48), BEAM, GRID, torch.ones(10), 0.02, SEARCH)
    state = State(torch.zeros(8, 10), torch.zeros(8, 10), torch.full((1, 1, *GRID.shape), -1.0))
    assert not views.sway(state).any()


@pytest.mark.parametrize("display, unknowns", [(False, 16), (True, 32)])
def test_more_unknowns_than_the_pixels_hold_are_refused_gains_of_display_values_included(display, unknowns):
    beam = ConeBeam.orbit(8, 1150, 740, (2, 2), 300.0)
    with pytest.raises(ValueError, match=f"{unknowns} unknowns of 8 views cannot be found from 32 pixels"):
        find_poses(torch.rand(8, 2, 2), beam, Uncertain(detector_shift_mm=5), GRID, display)


def test_poses_are_found_in_inference_mode_too(thorax):
    views, search = xrays(thorax, BEAM), PoseSearch(coarse=0, fine=1)
    wrong = BEAM.shifted(columns=6)
    with torch.inference_mode():
        inside = find_poses(views, wrong, UNCERTAIN, GRID, search=search)
    assert inside.beam.same_as(find_poses(views, wrong, UNCERTAIN, GRID, search=search).beam)
    assert not inside.beam.same_as(wrong)
