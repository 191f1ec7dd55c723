"""A box inside the chest beside the same box of the whole: what is outside of it is accounted for by coarse voxels.

    python tests/benchmark/region.py <folder of CTs> [--views 8]

Voxels of 3 mm in a cube of 192 mm about a point 60 mm to the right, which cuts body and lungs, by phydict_learned and
total variation, and of the volume that each gives of the whole chest; scored inside the cube. X-rays of 256^3 voxels.
Writes region.csv beside this file, where rows of other numbers of views stay, and prints means.
"""

import argparse
import time
from pathlib import Path
from statistics import mean

from torch.nn.functional import avg_pool3d

from phydict import Projector, load_prior
from phydict.datasets import find_cts, prepare_ct
from phydict.evaluation import body_weights, read_csv, volume_metrics, write_csv
from phydict.grid import Grid
from phydict.methods import fit_to_grid, onto_grid, reconstructor
from phydict.prior import DEFAULT_REFINER
from phydict.runtime.seeds import case_seed
from phydict.units import AIR
from phydict.xray import Ideal
from phydict.xray.binning import benchmark_orbit
from phydict.xray.boxes import interpolated

FILE = Path(__file__).with_suffix(".csv")
SCENE, WHOLE, BOX = Grid.cube(256), Grid.cube(128), Grid.box(64, 192.0, (60.0, 0.0, 0.0))


def rows_of(ct, views: int) -> list[dict]:
    refiner = load_prior(DEFAULT_REFINER)
    window, beam = refiner.window, benchmark_orbit(SCENE, views)
    volume, rows = prepare_ct(ct.path, SCENE, window, id=ct.id)["volume"][None], []
    truth = interpolated(window.to_hu(avg_pool3d(volume, 2))[0, 0], WHOLE, BOX, AIR)[None, None]
    body = body_weights(window.to_hu(avg_pool3d(volume, 2)), WHOLE.spacing)[0, 0]
    body = interpolated(body, WHOLE, BOX, 0.0)[None, None]
    xrays = Ideal()(Projector(SCENE, beam, full_detector=True), window.to_mu(volume), case_seed(0, ct.id))[0]
    for name in ("phydict_learned", "tv"):
        for where, grid in (("box", BOX), ("whole", WHOLE)):
            ready = onto_grid(reconstructor(name, refiner), grid)
            began = time.process_time()
            found = ready.reconstruct(*fit_to_grid(ready, grid, xrays, beam))
            spent = time.process_time() - began
            shown = interpolated(found.volume, grid, BOX, AIR)[None, None]
            rows.append({"case": ct.id, "views": views, "method": name, "reconstructed": where, "cpu_seconds": spent}
                        | volume_metrics(shown, truth, body=body))
            print(*rows[-1].values(), flush=True)
    return rows


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cts", type=Path)
    parser.add_argument("--views", type=int, default=8)
    given = parser.parse_args()
    kept = [row for row in read_csv(FILE) if row["views"] != given.views]
    rows = [row for ct in find_cts(given.cts) for row in rows_of(ct, given.views)]
    write_csv(FILE, kept + rows)
    for name, where in dict.fromkeys((row["method"], row["reconstructed"]) for row in rows):
        own = [row for row in rows if (row["method"], row["reconstructed"]) == (name, where)]
        print(name, where, *(f"{mean(row[key] for row in own):.3f}" for key in ("psnr", "ssim", "cpu_seconds")))
