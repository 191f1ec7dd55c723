"""Compiled loops run wherever they are installed, and are compiled once."""

import os
import shutil
import subprocess
import sys
from multiprocessing import get_context
from pathlib import Path

import pytest
import torch
from torch.utils.data import DataLoader, Dataset

import phydict
from phydict.grid import Grid
from phydict.xray import ConeBeam, Projector
from phydict.xray.projectors.separable_cpu import backproject as backproject_loop
from phydict.xray.projectors.separable_cpu import project as project_loop

CODE = """if True:
    import numpy as np
    from phydict.xray.projectors import tracer
    print(tracer.__file__, tracer.nearest(np.array([3.0, 1.0, 2.0])))"""


@pytest.mark.parametrize("home", ["a folder", "nowhere"])
def test_an_installation_that_cannot_be_written_caches_elsewhere_or_runs_without(tmp_path, home):
    site, cache = tmp_path / "site", tmp_path / "home" / ".cache"
    shutil.copytree(Path(phydict.__file__).parent, site / "phydict", ignore=shutil.ignore_patterns("__pycache__"))
    (site / "phydict" / "xray" / "projectors" / "__pycache__").touch()  # a file: not even root writes into it
    (tmp_path / "home").mkdir() if home == "a folder" else (tmp_path / "home").touch()
    clean = {name: value for name, value in os.environ.items() if not name.startswith(("NUMBA_CACHE", "XDG_"))}
    done = subprocess.run([sys.executable, "-c", CODE], capture_output=True, text=True, cwd=site, timeout=300,
                          env=clean | {"HOME": str(tmp_path / "home"), "PYTHONDONTWRITEBYTECODE": "1"})
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == [str(site / "phydict" / "xray" / "projectors" / "tracer.py"), "1"]
    assert bool(list(cache.rglob("tracer.nearest*.nbc"))) == (home == "a folder")


def test_loops_are_compiled_once_for_each_precision():
    for views in (1, 3):
        project = Projector(Grid.cube(8), ConeBeam.orbit(views, 1020, 740, (1, 4), 100.0), "separable",
                            full_detector=True)
        for x in (torch.rand(2, 1, 8, 8, 8), torch.rand(1, 1, 8, 8, 8).transpose(2, 3), torch.zeros(1, 1, 8, 8, 8)):
            for kind in (torch.float32, torch.float64):
                project.T(project(x.to(kind)))
    for loop in (project_loop, backproject_loop):
        assert len(loop.signatures) == 2


class Residuals(Dataset):
    """What a projector and its adjoint give of a few volumes."""

    def __init__(self):
        self.project = Projector(Grid.cube(16), ConeBeam.orbit(3, 1020, 740, (20, 40), 20.0), "separable",
                                 full_detector=True)

    def __len__(self):
        return 2

    def __getitem__(self, n: int) -> tuple[torch.Tensor, torch.Tensor]:
        xrays = self.project(torch.rand(1, 1, 16, 16, 16, generator=torch.Generator().manual_seed(n)))
        return xrays, self.project.T(xrays)


def test_a_loader_forked_from_a_process_that_has_projected_projects_alike():
    items = Residuals()
    here = [items[n] for n in range(2)]
    for found, expected in zip(DataLoader(items, None, num_workers=1), here):
        assert all(torch.equal(*pair) for pair in zip(found, expected))


def test_a_process_forked_from_one_that_has_projected_projects_alike():
    items = Residuals()
    here = items[0]
    forked = get_context("fork").Process(target=lambda: torch.testing.assert_close(items[0], here, rtol=0, atol=0))
    forked.start()
    forked.join(60)
    assert forked.exitcode == 0
