"""Volumes of another program: shown as they are, on other voxels as their averages; a changed one is seen."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from ablation.runs import ablate

from phydict.baselines import Stored
from phydict.baselines.extended import Extended
from phydict.datasets import phantom_case
from phydict.grid import Grid
from phydict.inference.data import ReconstructionData
from phydict.methods import onto_grid, reconstruct_by
from phydict.reconstruction import save_nifti
from phydict.units import HUWindow
from phydict.xray import ConeBeam, Projector

GRID, WINDOW, BEAM = Grid.cube(16), HUWindow(), ConeBeam.orbit(3, 1020, 740, (24, 24), 24.0)


@pytest.fixture(scope="module")
def truth() -> torch.Tensor:
    return WINDOW.to_hu(phantom_case(1_000_000, GRID, WINDOW)["volume"])[0].round()


@pytest.mark.parametrize("name", ["a.nii.gz", "a.nii", "a/volume.nii.gz"])
def test_a_volume_is_the_files_and_its_misfit_that_of_the_x_rays(truth, tmp_path, name):
    (tmp_path / "a").mkdir()
    save_nifti(tmp_path / name, truth.numpy(), GRID)
    A = Projector(GRID, BEAM)
    y = A(0.02 * (1 + truth / 1000)[None, None])[0]
    found = Stored(str(tmp_path)).of_case("a").reconstruct(y, A)
    torch.testing.assert_close(found.volume, truth, atol=1e-3, rtol=0)
    assert found.misfit < 1e-5
    coarse = Stored(str(tmp_path)).of_case("a").reconstruct(y, Projector(Grid.cube(8), BEAM, full_detector=True))
    torch.testing.assert_close(coarse.volume, torch.nn.functional.avg_pool3d(truth[None], 2)[0], atol=1e-2, rtol=0)
    fine = Stored(str(tmp_path)).of_case("a").reconstruct(y, Projector(GRID.grown(0, 0, 2), BEAM, full_detector=True))
    torch.testing.assert_close(fine.volume[..., 2:-2], truth, atol=1e-3, rtol=0)
    assert (fine.volume[..., :2] == -1000).all()


def test_display_values_take_their_scale_from_the_volume_itself(truth, tmp_path):
    save_nifti(tmp_path / "a.nii.gz", truth.numpy(), GRID)
    A = Projector(GRID, BEAM)
    shown = 3 + A(0.02 * (1 + truth / 1000)[None, None])[0] * torch.tensor([2.0, 5.0, 1.0])[:, None, None]
    assert Stored(str(tmp_path), case="a").reconstruct(shown, A, display=True).misfit < 1e-4


@pytest.mark.parametrize("box", [GRID, Grid.box(16, 192.0)])
def test_a_patient_who_continues_beyond_the_volume_does_so_as_it_ends(truth, tmp_path, box):
    endless = truth[..., 8:9].expand(truth.shape).clone()
    save_nifti(tmp_path / "a.nii.gz", endless.numpy(), GRID)
    beam = replace(BEAM, continued=True)
    y = Projector(GRID, beam, full_detector=True)(0.02 * (1 + endless / 1000)[None, None])[0]
    found = reconstruct_by(onto_grid(Stored(str(tmp_path), case="a"), box), box, y, beam)
    assert found.misfit < (1e-5 if box is GRID else 0.05)


def test_a_volume_that_is_turned_lies_where_its_affine_says(truth, tmp_path):
    turned = replace(GRID, affine=GRID.affine @ np.diag([-1, 1, 1, 1]) @ np.array(
        [[1, 0, 0, -15], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]]))
    save_nifti(tmp_path / "a.nii.gz", truth.flip(0).numpy(), turned)
    A = Projector(GRID, BEAM)
    found = Stored(str(tmp_path), case="a").reconstruct(torch.rand(A.beam.views, *A.beam.shape), A)
    torch.testing.assert_close(found.volume, truth, atol=1e-3, rtol=0)


@pytest.mark.parametrize("own", [Grid.box((64, 64, 40), (384, 384, 240)), Grid.box((64, 64, 12), 384.0)])
def test_finer_voxels_are_averaged_also_where_they_end_before_the_others_do_or_are_longer_along_one_axis(tmp_path, own):
    save_nifti(tmp_path / "a.nii.gz", np.random.default_rng(0).normal(0, 200, own.shape), own)
    found = Stored(str(tmp_path), case="a").reconstruct(torch.rand(3, 24, 24), Projector(GRID, BEAM))
    assert found.volume[2:-2, 2:-2, 5:-5].std() < 200 / 16**0.5 + 5  # the mean of 16 voxels or more
    assert own.extent[2] == 384 or (found.volume[..., :2] == -1000).all()


def test_methods_that_use_another_pass_the_case_on(tmp_path):
    assert Extended(Stored(str(tmp_path)), GRID, GRID, (0, 0, 0)).of_case("a").base.case == "a"


@pytest.mark.parametrize("method, words", [
    (Stored(), "folder '' and case '' were given: give the folder, and in Python the case"),
    (Stored(case="a"), "folder '' and case 'a' were given: give the folder$"),
    (Stored(".", case="a"), "no volume of a in .: name it a.nii.gz, or a/volume.nii.gz")])
def test_a_volume_that_is_not_there_is_asked_for(method, words):
    with pytest.raises((ValueError, FileNotFoundError), match=words):
        method.reconstruct(torch.rand(3, 24, 24), Projector(GRID, BEAM))


def test_a_folder_that_is_not_there_is_refused_before_anything_is_run():
    with pytest.raises(ValueError, match="no folder nowhere of volumes"):
        Stored("nowhere")


def test_in_a_comparison_each_case_has_its_own_and_a_changed_one_is_scored_again(tmp_path):
    cases = ReconstructionData(cts="phantom", phantoms=2).test_cases(GRID, WINDOW)
    for case, _, made in cases:
        save_nifti(tmp_path / f"{case}.nii.gz", WINDOW.to_hu(made()["volume"][0]).numpy(), GRID)
    content = {"methods": {"mine": {"of": "phydict.baselines.Stored", "method.folder": str(tmp_path)}},
               "axes": {"method": ["mine", "sirt"], "method.iterations": [2]}}
    rows = ablate(tmp_path, **content)
    exact, other = ([row["psnr"] for row in rows if row["method"] == name] for name in ("mine", "sirt"))
    assert len(exact) == 2 and min(exact) > 60 > max(other)
    save_nifti(tmp_path / f"{cases[0][0]}.nii.gz", np.full(GRID.shape, -1000.0), GRID)
    worse = [row["psnr"] for row in ablate(tmp_path, **content) if row["method"] == "mine"]
    assert worse[0] < 40 < worse[1]
