"""A box inside the chest beside the same box of the whole: what is outside of it is accounted for by coarse voxels.

    python tests/benchmark/region.py <folder of CTs> [--views 8] [--methods <name> ...]

Voxels of 3 mm in a cube of 192 mm about a point 60 mm to the right, which cuts body and lungs, by phydict_learned and
total variation, and of the volume that each gives of the whole chest; scored inside the cube. X-rays of 256^3 voxels.
Writes region.csv beside this file, where other rows stay, and prints means.
"""

from pathlib import Path
from statistics import mean

import torch
from finest import WINDOW, main, scene, timed
from torch.nn.functional import avg_pool3d

from phydict.evaluation import body_weights, volume_metrics
from phydict.grid import Grid
from phydict.methods import onto_grid, reconstructor
from phydict.runtime.precision import instruction_set
from phydict.units import AIR
from phydict.xray.boxes import interpolated

FILE = Path(__file__).with_suffix(".csv")
WHOLE, BOX = Grid.cube(128), Grid.box(64, 192.0, (60.0, 0.0, 0.0))


def rows_of(ct, views: int, methods: list[str]) -> list[dict]:
    volume, xrays, beam = scene(ct, views)
    whole, rows = WINDOW.to_hu(avg_pool3d(volume, 2)), []
    truth, body = (interpolated(values[0, 0], WHOLE, BOX, outside)[None, None]
                   for values, outside in ((whole, AIR), (body_weights(whole, WHOLE.spacing), 0.0)))
    for name in methods:
        for where, grid in (("box", BOX), ("whole", WHOLE)):
            shown, seconds = timed(onto_grid(reconstructor(name), grid), grid, BOX, xrays, beam)
            rows.append({"case": ct.id, "views": views, "method": name, "reconstructed": where, "cpu_seconds": seconds,
                         "instruction_set": instruction_set(torch.device("cpu"))}
                        | volume_metrics(shown, truth, body=body))
            print(*rows[-1].values(), flush=True)
    return rows


if __name__ == "__main__":
    rows = main(__doc__, FILE, rows_of, "method", ["phydict_learned", "tv"])
    for name, where in dict.fromkeys((row["method"], row["reconstructed"]) for row in rows):
        own = [row for row in rows if (row["method"], row["reconstructed"]) == (name, where)]
        print(name, where, *(f"{mean(row[key] for row in own):.3f}" for key in ("psnr", "ssim", "cpu_seconds")))
