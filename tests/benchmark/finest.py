"""Whether 256^3 voxels show more than 128^3 ones, and by what: phydict_learned from X-rays of 256^3 voxels, scored on
these.

    python tests/benchmark/finest.py <folder of CTs> [--views 8]

Beside the volume on 256^3 voxels that of 128^3, interpolated, and what the X-rays and total variation alone make of its
64^3 on 256^3 voxels, without the networks on finer voxels. Writes finest.csv beside this file, where rows of other
numbers of views stay, and prints means and the least lead of the last over the first.
"""

import argparse
import time
from dataclasses import replace
from pathlib import Path
from statistics import mean

from phydict import Projector, load_prior
from phydict.datasets import find_cts, prepare_ct
from phydict.evaluation import body_weights, read_csv, volume_metrics, write_csv
from phydict.grid import Grid
from phydict.methods import fit_to_grid, onto_grid, reconstructor
from phydict.posterior import Refinement
from phydict.prior import DEFAULT_REFINER
from phydict.runtime.seeds import case_seed
from phydict.units import AIR
from phydict.xray import Ideal
from phydict.xray.binning import benchmark_orbit
from phydict.xray.boxes import interpolated

FILE = Path(__file__).with_suffix(".csv")
FINEST = Grid.cube(256)
WAYS = ("128^3, interpolated", "64^3, X-rays and total variation", "256^3")


def rows_of(ct, views: int) -> list[dict]:
    refiner = load_prior(DEFAULT_REFINER)
    coarse, window = reconstructor("phydict_learned", refiner), refiner.window
    finest = onto_grid(coarse, FINEST)
    methods = onto_grid(coarse, Grid.cube(128)), replace(finest, network=None, refinement=Refinement(calls=0)), finest
    volume, beam = prepare_ct(ct.path, FINEST, window, id=ct.id)["volume"][None], benchmark_orbit(FINEST, views)
    truth, rows = window.to_hu(volume), []
    body = body_weights(truth, FINEST.spacing)
    xrays = Ideal()(Projector(FINEST, beam, full_detector=True), window.to_mu(volume), case_seed(0, ct.id))[0]
    for way, method in zip(WAYS, methods):
        began = time.process_time()
        found = method.reconstruct(*fit_to_grid(method, method.grid, xrays, beam))
        spent = time.process_time() - began
        shown = interpolated(found.volume, found.grid, FINEST, AIR)[None, None]
        rows.append({"case": ct.id, "views": views, "way": way, "cpu_seconds": spent}
                    | volume_metrics(shown, truth, body=body))
        print(*rows[-1].values(), flush=True)
    return rows


def table(rows: list[dict]) -> str:
    lines = ["| way | PSNR (dB) | SSIM | body: PSNR | CPU seconds |", "|---|---:|---:|---:|---:|"]
    for way in WAYS:
        means = [mean(row[key] for row in rows if row["way"] == way)
                 for key in ("psnr", "ssim", "psnr_body", "cpu_seconds")]
        lines.append("| {} | {:.2f} | {:.3f} | {:.2f} | {:.0f} |".format(way, *means))
    first, _, last = ({row["case"]: row["psnr"] for row in rows if row["way"] == way} for way in WAYS)
    return "\n".join([*lines, "", f"least lead {min(last[case] - first[case] for case in first):+.2f} dB"])


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cts", type=Path)
    parser.add_argument("--views", type=int, default=8)
    given = parser.parse_args()
    kept = [row for row in read_csv(FILE) if row["views"] != given.views]
    rows = [row for ct in find_cts(given.cts) for row in rows_of(ct, given.views)]
    write_csv(FILE, kept + rows)
    print(table(rows))
