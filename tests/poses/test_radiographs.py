"""Two plain radiographs of a patient who turned by hand: their poses, what is said of them, and what is refused."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from command_lines import refusal
from dicom_files import orbit_tags, write_dicom
from prior.tiny import tiny_refiner

from phydict.cli.infer import main
from phydict.datasets import Thorax, build, load_xrays
from phydict.grid import Grid
from phydict.poses import FoundPoses, PoseSearch, find_poses
from phydict.poses.found import FEW_WIDENING, SWAY_WIDENING
from phydict.poses.search import middle_points
from phydict.prior import save_refiner
from phydict.reconstruction import Reconstruction
from phydict.units import hu_to_mu
from phydict.xray import ConeBeam, Projector
from phydict.xray.poses.gauge import aligned, reprojection_errors
from phydict.xray.poses.uncertain import Uncertain, by_hand
from phydict.xray.poses.unknowns import moved

PAIR = Path(__file__).parents[2] / "data" / "example" / "two_radiographs" / "xrays"
GRID = Grid.cube(24)
BEAM = ConeBeam.at_angles([0, 90], 1800, 1400, (48, 48), 10.0)
POINTS = middle_points(GRID)


@pytest.fixture(scope="module")
def turned():
    """Display values of a pair, and where the views really were."""
    values = np.zeros((2, 8))
    values[1, [1, 4]] = 15.0, -120.0
    true = aligned(moved(BEAM, values), BEAM, POINTS)
    mu = hu_to_mu(torch.from_numpy(build(Thorax.standard(), GRID)[0]))[None, None]
    lines = Projector(GRID, true, "siddon", full_detector=True)(mu)[0]
    return 0.3 * lines + torch.tensor([0.1, 0.4])[:, None, None], true


def error(beam, true):
    return float(np.sqrt((reprojection_errors(aligned(beam, true, POINTS), true, POINTS) ** 2).mean()))


def test_views_of_a_pair_are_brought_to_one_height_and_size_and_what_a_pair_cannot_show_is_said_once(turned):
    display, true = turned
    uncertain = Uncertain(detector_shift_mm=10, source_to_detector_mm=108)
    found = find_poses(display, BEAM, uncertain, GRID, display=True, search=PoseSearch(coarse=0, fine=10))
    assert error(found.beam, true) < 0.6 * error(BEAM, true)
    assert found.misfits[1] < 0.5 * found.misfits[0]
    [said] = found.warnings()
    assert said.startswith("2 views show the volume from so few sides") and "lengths are as right as" in said


def test_display_values_whose_distance_is_open_too_are_refused_and_line_integrals_are_not(turned):
    display, _ = turned
    search, open_distance = PoseSearch(coarse=0, fine=1), Uncertain(source_to_detector_mm=190)
    near = ConeBeam.at_angles([0, 90], 900, 640, (48, 48), 10.0)
    with pytest.raises(ValueError, match="no scale of density.* none of size.*pixel size and distances.*line integr"):
        find_poses(display, near, open_distance, GRID, display=True, search=search)
    assert find_poses(display, near, open_distance, GRID, search=search).beam.views == 2
    assert find_poses(display, BEAM, open_distance, GRID, display=True, search=search).beam.views == 2


def test_intervals_widen_where_the_poses_of_few_views_were_searched_or_the_patient_moved():
    def widening(views, sway=0.0, **uncertain):
        beam = ConeBeam.orbit(views, 1800, 1400, (48, 48), 10.0)
        found = FoundPoses(beam, Uncertain(**uncertain).deviations, np.zeros((views, 10)), np.ones((views, 10)),
                           (0.1, 0.1), np.outer([sway, 0.1], np.arange(views)), np.zeros((2, views)), 1.0)
        plain = Reconstruction(torch.zeros(2, 2, 2), Grid.cube(2), "any", 0, 0.0, [0.0] * views, {}, torch.zeros(1),
                               torch.zeros(1), intervals={0.9: torch.full((2, 2, 2), 100.0)}, interval_widening=2.0)
        result, widest = found.added_to(plain), replace(plain, intervals={0.9: torch.full((2, 2, 2), 1990.0)})
        assert found.added_to(widest).intervals[0.9].max() <= 2000  # HU, the whole window
        assert found.added_to(replace(plain, intervals={})).interval_widening == plain.interval_widening
        return float(result.intervals[0.9].max()) / 100, result.interval_widening / 2

    assert widening(2, rotation_degrees=2) == (FEW_WIDENING, FEW_WIDENING)
    assert widening(2, gain=0.1) == widening(3, rotation_degrees=2) == widening(3, 0.5, gain=0.1) == (1, 1)
    assert widening(3, 2.0, rotation_degrees=2) == (SWAY_WIDENING, SWAY_WIDENING)  # between the first view and the last


@pytest.mark.filterwarnings("default")
def test_a_dicom_pair_alone_gives_a_volume_an_interval_and_what_was_assumed_in_words(tmp_path, capsys):
    save_refiner(tiny_refiner(uncertain=True), tmp_path / "tiny.safetensors", dtype=torch.float32)
    command = ["predict", f"--model.prior={tmp_path / 'tiny.safetensors'}", f"--data.xrays={PAIR}", "--calibrate",
               f"--model.out={tmp_path / 'out'}", "--trainer.accelerator=cpu"]
    main(command)
    done = tmp_path / "out" / "phydict_learned" / "xrays"
    assert {"volume.nii.gz", "interval_90.nii.gz", "geometry_found.yaml"} <= {file.name for file in done.iterdir()}
    record = json.loads((done / "reconstruction.json").read_text())
    assert [len([words for words in record["warnings"] if words.startswith(start)]) for start in (
        "the tags do not say how exactly", "2 views show the volume from so few sides")] == [1, 1]


def test_tags_of_an_angiography_and_words_in_a_file_are_not_overruled(tmp_path):
    tags = orbit_tags(2, 1020.0, 740.0, (5.0, 5.0)) | {"PixelIntensityRelationship": "LOG",
                                                       "PixelIntensityRelationshipSign": 1}
    noise = np.random.default_rng(0).integers(0, 4000, (2, 8, 8)).astype(np.uint16)
    assert load_xrays(write_dicom(tmp_path / "run" / "a.dcm", noise, **tags).parent)["uncertain"] is None
    assert load_xrays(PAIR)["uncertain"] == by_hand(load_xrays(PAIR)["beam"])
    shutil.copytree(PAIR, tmp_path / "pair")
    (tmp_path / "pair" / "geometry.yaml").write_text("uncertain: {rotation_degrees: 3}\n")
    assert load_xrays(tmp_path / "pair")["uncertain"] == Uncertain(rotation_degrees=3)


def test_display_images_without_any_scale_are_refused_before_anything_is_searched(tmp_path, capsys):
    folder = tmp_path / "anna"
    folder.mkdir()
    for view in range(2):
        np.save(folder / f"view_{view}.npy", np.arange(64, dtype=np.uint16).reshape(8, 8) + view)
    (folder / "geometry.yaml").write_text(yaml.safe_dump({
        "intensity": {"kind": "display", "bright_is_dense": True}, "uncertain": {"detector_shift_mm": 5}}))
    said = refusal(capsys, main, ["predict", "--model.method=sirt", f"--data.xrays={folder}", "--calibrate",
                                  f"--model.out={tmp_path / 'out'}", "--trainer.accelerator=cpu"])
    assert "have no scale; state `beam:` with pixel size and distances in mm" in said
