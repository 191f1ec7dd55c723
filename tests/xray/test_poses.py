"""Uncertain poses: their unknowns, what they change in a projection, and what no X-ray shows."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from laws import random_like
from scipy.spatial.transform import Rotation
from torch.nn.functional import pad

from phydict.grid import Grid
from phydict.xray import ConeBeam, Projector
from phydict.xray.poses.gauge import aligned, moved_as_a_whole, reprojection_errors
from phydict.xray.poses.sensitivity import pose_derivatives
from phydict.xray.poses.uncertain import Uncertain
from phydict.xray.poses.unknowns import POSE, moved
from phydict.xray.projectors.continued import reach_beyond

GRID = Grid.cube(10, 100.0)
BEAM = ConeBeam.orbit(3, 1100, 740, (9, 11), 18.0)
VALUES = np.random.default_rng(0).normal(0, 3, (3, 8))
POINTS = np.random.default_rng(1).uniform(-40, 40, (20, 3))
MOTION = np.array([4.0, -7.0, 3.0, 2.0, -1.0, 5.0])


def test_the_derivatives_of_a_projection_are_its_finite_differences():
    mu = random_like(GRID.shape, seed=2).abs()
    slopes = pose_derivatives(mu, GRID, BEAM, VALUES)[1]
    for n in range(len(POSE)):
        step = np.zeros_like(VALUES)
        step[:, n] = 1e-6
        up, down = (pose_derivatives(mu, GRID, BEAM, VALUES + sign * step)[0] for sign in (1, -1))
        torch.testing.assert_close(slopes[:, n], (up - down) / 2e-6, rtol=1e-5, atol=1e-6 * float(slopes.abs().max()))


def test_the_sampled_integrals_are_those_of_a_projector_of_trilinear_volumes():
    mu = torch.zeros(GRID.shape, dtype=torch.float64)
    mu[2:8, 3:7, 2:8] = 0.02
    sampled = pose_derivatives(mu, GRID, BEAM, VALUES)[0]
    swept = Projector(GRID, moved(BEAM, VALUES), "joseph")(mu[None, None])[0]
    assert (sampled - swept).norm() < 0.02 * swept.norm()


def test_the_derivatives_of_a_volume_that_goes_on_are_those_of_a_taller_one():
    mu, more = random_like(GRID.shape, seed=2).abs(), reach_beyond(moved(BEAM, VALUES), GRID) + 3
    tall = pad(mu[None, None], (more, more, 0, 0, 0, 0), mode="replicate")[0, 0]
    going_on = pose_derivatives(mu, GRID, replace(BEAM, continued=True), VALUES)
    taller = pose_derivatives(tall, GRID.grown(0, 0, more), BEAM, VALUES)
    for found, expected, ending in zip(going_on, taller, pose_derivatives(mu, GRID, BEAM, VALUES)):
        torch.testing.assert_close(found, expected)
        assert (found - ending).norm() > 0.01 * ending.norm()


def test_a_volume_of_nothing_has_no_derivatives():
    integrals, slopes = pose_derivatives(torch.zeros(GRID.shape), GRID, BEAM, VALUES)
    assert not integrals.any() and not slopes.any() and slopes.dtype == torch.float32


def test_what_does_not_move_stays_and_a_shifted_detector_is_a_shifted_detector():
    assert moved(BEAM, np.zeros((3, 8))).same_as(BEAM)
    shift = np.zeros((3, 8))
    shift[:, 0], shift[:, 1] = 6.0, -4.0
    assert moved(BEAM, shift).same_as(BEAM.shifted(-4.0, 6.0))


def test_a_farther_detector_magnifies_and_a_rotation_keeps_all_distances():
    farther, turn = np.zeros((3, 8)), np.zeros((3, 8))
    farther[:, 4], turn[:, 5:] = 110.0, (3.0, -20.0, 8.0)
    np.testing.assert_allclose(moved(BEAM, farther).shadows(POINTS), 1.1 * BEAM.shadows(POINTS), atol=1e-9)
    turned = moved(BEAM, turn)
    np.testing.assert_allclose(np.linalg.norm(turned.sources, axis=1), np.linalg.norm(BEAM.sources, axis=1))
    np.testing.assert_allclose(np.linalg.norm(turned.sources - turned.detectors, axis=1), 1100.0)


@pytest.mark.parametrize("method", ["siddon", "joseph"])
def test_the_whole_scene_moved_changes_no_projection(method):
    mu, beam = random_like((1, 1, *GRID.shape), seed=3).abs(), moved(BEAM, VALUES)
    world = np.eye(4)
    world[:3, :3], world[:3, 3] = Rotation.from_rotvec(np.radians(MOTION[3:])).as_matrix(), MOTION[:3]
    there = Grid(GRID.shape, affine=world @ GRID.affine)
    before = Projector(GRID, beam, method)(mu)
    after = Projector(there, moved_as_a_whole(beam, MOTION), method)(mu)
    torch.testing.assert_close(after, before, rtol=1e-6, atol=1e-9)


def test_a_beam_that_was_carried_away_is_carried_back():
    away = moved_as_a_whole(BEAM, MOTION)
    assert reprojection_errors(away, BEAM, POINTS).min() > 1
    assert aligned(away, BEAM, POINTS).same_as(BEAM, 1e-3)


def test_one_view_far_off_does_not_carry_the_others_away():
    orbit = ConeBeam.orbit(8, 1100, 740, (9, 11), 18.0)
    off = np.zeros((8, 8))
    off[5, :2] = 20.0, -30.0
    errors = reprojection_errors(aligned(moved(orbit, off), orbit, POINTS), orbit, POINTS)
    assert errors[5] > 30 and np.delete(errors, 5).max() < 1


@pytest.mark.parametrize("content, words", [
    ({"detector_shift_mm": -5}, "detector_shift_mm"), ({"rotation_degrees": 90}, "20"), ({"gain": "high"}, "gain"),
    ({"gain": True}, "True"), ({"offset": float("nan")}, "offset"), ({"detector_shift": 5}, "detector_shift_mm"),
    ({}, "exactly known"), ({"gain": 0}, "exactly known"), ([5], "mapping"), (5, "mapping")])
def test_what_is_no_standard_deviation_is_refused(content, words):
    with pytest.raises(ValueError, match=words):
        Uncertain.from_dict(content)


def test_more_unknowns_than_the_data_hold_are_refused_with_their_number():
    uncertain = Uncertain(detector_shift_mm=5, rotation_degrees=2)
    uncertain.check(2, 100)
    with pytest.raises(ValueError, match="10 unknowns of 2 views cannot be found from 16 pixels"):
        uncertain.check(2, 8)
    with pytest.raises(ValueError, match="one view leaves its 5 unknowns"):
        uncertain.check(1, 10_000)
    Uncertain(gain=0.1).check(1, 10_000)
