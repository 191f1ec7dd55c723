"""Whether 256^3 voxels show more than 128^3 ones, and by what: phydict_learned from X-rays of 512^3 voxels, scored on
256^3.

    python tests/benchmark/finest.py <folder of CTs> [--views 8]

Beside the volume on 256^3 voxels that of 128^3, interpolated; what the X-rays and total variation alone make of its
64^3 on 256^3, without the networks on finer voxels; and what the network of 3 mm makes of them alone. Writes
finest.csv beside this file, where rows of other numbers of views stay, and prints means and the least lead of the last
over the first.
"""

import argparse
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from statistics import mean

import torch
from torch import Tensor
from torch.nn.functional import avg_pool3d

from phydict import ConeBeam, HUWindow, Projector
from phydict.datasets import CTFile, find_cts, prepare_ct
from phydict.evaluation import body_weights, read_csv, volume_metrics, write_csv
from phydict.grid import Grid
from phydict.methods import fit_to_grid, onto_grid, reconstructor
from phydict.posterior import Refinement
from phydict.prior import DEFAULT_CORRECTION, load_correction
from phydict.runtime.precision import instruction_set
from phydict.runtime.seeds import case_seed
from phydict.units import AIR
from phydict.xray import Ideal
from phydict.xray.binning import benchmark_orbit
from phydict.xray.boxes import interpolated

FILE = Path(__file__).with_suffix(".csv")
FINEST, WINDOW = Grid.cube(256), HUWindow()
SIMULATED = Grid.cube(512)
WAYS = ("128^3, interpolated", "64^3, X-rays and total variation", "256^3, network of 3 mm", "256^3")


def rows_of(ct, views: int) -> list[dict]:
    coarse = reconstructor("phydict_learned")
    finest = onto_grid(coarse, FINEST)
    methods = (onto_grid(coarse, Grid.cube(128)),
               replace(finest, networks=(), refinement=Refinement(calls=0)),
               replace(finest, networks=(load_correction(DEFAULT_CORRECTION),)), finest)
    volume, xrays, beam = scene(ct, views, SIMULATED)
    truth, rows = WINDOW.to_hu(avg_pool3d(volume, SIMULATED.shape[0] // FINEST.shape[0])), []
    body = body_weights(truth, FINEST.spacing)
    for way, method in zip(WAYS, methods):
        shown, seconds = timed(method, method.grid, FINEST, xrays, beam)
        rows.append({"case": ct.id, "views": views, "way": way, "cpu_seconds": seconds,
                     "instruction_set": instruction_set(torch.device("cpu"))} | volume_metrics(shown, truth, body=body))
        print(*rows[-1].values(), flush=True)
    return rows


def scene(ct, views: int, grid: Grid = FINEST) -> tuple[Tensor, Tensor, ConeBeam]:
    """A CT (1, 1, X, Y, Z) in [-1, 1] on a grid, its X-rays, and their beam."""
    volume, beam = prepare_ct(ct.path, grid, WINDOW, id=ct.id)["volume"][None], benchmark_orbit(grid, views)
    projector = Projector(grid, beam, full_detector=True)
    return volume, Ideal()(projector, WINDOW.to_mu(volume), case_seed(0, ct.id))[0], beam


def timed(method, grid: Grid, onto: Grid, xrays: Tensor, beam: ConeBeam) -> tuple[Tensor, float]:
    """What a method reconstructs on `grid`, shown on the voxels of `onto` (1, 1, X, Y, Z), and its CPU seconds."""
    began = time.process_time()
    found = method.reconstruct(*fit_to_grid(method, grid, xrays, beam))
    spent = time.process_time() - began
    return interpolated(found.volume, grid, onto, AIR)[None, None], spent


def main(doc: str, file: Path, rows_of: Callable[[CTFile, int], list[dict]]) -> list[dict]:
    """The rows of each CT of a folder, from the number of views that is asked for; writes them into a CSV beside those
    of others."""
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cts", type=Path)
    parser.add_argument("--views", type=int, default=8)
    given = parser.parse_args()
    kept = [row for row in read_csv(file) if row["views"] != given.views]
    rows = [row for ct in find_cts(given.cts) for row in rows_of(ct, given.views)]
    write_csv(file, kept + rows)
    return rows


def table(rows: list[dict]) -> str:
    lines = ["| way | PSNR (dB) | SSIM | body: PSNR | CPU seconds |", "|---|---:|---:|---:|---:|"]
    for way in WAYS:
        means = [mean(row[key] for row in rows if row["way"] == way)
                 for key in ("psnr", "ssim", "psnr_body", "cpu_seconds")]
        lines.append("| {} | {:.2f} | {:.3f} | {:.2f} | {:.0f} |".format(way, *means))
    first, *_, last = ({row["case"]: row["psnr"] for row in rows if row["way"] == way} for way in WAYS)
    return "\n".join([*lines, "", f"least lead {min(last[case] - first[case] for case in first):+.2f} dB"])


if __name__ == "__main__":
    print(table(main(__doc__, FILE, rows_of)))
