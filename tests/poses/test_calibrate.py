"""`--calibrate`: poses that a geometry file is not sure of, found, used, written and read again."""

import json

import nibabel
import numpy as np
import pytest
import torch
import yaml
from command_lines import refusal

from phydict import reconstruct
from phydict.baselines import SIRT
from phydict.cli.infer import main
from phydict.datasets import Thorax, build, load_xrays, save_xrays
from phydict.grid import Grid
from phydict.poses import PoseSearch, find_poses
from phydict.units import hu_to_mu
from phydict.xray import ConeBeam, Projector
from phydict.xray.poses.uncertain import Uncertain
from phydict.xray.poses.unknowns import moved

GRID = Grid.cube(16)
BEAM = ConeBeam.orbit(5, 1150, 740, (24, 24), 25.0)  # of opposed views, either could be the wrong one
SHIFT = np.zeros((5, 8))
SHIFT[1, 0] = 30.0
UNCERTAIN = {"detector_shift_mm": 5, "gain": 0.1}


@pytest.fixture(scope="module")
def xrays():
    mu = hu_to_mu(torch.from_numpy(build(Thorax.standard(), GRID)[0]))[None, None]
    return Projector(GRID, moved(BEAM, SHIFT), "siddon", full_detector=True)(mu)[0]


@pytest.fixture
def case(xrays, tmp_path):
    """A folder of X-rays whose geometry file is wrong about view 1 and says that it may be."""
    save_xrays(tmp_path / "anna", xrays, BEAM)
    describe(tmp_path / "anna", UNCERTAIN)
    return tmp_path / "anna"


def describe(folder, uncertain):
    file = folder / "geometry.yaml"
    content = {name: value for name, value in yaml.safe_load(file.read_text()).items() if name != "uncertain"}
    file.write_text(yaml.safe_dump(content | ({} if uncertain is None else {"uncertain": uncertain})))


def predict(case, out, *more):
    return ["predict", "--model.method=sirt", "--model.method.init_args.iterations=5", "--model.grid.voxels=16",
            f"--data.xrays={case}", f"--model.out={out}", "--trainer.accelerator=cpu", *more]


@pytest.mark.filterwarnings("default:view 1")
def test_a_calibration_is_recorded_warned_of_written_and_can_be_given_back(case, tmp_path, capsys):
    main(predict(case, tmp_path / "out", "--calibrate"))
    done = tmp_path / "out" / "sirt" / "anna"
    record = json.loads((done / "reconstruction.json").read_text())
    assert set(record["poses"]["corrections"]) == set(record["poses"]["standard_errors"]) == {
        "detector_shift_columns_mm", "detector_shift_rows_mm", "gain"}
    assert all(error > 0 for errors in record["poses"]["standard_errors"].values() for error in errors)
    assert any(words.startswith("view 1 (counted from 0) was corrected by") for words in record["warnings"])
    assert record["settings"]["calibrate"] is True and record["seconds"]["calibrate"] > 0
    assert "other settings" in refusal(capsys, main, predict(case, tmp_path / "out"))
    main(predict(case, tmp_path / "again", f"--data.geometry={done / 'geometry_found.yaml'}"))
    one, other = (np.asarray(nibabel.load(folder / "volume.nii.gz").dataobj)
                  for folder in (done, tmp_path / "again" / "sirt" / "anna"))
    assert np.abs(one - other).mean() < 20  # HU: the gains found are not in the file, but that they are uncertain is
    assert load_xrays(case, done / "geometry_found.yaml")["uncertain"] == Uncertain(gain=0.1)


def test_without_a_calibration_nothing_is_searched(case, tmp_path):
    main(predict(case, tmp_path / "out"))
    done = tmp_path / "out" / "sirt" / "anna"
    assert "poses" not in json.loads((done / "reconstruction.json").read_text())
    assert not (done / "geometry_found.yaml").exists()


def test_in_python_the_result_holds_the_beam(case):
    given = load_xrays(case)
    assert given["uncertain"] == Uncertain(detector_shift_mm=5, gain=0.1)
    with pytest.warns(UserWarning, match="view 1"):
        result = reconstruct(given["xrays"], given["beam"], method=SIRT(iterations=20), grid=GRID,
                             uncertain=given["uncertain"])
    plain = reconstruct(given["xrays"], given["beam"], method=SIRT(iterations=20), grid=GRID)
    assert result.misfit < 0.7 * plain.misfit and plain.beam is None
    assert not result.beam.same_as(BEAM, 1.0)


def test_every_round_of_the_search_is_told(case):
    given, search, told = load_xrays(case), PoseSearch(2, 1), []
    find_poses(given["xrays"], given["beam"], given["uncertain"], GRID, search=search, on_round=lambda: told.append(1))
    assert len(told) == search.rounds == 3


@pytest.mark.parametrize("uncertain, words", [
    (None, "state `uncertain:` there"), ({"detector_shift_mm": -5}, "standard deviation"),
    ({"detector_shift": 5}, "unknown 'detector_shift'"), (7, "mapping")])
def test_what_cannot_be_calibrated_is_refused(case, tmp_path, capsys, uncertain, words):
    describe(case, uncertain)
    said = refusal(capsys, main, predict(case, tmp_path / "out", "--calibrate"))
    assert words in said and "geometry.yaml" in said
    assert not (tmp_path / "out" / "sirt" / "anna").exists()


def test_one_view_alone_is_refused_with_the_number_of_its_unknowns(xrays, tmp_path, capsys):
    save_xrays(tmp_path / "anna", xrays[:1], BEAM.select([0]))
    describe(tmp_path / "anna", UNCERTAIN)
    said = refusal(capsys, main, predict(tmp_path / "anna", tmp_path / "out", "--calibrate"))
    assert "one view leaves its 2 unknowns of pose undecided" in said
    assert not (tmp_path / "out" / "sirt" / "anna").exists()
