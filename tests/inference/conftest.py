"""X-rays, CTs, a prior and a finished test for the tests of infer.py's commands."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from inference.runs import BEAM, phantoms, write_ct
from phydict.cli.infer import main
from phydict.datasets import phantom_case, save_xrays
from phydict.grid import Grid
from phydict.prior import LocalUNet, Prior, SuperResolution, VolumeUNet, save_prior, save_stage
from phydict.units import HUWindow
from phydict.xray import Projector


@pytest.fixture(scope="session", autouse=True)
def known_phantoms(phantoms_made_once) -> None:
    """Tests here reconstruct the same few phantoms."""


@pytest.fixture(scope="session")
def measured(tmp_path_factory) -> Path:
    """Two folders of X-rays."""
    root = tmp_path_factory.mktemp("measured")
    for name, seed in (("anna", 1), ("bert", 2)):
        truth = HUWindow().to_mu(phantom_case(seed, Grid.cube(64))["volume"])
        save_xrays(root / name, Projector(Grid.cube(64), BEAM)(truth[None])[0], BEAM, report="No effusion.")
    return root


@pytest.fixture(scope="session")
def prior(tmp_path_factory) -> Path:
    """An untrained prior on 16^3 voxels."""
    torch.manual_seed(0)
    file = tmp_path_factory.mktemp("prior") / "tiny.safetensors"
    save_prior(Prior(VolumeUNet(channels=(8, 8), attention=(False, True), head_channels=8), Grid.cube(16),
                     HUWindow()), file)
    return file


@pytest.fixture(scope="session")
def fine(tmp_path_factory) -> Path:
    """An untrained super-resolution stage from 16^3 to 32^3 voxels."""
    torch.manual_seed(0)
    file = tmp_path_factory.mktemp("fine") / "fine.safetensors"
    save_stage(SuperResolution(LocalUNet(2, 1, 2, (8, 8)), Grid.cube(32), HUWindow(), 2), file)
    return file


@pytest.fixture(scope="session")
def cts(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("cts")
    for n, name in enumerate("ab"):
        write_ct(folder / f"{name}.nii.gz", n)
    return folder


@pytest.fixture(scope="session")
def scored(tmp_path_factory) -> Path:
    """The finished test of SIRT on two phantoms."""
    out = tmp_path_factory.mktemp("scored")
    main(phantoms(out, 2))
    return out / "sirt"
