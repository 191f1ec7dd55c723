"""X-rays beside a standard thorax: flips, the sense of the angles and mirrored patients are told apart."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
import torch

from inference.runs import record, sirt
from phydict.cli.infer import main
from phydict.datasets import phantom_case, save_xrays
from phydict.grid import Grid
from phydict.inference.orientation import (
    TURNS,
    correlation,
    in_other_sense,
    moved_agreements,
    orientation_doubts,
    rotated,
    thorax_views,
)
from phydict.units import HUWindow
from phydict.xray import ConeBeam, Projector

GRID = Grid.cube(32)
BEAM = ConeBeam.orbit(4, 1020.0, 740.0, (56, 56), 10.0, arc_degrees=180.0)


PATIENT = phantom_case(1, GRID)["volume"]
C_ARM = ConeBeam.at_angles([0.0, 37.5, 75.0, 112.5, 150.0], 1500.0, 1100.0, (48, 60), 8.0)


def views(beam: ConeBeam, volume: torch.Tensor = PATIENT) -> torch.Tensor:
    """X-rays (K, V, U) of a CT (1, 32, 32, 32) in the prior's range."""
    return Projector(GRID, beam, full_detector=True)(HUWindow().to_mu(volume)[None])[0]


@pytest.fixture(scope="module")
def xrays() -> torch.Tensor:
    """(4, 56, 56) of a phantom."""
    return views(BEAM)


def test_angles_in_the_other_sense_are_a_reflection_that_keeps_lengths_and_is_its_own_inverse():
    other = in_other_sense(BEAM, GRID)
    negated = ConeBeam.orbit(4, 1020.0, 740.0, (56, 56), 10.0, arc_degrees=-180.0)
    for part in ("sources", "detectors", "u", "v"):
        assert np.allclose(getattr(other, part), getattr(negated, part))
        assert np.allclose(getattr(in_other_sense(other, GRID), part), getattr(BEAM, part))


def test_the_other_sense_of_the_angles_keeps_the_shift_of_the_detector():
    other, negated = in_other_sense(C_ARM.shifted(10.0, 25.0), GRID), ConeBeam.at_angles(
        [0.0, -37.5, -75.0, -112.5, -150.0], 1500.0, 1100.0, (48, 60), 8.0).shifted(10.0, 25.0)
    for part in ("sources", "detectors", "u", "v"):
        assert np.allclose(getattr(other, part), getattr(negated, part))
        assert np.allclose(getattr(in_other_sense(other, GRID), part), getattr(C_ARM.shifted(10.0, 25.0), part))


def test_images_are_correlated_with_every_part_of_wider_ones():
    images, wide = torch.rand(2, 5, 4), torch.rand(2, 7, 9)
    found = moved_agreements(images, wide)
    assert found.shape == (2, 3, 6)
    for k, row, column in np.ndindex(*found.shape):
        part = wide[k, row:row + 5, column:column + 4]
        assert float(found[k, row, column]) == pytest.approx(correlation(images[k].numpy(), part.numpy()), abs=1e-4)


def test_nothing_is_said_of_the_right_geometry(xrays):
    assert orientation_doubts(xrays, BEAM, GRID) == []


@pytest.mark.parametrize("degrees", [90, 135, 270])
def test_an_orbit_that_begins_elsewhere_is_named_with_the_angle(degrees):
    right, stated = (ConeBeam.orbit(8, 1020.0, 740.0, (56, 56), 10.0, start_degrees=d) for d in (degrees, 0))
    for part in ("sources", "detectors", "u", "v"):
        assert np.allclose(getattr(rotated(stated, GRID, degrees), part), getattr(right, part))
    seen = views(right)
    (said,) = orientation_doubts(seen, stated, GRID)
    assert f"turned about the patient, by {degrees} degrees more of start_degrees" in said
    assert orientation_doubts(seen, right, GRID) == []


def test_half_a_turn_is_told_from_flipped_columns_by_the_sources_side(xrays):
    (said,) = orientation_doubts(xrays, rotated(BEAM, GRID, 180), GRID)
    assert "turned by half about the patient" in said and "180 degrees more of start_degrees" in said
    (flipped,) = orientation_doubts(xrays.flip(2), BEAM, GRID)
    assert "by half" not in flipped


def test_axes_to_left_and_posterior_are_named(xrays):
    lps = replace(BEAM, **{name: getattr(BEAM, name) * (-1, -1, 1) for name in ("sources", "detectors", "u", "v")})
    (said,) = orientation_doubts(xrays, lps, GRID)
    assert "lead to left and posterior, change the signs of x and y" in said


def test_a_lateral_view_alone_is_not_taken_for_an_oblique_one():
    lateral = ConeBeam.orbit(1, 1020.0, 740.0, (48, 48), 12.0, start_degrees=270)
    assert orientation_doubts(views(lateral), lateral, GRID) == []


def test_the_sense_of_the_angles_and_flipped_columns_are_told_apart(xrays):
    (sense,) = orientation_doubts(xrays, in_other_sense(BEAM, GRID), GRID)
    (columns,) = orientation_doubts(xrays.flip(2), BEAM, GRID)
    for said, first in ((sense, "negate the angles"), (columns, "change flip_columns")):
        causes = {words: said.index(words) for words in ("negate the angles", "change flip_columns")}
        assert min(causes, key=causes.__getitem__) == first, said


@pytest.mark.parametrize("axes, words", [((1,), "flip rows in the image"), ((2,), "flip columns in the image"),
                                         ((1, 2), "flip rows and columns in the image")])
def test_one_flipped_view_is_to_be_mended_alone(axes, words):
    stored = views(C_ARM)
    stored[1] = stored[1].flip([axis - 1 for axis in axes])
    (said,) = orientation_doubts(stored, C_ARM, GRID)
    assert said.startswith("view 1 ") and words in said and "change flip" not in said and "negate" not in said


def test_a_patient_mirrored_by_two_mistakes_that_fit_each_other_is_noticed(xrays):
    (said,) = orientation_doubts(xrays.flip(2), in_other_sense(BEAM, GRID), GRID)
    assert "the patient looks mirrored" in said


def test_of_three_ways_to_mend_a_mirrored_patient_the_one_that_agrees_best_is_named_first(xrays):
    (said,) = orientation_doubts(xrays.flip(2), in_other_sense(BEAM, GRID), GRID)
    ways = "change flip_columns and negate the angles", "change flip_columns alone", "negate the angles alone"
    values = {way: float(value) for way, value in re.findall(rf"({'|'.join(ways)}) \((.*?)\)", said)}
    assert len(values) == 3 and list(values.values()) == sorted(values.values(), reverse=True)
    assert next(iter(values)) == ways[0]


def test_the_wrong_sense_of_the_angles_is_named_where_the_detector_is_shifted():
    shifted = C_ARM.shifted(10.0, 25.0)
    (said,) = orientation_doubts(views(shifted), in_other_sense(shifted, GRID), GRID)
    assert -1 < said.index("negate the angles") < said.index("change flip_columns")


@pytest.mark.parametrize("told", [(-10.0, -25.0), (0.0, 0.0), (10.0, 85.0)])
def test_a_wrong_shift_of_the_detector_is_named_and_no_flip_advised(told):
    (said,) = orientation_doubts(views(C_ARM.shifted(10.0, 25.0)), C_ARM.shifted(*told), GRID)
    assert "detector_shift" in said and "flip" not in said and f"columns are {told[1]:+.0f} mm as stated" in said
    assert float(re.search(r"about ([-+]\d+) mm would fit", said)[1]) == pytest.approx(25, abs=15)


@pytest.mark.parametrize("x, y, z", [(2, 2, 0), (-2, 2, 2), (2, -2, -2)])
def test_a_patient_beside_the_middle_is_no_wrong_shift_and_no_flip(x, y, z):
    moved = torch.roll(PATIENT, (x, y, z), (1, 2, 3))  # by 24 mm
    for beam in (BEAM, C_ARM):
        assert orientation_doubts(views(beam, moved), beam, GRID) == []


@pytest.mark.parametrize("turn", TURNS)
@pytest.mark.parametrize("beam", [BEAM, C_ARM])
def test_images_that_lie_are_named_with_what_turns_them_up(turn, beam):
    turned = views(beam).numpy()[:, :, ::-1 if turn.flip_columns else 1]
    stored = np.rot90(turned, turn.rotate_degrees // 90, axes=(1, 2)).copy()
    assert np.array_equal(turn.apply(stored), views(beam).numpy())
    (said,) = orientation_doubts(torch.from_numpy(stored), replace(beam, shape=stored.shape[1:]), GRID)
    words = f"{{rotate_degrees: {turn.rotate_degrees}" + ", flip_columns: true" * turn.flip_columns + "}"
    assert words in said and str(list(beam.shape)) in said


@pytest.mark.parametrize("shape, pixel", [((96, 144), (5.0, 5.0)), ((60, 60), (8.0, 5.0))])
def test_a_standard_thorax_that_lies_agrees_wholly_once_it_is_turned_up(shape, pixel):
    beam, lying = (ConeBeam.orbit(3, 1020.0, 740.0, shape[::way], pixel[::way], arc_degrees=180.0) for way in (1, -1))
    stored = np.rot90(thorax_views(GRID, beam), axes=(1, 2)).copy()
    (said,) = orientation_doubts(torch.from_numpy(stored), lying, GRID)
    assert float(re.search(r"mean agreement ([\d.]+)", said)[1]) > 0.99


@pytest.mark.filterwarnings("default")
def test_predict_says_that_images_lie_upside_down_and_the_record_keeps_it(xrays, tmp_path, capsys):
    save_xrays(tmp_path / "case", xrays.flip(1), BEAM)
    main(sirt("predict", tmp_path / "out", f"--data.xrays={tmp_path / 'case'}"))
    said = "view 0, 1, 2, 3 agrees better with a standard thorax when upside down: row 0 is superior, change flip_rows"
    assert said in record(tmp_path / "out" / "sirt" / "case")["warnings"] and said in capsys.readouterr().err
