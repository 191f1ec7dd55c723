"""Finished cases made up on disk, as predict and test leave them."""

from pathlib import Path

import numpy as np
import torch

from phydict.grid import Grid
from phydict.inference.results import RECORD
from phydict.page import write_case_files
from phydict.reconstruction import save_nifti
from phydict.runtime.strict_json import strict_json

TURNED = Grid((6, 9, 7), affine=np.array([[0, -4.0, 0, 11], [-3.0, 0, 0, 7], [0, 0, 5.0, -20], [0, 0, 0, 1]]))
"""Voxels whose first axis runs to the back and whose second runs to the patient's left."""


def random_hu(seed: int, grid: Grid = TURNED) -> torch.Tensor:
    return torch.from_numpy(np.random.default_rng(seed).uniform(-1000, 1500, grid.shape).astype(np.float32))


def record(case: str, method: str, **changes) -> dict:
    """What a run keeps of a case."""
    return {"case": case, "method": method, "scores": {"psnr": 20.0, "ssim": 0.5, "mae_hu": 90.0, "misfit": 0.1},
            "misfit": 0.1, "misfit_per_view": [0.1, 0.2, 0.05], "seconds": {"sample": 1.5}, "network_calls": 0,
            "projector_calls": 3, "views": 3, "grid": TURNED.to_dict(), "seed": 0, "warnings": [], "report": "",
            "source": "crc32 1", "settings": {"seed": 0}, "versions": {"python": "3"}} | changes


def finish(out: Path, case: str, method: str, with_page: bool = True, grid: Grid = TURNED, seed: int = 0,
           **changes) -> Path:
    """A finished case with volume, truth, deviation and X-rays, of random values."""
    folder = out / method / case
    folder.mkdir(parents=True)
    volume, truth = random_hu(seed, grid), random_hu(seed + 100, grid)
    xrays = torch.from_numpy(np.random.default_rng(seed).uniform(0, 5, (3, 8, 10)))
    save_nifti(folder / "volume.nii.gz", volume.numpy(), grid)
    if with_page:
        volumes = {"reconstruction": volume, "truth": truth, "standard deviation": volume.abs() / 4}
        write_case_files(folder, grid, volumes, xrays, xrays + torch.linspace(-1, 1, 10))
    made = record(case, method, **{"grid": grid.to_dict()} | changes)
    (folder / RECORD).write_text(strict_json(made | {"files": [file.name for file in folder.iterdir()]}))
    return folder
