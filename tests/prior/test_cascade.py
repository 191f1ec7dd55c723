"""A cascade: its stages must fit, and each has a file that is not taken for the other's."""

import json

import numpy as np
import pytest
import torch
from laws import random_like
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from phydict.grid import Grid, centred
from phydict.prior import (
    Cascade,
    LocalUNet,
    SuperResolution,
    load_prior,
    load_super_resolution,
    save_prior,
    save_stage,
)
from phydict.units import HUWindow
from prior.tiny import tiny_prior, tiny_super_resolution

COARSE = 0.3 * random_like((1, 1, 16, 16, 16), torch.float32, seed=1)
X = random_like((1, 1, 32, 32, 32), torch.float32, seed=2)


def stage(voxels=32, side=384.0, window=HUWindow(-1000, 600), factor=2, channels=1):
    return SuperResolution(LocalUNet(1 + channels, 1, 2, (8, 8)), Grid.cube(voxels, side), window, factor, channels)


def test_stages_of_one_cube_and_window_make_a_cascade():
    base = tiny_prior(False)
    for fine in (stage(), stage(64, factor=4), stage(channels=4)):
        assert Cascade(base, fine).super_resolution is fine


@pytest.mark.parametrize("change, words", [
    ({"side": 360.0}, "384 x 384 x 384.*360 x 360 x 360"), ({"window": HUWindow()}, r"\[-1000, 600\].*\[-1000, 1000\]"),
    ({"voxels": 64}, "factor 2"), ({"factor": 4}, "factor 4"), ({"channels": 5}, "5 channels.*has 4")])
def test_stages_that_do_not_fit_are_refused(change, words):
    with pytest.raises(ValueError, match=words):
        Cascade(tiny_prior(False), stage(**change))


def test_stages_stacked_in_other_directions_are_refused():
    fine = stage()
    mirrored = Grid((32, 32, 32), affine=fine.grid.affine @ np.diag([-1.0, 1.0, 1.0, 1.0]))
    fine.grid = Grid((32, 32, 32), affine=centred(mirrored.affine[:3, :3], (32, 32, 32), fine.grid.centre))
    with pytest.raises(ValueError, match="other directions"):
        Cascade(tiny_prior(False), fine)


@pytest.fixture
def files(tmp_path):
    save_prior(tiny_prior(False), tmp_path / "base.safetensors")
    save_stage(tiny_super_resolution(), tmp_path / "fine.safetensors", {"steps": 3})
    return tmp_path / "base.safetensors", tmp_path / "fine.safetensors"


def test_a_loaded_stage_denoises_like_the_saved_one(files, tmp_path):
    saved, loaded = tiny_super_resolution(), load_super_resolution(files[1])
    expected = saved.bind(COARSE, 0.1, "float32").denoise(X, 0.5)
    found = loaded.bind(COARSE, 0.1, "float32").denoise(X, 0.5)
    assert (found - expected).square().mean().sqrt() < 3e-3 * expected.std()
    save_stage(saved, tmp_path / "full.safetensors", dtype=torch.float32)
    full = load_super_resolution(tmp_path / "full.safetensors")
    assert torch.equal(full.bind(COARSE, 0.1, "float32").denoise(X, 0.5), expected)
    assert full.grid.same_as(saved.grid) and full.window == saved.window and full.factor == saved.factor
    assert not full.training and not any(weight.requires_grad for weight in full.parameters())
    with safe_open(files[1], "pt") as opened:
        assert json.loads(opened.metadata()["phydict"])["training"] == {"steps": 3}


def test_a_file_of_the_other_stage_is_one_sentence(files):
    base, fine = files
    with pytest.raises(ValueError, match="fine.safetensors' is a super-resolution stage, but a base prior is needed"):
        load_prior(fine)
    with pytest.raises(ValueError, match="base.safetensors' is a base prior, but a super-resolution stage is needed"):
        load_super_resolution(base)


def test_a_prior_written_before_there_were_stages_is_a_base_prior(files, tmp_path):
    with safe_open(files[0], "pt") as opened:
        header = json.loads(opened.metadata()["phydict"])
    del header["stage"]
    save_file(load_file(files[0]), tmp_path / "old.safetensors", {"phydict": json.dumps(header)})
    assert load_prior(tmp_path / "old.safetensors").grid.shape == (16, 16, 16)


def test_a_truncated_stage_is_one_sentence(files):
    files[1].write_bytes(files[1].read_bytes()[:2000])
    with pytest.raises(ValueError, match="fine.safetensors' is truncated"):
        load_super_resolution(files[1])


def test_a_header_of_another_network_is_one_sentence(files, tmp_path):
    with safe_open(files[1], "pt") as opened:
        header = json.loads(opened.metadata()["phydict"])
    header["network"]["channels"] = [8, 16]
    save_file(load_file(files[1]), tmp_path / "other.safetensors", {"phydict": json.dumps(header)})
    with pytest.raises(ValueError, match="contradicts itself"):
        load_super_resolution(tmp_path / "other.safetensors")
