"""Writes this folder's example: a held-out phantom, its report, and eight X-rays simulated from it at 3 mm.

    python data/example/make.py
"""

from pathlib import Path

from phydict import ConeBeam, Grid, HUWindow, Projector  # before torch, whose threads then wait less beside others

# isort: split
import torch

from phydict.datasets import phantom_case, save_xrays
from phydict.reconstruction import save_nifti
from phydict.xray import Ideal

SEED = 1_000_117

if __name__ == "__main__":
    here, window = Path(__file__).parent, HUWindow()
    case = phantom_case(SEED, Grid.cube(128), window)
    beam = ConeBeam.orbit(8, 1020.0, 740.0, shape=(224, 224), pixel=(2.5, 2.5))
    projector = Projector(Grid.cube(128), beam, full_detector=True)
    xrays = Ideal(noise=0.005)(projector, window.to_mu(case["volume"])[None], SEED)[0]
    save_xrays(here / "xrays", xrays, beam, case["report"], png=True, overwrite=True)
    coarse = torch.nn.functional.avg_pool3d(case["volume"][None], 2)[0, 0]
    save_nifti(here / "truth.nii.gz", window.to_hu(coarse).round(), Grid.cube(64))
