"""Whether the intervals of phydict_learned hold what they promise, on CTs that neither training nor calibration saw.

    python tests/benchmark/uncertainty.py <folder of CTs> [refiner.safetensors]

Writes uncertainty.csv beside this file: for each CT, number of views and scene, and for body and lung, the share of
voxels inside the intervals of 50, 80, 90 and 95 %, the rank correlation of their width with the error, half their mean
width at 90 %, and half the width that one interval for all of these voxels would need to hold 90 % of them. The last
line of a scene's table is the mean over CTs.
"""

import argparse
from collections.abc import Iterator
from pathlib import Path
from statistics import mean

import torch
from scipy.stats import spearmanr

from phydict import ConeBeam, Grid, Projector, load_prior, reconstruct
from phydict.datasets import body_mask, find_cts, prepare_ct
from phydict.evaluation import write_csv
from phydict.prior import DEFAULT_REFINER
from phydict.runtime.shipped import shipped
from phydict.units import HUWindow
from phydict.xray import Ideal, Polychromatic
from phydict.xray.binning import benchmark_orbit
from phydict.xray.simulate import Simulator

WINDOW, FINE = HUWindow(), 128


def scenes(grid: Grid) -> Iterator[tuple[str, ConeBeam, Simulator]]:
    for views in (1, 2, 4, 8, 16):
        yield "ideal", benchmark_orbit(grid, views), Ideal()
    for views in (1, 2, 4, 8, 16):
        yield "polychromatic", benchmark_orbit(grid, views), Polychromatic()
    for name in ("arc_60", "truncated"):
        yield name, ConeBeam.load(shipped(f"configs/geometry/{name}.yaml")), Ideal()


def rows_of(ct, refiner) -> Iterator[dict]:
    grid = refiner.grid
    fine_grid = Grid.cube(FINE, grid.extent[0])
    fine = prepare_ct(ct.path, fine_grid, WINDOW, id=ct.id)
    for scene, beam, simulator in scenes(grid):
        ideal = isinstance(simulator, Ideal)
        case = prepare_ct(ct.path, grid, WINDOW, id=ct.id)
        volume, made = (case["volume"], grid) if ideal else (fine["volume"], fine_grid)
        xrays = simulator(Projector(made, beam, full_detector=True), WINDOW.to_mu(volume)[None], 0)[0]
        found = reconstruct(xrays, beam, refiner, mu_water=simulator.effective_mu_water)
        truth = WINDOW.to_hu(case["volume"] if ideal else torch.nn.functional.avg_pool3d(fine["volume"], 2))[0]
        error, lung = (found.volume - truth).abs(), case["masks"][0] > 0.5
        body = torch.from_numpy(body_mask(truth.numpy(), grid.spacing)) | lung
        for part, mask in (("body", body), ("lung", lung)):
            inside = {f"inside_{100 * level:.0f}": float((error <= width)[mask].float().mean())
                      for level, width in found.intervals.items()}
            width = found.intervals[0.9][mask]
            yield {"case": ct.id, "method": "phydict_learned", "scene": scene, "views": beam.views, "part": part,
                   **inside, "rank_correlation": float(spearmanr(width, error[mask])[0]),
                   "half_width_90_hu": float(width.mean()), "constant_90_hu": float(error[mask].quantile(0.9))}


def table(rows: list[dict]) -> str:
    columns = [name for name in rows[0] if name not in ("case", "method", "scene", "views", "part")]
    lines = ["| X-rays | K | part | " + " | ".join(columns) + " |", "|---|---:|---|" + "---:|" * len(columns)]
    for place in dict.fromkeys((row["scene"], row["views"], row["part"]) for row in rows):
        own = [row for row in rows if (row["scene"], row["views"], row["part"]) == place]
        means = [mean(row[name] for row in own) for name in columns]
        lines.append(f"| {place[0]} | {place[1]} | {place[2]} | " + " | ".join(
            f"{value:.0f}" if name.endswith("hu") else f"{value:.2f}" for name, value in zip(columns, means)) + " |")
    return "\n".join(lines)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cts", type=Path)
    parser.add_argument("refiner", nargs="?", type=Path, default=DEFAULT_REFINER)
    given = parser.parse_args()
    refiner = load_prior(given.refiner)
    rows = [row for ct in find_cts(given.cts) for row in rows_of(ct, refiner)]
    write_csv(Path(__file__).with_suffix(".csv"), rows)
    print(table(rows))
