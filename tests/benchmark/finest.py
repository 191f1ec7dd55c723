"""Whether 256^3 voxels show more than 128^3 ones, and by what: phydict_learned from X-rays of 512^3 voxels, scored on
256^3.

    python tests/benchmark/finest.py <folder of CTs> [--views 8] [--ways <way> ...]

Beside the volume on 256^3 voxels that of 128^3, interpolated; what the X-rays and total variation alone make of its
64^3 on 256^3, without the networks on finer voxels; what the network of 3 mm makes of them alone; and methods without a
prior on 256^3, total variation at its weight of 64^3 times the ratio of the voxels' lengths, CGLS at five restarts and
SIRT at 300 iterations, the best on a training CT, DiffVox at its settings of 64^3. Scored by LPIPS too (TORCH_HOME: its
backbones), and by how sharp edges are. Writes finest.csv beside this file after each CT, where rows of other CTs,
numbers of views and ways stay, and prints means and the least lead of 256^3 over each.
"""

import argparse
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from statistics import mean
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import avg_pool3d

from phydict import ConeBeam, HUWindow, Projector
from phydict.baselines import CGLS, FISTATV, SIRT, DiffVox
from phydict.datasets import CTFile, find_cts, prepare_ct
from phydict.evaluation import body_weights, read_csv, volume_metrics, write_csv
from phydict.evaluation.perceptual import lpips_scores
from phydict.evaluation.sharpness import sharpness_scores
from phydict.grid import Grid
from phydict.methods import onto_grid, reconstructor
from phydict.posterior import Refinement
from phydict.prior import DEFAULT_CORRECTION, load_correction
from phydict.runtime.precision import instruction_set
from phydict.runtime.seeds import case_seed
from phydict.units import AIR
from phydict.xray import Ideal
from phydict.xray.binning import benchmark_orbit
from phydict.xray.boxes import interpolated

sys.path.append(str(Path(__file__).parents[1]))
from fitting import fit_to_grid

FILE = Path(__file__).with_suffix(".csv")
FINEST, WINDOW = Grid.cube(256), HUWindow()
SIMULATED = Grid.cube(512)


def learned():
    return onto_grid(reconstructor("phydict_learned"), FINEST)


WAYS: dict[str, Callable[[], Any]] = {
    "128^3, interpolated": lambda: onto_grid(reconstructor("phydict_learned"), Grid.cube(128)),
    "64^3, X-rays and total variation": lambda: replace(learned(), networks=(), refinement=Refinement(calls=0)),
    "256^3, network of 3 mm": lambda: replace(learned(), networks=(load_correction(DEFAULT_CORRECTION),)),
    "256^3": learned,
    "tv": lambda: FISTATV(200, 9.6e-3), "cgls": lambda: CGLS(10, 5, WINDOW), "sirt": lambda: SIRT(300),
    "diffvox": DiffVox}


def rows_of(ct, views: int, ways: list[str]) -> list[dict]:
    volume, xrays, beam = scene(ct, views, SIMULATED)
    truth, rows = WINDOW.to_hu(avg_pool3d(volume, SIMULATED.shape[0] // FINEST.shape[0])), []
    body, lung = body_weights(truth, FINEST.spacing), prepare_ct(ct.path, FINEST, WINDOW, id=ct.id)["masks"][0]
    for way in ways:
        method = WAYS[way]()
        shown, seconds = timed(method, method.grid or FINEST, FINEST, xrays, beam)
        rows.append({"case": ct.id, "views": views, "way": way, "cpu_seconds": seconds,
                     "instruction_set": instruction_set(torch.device("cpu"))} | volume_metrics(shown, truth, body=body)
                    | sharpness_scores(shown[0, 0], truth[0, 0], lung, FINEST) | lpips_scores(shown[0, 0], truth[0, 0]))
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


def main(doc: str, file: Path, rows_of: Callable[[CTFile, int, list[str]], list[dict]], key: str,
         names: list[str]) -> list[dict]:
    """The rows of each CT of a folder, from the number of views and by those of `names` that are asked for, which stand
    under `key`; writes them into a CSV after each CT, beside the others. Returns all rows of those views."""
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cts", type=Path)
    parser.add_argument("--views", type=int, default=8)
    parser.add_argument(f"--{key}s", nargs="+", default=names, choices=names)
    given = parser.parse_args()
    chosen = getattr(given, f"{key}s")
    for ct in find_cts(given.cts):
        new = rows_of(ct, given.views, chosen)
        write_csv(file, [row for row in read_csv(file)
                         if (row["case"], row["views"]) != (ct.id, given.views) or row[key] not in chosen] + new)
    return [row for row in read_csv(file) if row["views"] == given.views]


def table(rows: list[dict]) -> str:
    lines = ["| way | PSNR (dB) | SSIM | body: PSNR | CPU seconds | least lead of 256^3 (dB) |",
             "|---|---:|---:|---:|---:|---:|"]
    psnr = {(row["case"], row["way"]): row["psnr"] for row in rows}
    for way in dict.fromkeys(row["way"] for row in rows):
        own = [row for row in rows if row["way"] == way]
        means = [mean(row[name] for row in own) for name in ("psnr", "ssim", "psnr_body", "cpu_seconds")]
        lead = min(psnr[row["case"], "256^3"] - row["psnr"] for row in own)
        lines.append("| {} | {:.2f} | {:.3f} | {:.2f} | {:.0f} | {:+.2f} |".format(way, *means, lead))
    return "\n".join(lines)


if __name__ == "__main__":
    print(table(main(__doc__, FILE, rows_of, "way", list(WAYS))))
