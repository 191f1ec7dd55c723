"""Seconds and peak memory of a reconstruction against voxels and views, with the exponents of their growth.

    python tests/benchmark/grid_cost.py [<method>=<voxels>x<views>,<voxels>x<views>...] ...

X-rays of the standard thorax, on the paper's orbit, each size once after a small one that loads and compiles. Without
arguments the sizes of DEFAULT. own_mib is the peak of the process less what it held before. Writes grid_cost.csv beside
this file and leaves the rows of other methods and of machines with other instructions.
"""

import sys
from pathlib import Path

import numpy as np
import torch

from phydict.datasets import Thorax, build
from phydict.evaluation import read_csv, write_csv
from phydict.grid import Grid
from phydict.methods import METHODS, reconstruct
from phydict.posterior import Sampler
from phydict.runtime.precision import instruction_set
from phydict.runtime.profiling import CPU, peak_memory, reset_peak_memory
from phydict.units import hu_to_mu
from phydict.xray import ConeBeam, Projector

FILE = Path(__file__).with_suffix(".csv")
DEFAULT = "phydict_learned=64x2,64x8,64x16,64x32,128x2,128x8,128x16,128x32,256x8"
SCENE = Grid.cube(96)
SAME = ("method", "voxels", "views", "instruction_set")
"""What a row is made anew of."""


def measured(method: str, voxels: int, views: int) -> dict:
    """The figures of one reconstruction."""
    beam = ConeBeam.orbit(views, 1020, 740, (448, 448), 1.25)
    chest = hu_to_mu(torch.from_numpy(build(Thorax.standard(), SCENE)[0]).float())
    xrays = Projector(SCENE, beam, full_detector=True)(chest[None, None])[0]
    before = peak_memory(CPU) if reset_peak_memory(CPU) else 0.0
    found = reconstruct(xrays, beam, method=method, grid=Grid.cube(voxels))
    peak = peak_memory(CPU)
    return {"method": method, "voxels": voxels, "views": views, "seconds": round(sum(found.seconds.values()), 2),
            "seconds_refine": round(found.seconds.get("refine", 0.0), 2), "peak_mib": round(peak),
            "own_mib": round(peak - before), "threads": torch.get_num_threads(), "precision": found.precision,
            "instruction_set": instruction_set(CPU)}


def exponents(rows: list[dict], name: str) -> list[float]:
    """Of a quantity, the exponents in the number of voxels and in that of views, fitted in logarithms."""
    used = [row for row in rows if row[name]]
    design = [[1, 3 * np.log(row["voxels"]), np.log(row["views"])] for row in used]
    fitted = np.linalg.lstsq(np.array(design), np.log([row[name] for row in used]))[0]
    return [round(float(e), 2) for e in fitted[1:]]


if __name__ == "__main__":
    rows = read_csv(FILE)
    for text in sys.argv[1:] or [DEFAULT]:
        method, _, sizes = text.partition("=")
        small = Grid.cube(80 if isinstance(METHODS[method], Sampler) else 16)
        beam = ConeBeam.orbit(2, 1020, 740, (448, 448), 1.25)
        reconstruct(torch.rand(2, 448, 448) + 1, beam, method=method, grid=small)
        for voxels, views in (map(int, size.split("x")) for size in sizes.split(",")):
            row = measured(method, voxels, views)
            rows = [old for old in rows if any(old[k] != row[k] for k in SAME)]
            write_csv(FILE, rows := [*rows, row])
            print(row, flush=True)
    for method, instructions in dict.fromkeys((row["method"], row["instruction_set"]) for row in rows):
        own = [row for row in rows if (row["method"], row["instruction_set"]) == (method, instructions)]
        print(method, instructions, {name: exponents(own, name) for name in ("seconds", "seconds_refine", "own_mib")
                       if sum(bool(row[name]) for row in own) > 2})
