"""A dry run: the geometry of every case is drawn, and nothing is reconstructed."""

from __future__ import annotations

import re
import shutil
from dataclasses import replace

import pytest
import torch
from command_lines import refusal
from PIL import Image

from inference.runs import contents, names, phantoms, sirt
from phydict.cli.infer import main
from phydict.datasets import load_xrays, phantom_case, save_xrays
from phydict.grid import Grid
from phydict.inference.dry_run import dry_run
from phydict.methods import reconstruct
from phydict.runtime.shipped import shipped
from phydict.units import HUWindow
from phydict.xray import ConeBeam, Projector


def test_a_dry_run_draws_every_case_and_reconstructs_nothing(measured, tmp_path, capsys):
    main(sirt("predict", tmp_path, f"--data.xrays={measured}", "--dry_run"))
    assert names(tmp_path) == ["dry_run"] and names(tmp_path / "dry_run") == ["anna.png", "bert.png"]
    with Image.open(tmp_path / "dry_run" / "anna.png") as page:
        assert min(page.size) > 900
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 7 and lines[-1] == f"pages in {tmp_path / 'dry_run'}"
    pose, agreement = lines[0].rsplit(" ", 1)
    assert re.fullmatch("anna view 0: source posterior, columns to left, rows to inferior; line integrals from 0 to "
                        "[1-9][0-9.]*; agreement", pose)
    assert float(agreement) > 0.7
    assert not any("better" in line for line in lines)


@pytest.mark.filterwarnings("ignore:case. view")
def test_a_dry_run_takes_a_geometry_by_its_name(measured, tmp_path, capsys):
    orbit = ConeBeam.load(shipped("configs/geometry/paper_orbit.yaml"))
    save_xrays(tmp_path / "case", torch.rand(orbit.views, *orbit.shape), orbit)
    (tmp_path / "case" / "geometry.yaml").unlink()
    main(sirt("predict", tmp_path / "out", f"--data.xrays={tmp_path / 'case'}", "--data.geometry=paper_orbit",
              "--dry_run"))
    assert names(tmp_path / "out" / "dry_run") == ["case.png"]


@pytest.mark.filterwarnings("default")
def test_a_dry_run_sees_images_that_lie_upside_down(measured, tmp_path, capsys):
    case = load_xrays(measured / "anna")
    save_xrays(tmp_path / "case", case["xrays"].flip(1), case["beam"])
    main(sirt("predict", tmp_path / "out", f"--data.xrays={tmp_path / 'case'}", "--dry_run"))
    out, err = capsys.readouterr()
    assert all("with flip_rows changed" in line for line in out.splitlines()[:3]) and "upside down" in err
    save_xrays(tmp_path / "case", case["xrays"].flip(1, 2), case["beam"], overwrite=True)
    main(sirt("predict", tmp_path / "out", f"--data.xrays={tmp_path / 'case'}", "--dry_run"))
    assert "turned by 180 degrees: row 0 is superior, change flip_rows and flip_columns" in capsys.readouterr().err
    main(sirt("predict", tmp_path / "out", f"--data.xrays={measured / 'anna'}", "--dry_run"))
    assert "upside down" not in capsys.readouterr().err


@pytest.mark.filterwarnings("default")
def test_a_dry_run_warns_of_images_unlike_a_thorax_in_their_geometry(measured, tmp_path, capsys):
    case = load_xrays(measured / "anna")
    height, width = case["xrays"].shape[1:]
    middle = case["xrays"][:, height // 3:height - height // 3, width // 3:width - width // 3]
    large = torch.nn.functional.interpolate(middle[None], (height, width), mode="bilinear")[0]
    for name, xrays in (("right", case["xrays"]), ("magnified", large)):
        save_xrays(tmp_path / name, xrays, case["beam"])
        main(sirt("predict", tmp_path / "out", f"--data.xrays={tmp_path / name}", "--dry_run"))
        assert ("agrees little with a standard thorax" in capsys.readouterr().err) == (name == "magnified")


@pytest.mark.filterwarnings("default")
def test_a_dry_run_says_how_lying_images_are_turned_and_nothing_of_flips(measured, tmp_path, capsys):
    case = load_xrays(measured / "anna")
    save_xrays(tmp_path / "case", case["xrays"].mT, case["beam"])
    main(sirt("predict", tmp_path / "out", f"--data.xrays={tmp_path / 'case'}", "--dry_run"))
    out, err = capsys.readouterr()
    assert "`orientation: {rotate_degrees: 90, flip_columns: true}`" in err
    assert "agrees little" not in err and "better" not in out


@pytest.mark.filterwarnings("default")
def test_a_dry_run_warns_of_images_that_agree_less_than_nothing(measured, tmp_path, capsys):
    case = load_xrays(measured / "anna")
    height, width = case["xrays"].shape[1:]
    save_xrays(tmp_path / "case", case["xrays"].roll((height // 2, width // 2), (1, 2)), case["beam"])
    main(sirt("predict", tmp_path / "out", f"--data.xrays={tmp_path / 'case'}", "--dry_run"))
    out, err = capsys.readouterr()
    assert "agreement -" in out and "view 0, 1, 2 agrees little with a standard thorax" in err


@pytest.mark.filterwarnings("default")
def test_a_dry_run_names_a_wrong_shift_of_the_detector_and_no_flip(tmp_path, capsys):
    beam = ConeBeam.at_angles([0.0, 37.5, 75.0, 112.5, 150.0], 1500.0, 1100.0, (48, 60), 8.0)
    grid = Grid.cube(64)
    truth = HUWindow().to_mu(phantom_case(1, grid)["volume"])[None]
    xrays = Projector(grid, beam.shifted(10.0, 25.0), full_detector=True)(truth)[0]
    save_xrays(tmp_path / "case", xrays, beam.shifted(-10.0, -25.0))
    main(sirt("predict", tmp_path / "out", f"--data.xrays={tmp_path / 'case'}", "--dry_run"))
    out, err = capsys.readouterr()
    assert "check whether detector_shift is missing or has the wrong sign" in err and "flip" not in out + err


def test_a_dry_run_goes_on_after_a_bad_case_and_names_it_at_the_end(measured, tmp_path, capsys):
    shutil.copytree(measured, tmp_path / "cases")
    (tmp_path / "cases" / "anna" / "view_1.npy").unlink()
    capsys.readouterr()
    with pytest.raises(SystemExit) as stopped:
        main(sirt("predict", tmp_path / "out", f"--data.xrays={tmp_path / 'cases'}", "--dry_run"))
    out, err = capsys.readouterr()
    said = [line for line in err.splitlines() if line.startswith("error: ")]
    assert stopped.value.code == 2 and names(tmp_path / "out" / "dry_run") == ["bert.png"] and "bert view 0" in out
    assert said[0].startswith("error: anna: ") and "1 of 2 cases cannot be reconstructed (anna)" in said[1]


@pytest.mark.filterwarnings("default")
def test_a_dry_run_warns_of_a_left_lateral_view_told_to_stand_at_90_degrees(tmp_path, capsys):
    lateral, told = (ConeBeam.orbit(1, 1020.0, 740.0, (48, 48), 12.0, start_degrees=angle) for angle in (270, 90))
    truth = HUWindow().to_mu(phantom_case(1, Grid.cube(64))["volume"])
    for name, beam in (("right", lateral), ("wrong", told)):
        save_xrays(tmp_path / name, Projector(Grid.cube(64), lateral)(truth[None])[0], beam)
        main(sirt("predict", tmp_path / "out", f"--data.xrays={tmp_path / name}", "--dry_run"))
        said = [line for line in capsys.readouterr().err.splitlines() if "mirrored" in line]
        assert len(said) == (name == "wrong"), name
    assert "wrong: view 0 " in said[0] and "(LL)" in said[0] and "270" in said[0]


def test_a_dry_run_belongs_to_predict(tmp_path, capsys):
    assert "dry_run" in refusal(capsys, main, phantoms(tmp_path / "out", 1, "--dry_run"))


def test_a_dry_run_writes_no_page_among_the_xrays(measured, tmp_path, capsys):
    shutil.copytree(measured, tmp_path / "dry_run")
    before = contents(tmp_path)
    said = refusal(capsys, main, sirt("predict", tmp_path, f"--data.xrays={tmp_path / 'dry_run'}", "--dry_run"))
    assert "is the input" in said and contents(tmp_path) == before


def test_a_dry_run_refuses_lying_voxels_of_a_patient_who_goes_on_as_a_reconstruction_does(measured, tmp_path):
    case, upright = load_xrays(measured / "anna") | {"id": "anna"}, Grid.cube(16)
    lying = Grid(upright.shape, affine=upright.affine[:, [0, 2, 1, 3]])
    beam = replace(case["beam"], continued=True)
    with pytest.raises(ValueError) as refused:
        reconstruct(case["xrays"], beam, method="sirt", grid=lying)
    with pytest.raises(ValueError, match=f"^{re.escape(str(refused.value))}$"):
        dry_run(tmp_path / "anna.png", case | {"beam": beam}, lying)
    assert names(tmp_path) == []


def test_a_dry_run_refuses_a_box_that_no_ray_meets_as_a_reconstruction_does(measured, tmp_path, capsys):
    args = sirt("predict", tmp_path, f"--data.xrays={measured / 'anna'}", "--model.grid.voxels=8",
                "--model.grid.side=96", "--model.grid.centre=[0,0,900]")
    assert "no ray of any view meets" in refusal(capsys, main, args) == refusal(capsys, main, [*args, "--dry_run"])
