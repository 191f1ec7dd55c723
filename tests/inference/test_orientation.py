"""X-rays beside a standard thorax: flips, the sense of the angles and mirrored patients are told apart."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from inference.runs import record, sirt
from phydict.cli.infer import main
from phydict.datasets import phantom_case, save_xrays
from phydict.grid import Grid
from phydict.inference.orientation import in_other_sense, orientation_doubts
from phydict.units import HUWindow
from phydict.xray import ConeBeam, Projector

GRID = Grid.cube(32)
BEAM = ConeBeam.orbit(4, 1020.0, 740.0, (56, 56), 10.0, arc_degrees=180.0)


@pytest.fixture(scope="module")
def xrays() -> torch.Tensor:
    """(4, 56, 56) of a phantom."""
    return Projector(GRID, BEAM, full_detector=True)(HUWindow().to_mu(phantom_case(1, GRID)["volume"])[None])[0]


def test_angles_in_the_other_sense_are_a_reflection_that_keeps_lengths_and_is_its_own_inverse():
    other = in_other_sense(BEAM, GRID)
    negated = ConeBeam.orbit(4, 1020.0, 740.0, (56, 56), 10.0, arc_degrees=-180.0)
    for part in ("sources", "detectors", "u", "v"):
        assert np.allclose(getattr(other, part), getattr(negated, part))
        assert np.allclose(getattr(in_other_sense(other, GRID), part), getattr(BEAM, part))


def test_nothing_is_said_of_the_right_geometry(xrays):
    assert orientation_doubts(xrays, BEAM, GRID) == []


def test_the_sense_of_the_angles_and_flipped_columns_are_told_apart(xrays):
    (sense,) = orientation_doubts(xrays, in_other_sense(BEAM, GRID), GRID)
    (columns,) = orientation_doubts(xrays.flip(2), BEAM, GRID)
    for said, first in ((sense, "negate the angles"), (columns, "change flip_columns")):
        causes = {words: said.index(words) for words in ("negate the angles", "change flip_columns")}
        assert min(causes, key=causes.__getitem__) == first, said


def test_a_patient_mirrored_by_two_mistakes_that_fit_each_other_is_noticed(xrays):
    (said,) = orientation_doubts(xrays.flip(2), in_other_sense(BEAM, GRID), GRID)
    assert "the patient looks mirrored" in said


@pytest.mark.filterwarnings("default")
def test_predict_says_that_images_lie_upside_down_and_the_record_keeps_it(xrays, tmp_path, capsys):
    save_xrays(tmp_path / "case", xrays.flip(1), BEAM)
    main(sirt("predict", tmp_path / "out", f"--data.xrays={tmp_path / 'case'}"))
    said = "view 0, 1, 2, 3 agrees better with a standard thorax when upside down: row 0 is superior, change flip_rows"
    assert said in record(tmp_path / "out" / "sirt" / "case")["warnings"] and said in capsys.readouterr().err
