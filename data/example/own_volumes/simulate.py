"""Writes the X-rays that `infer.py test` and `ablate` make of CTs, a folder of each case for another program to read.

    python data/example/own_volumes/simulate.py <folder of CTs, or phantom> <out> [--views 8] [--voxels 64] [--seed 0]
"""

import argparse
from pathlib import Path

from phydict import Grid, HUWindow, case_seed  # before torch, whose threads then wait less beside others

# isort: split
import torch

from phydict.datasets import save_xrays
from phydict.inference.data import ReconstructionData
from phydict.inference.settings import Orbit
from phydict.runtime.console import cli_errors

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cts")
    parser.add_argument("out", type=Path)
    for name, number in (("views", 8), ("voxels", 64), ("seed", 0), ("phantoms", 4)):
        parser.add_argument(f"--{name}", type=int, default=number)
    given = parser.parse_args()
    with cli_errors():
        grid, window = Grid.cube(given.voxels), HUWindow()
        data = ReconstructionData(cts=given.cts, orbit=Orbit(views=given.views), phantoms=given.phantoms)
        for case, _, made in data.test_cases(grid, window):
            xrays = data.simulate(made(), case_seed(given.seed, case), grid, window, torch.device("cpu"))
            save_xrays(given.out / case, xrays, data.beam)
            print(given.out / case)
