"""What the training of phydict_learned's network was worth: CTs reconstructed with weights from along the way.

    python tests/benchmark/refiner_training.py <folder of CTs> <core-hours>=<refiner.safetensors> ...
                                               [--views 1 2 4 8 16]

core-hours: of training that the weights have seen; from any number of views they are called four times. Writes
refiner_training.csv beside this file, where rows of other core-hours and CTs stay, and prints the mean over the CTs.
X-rays are ideal ones of the same voxels.
"""

import argparse
from collections import defaultdict
from dataclasses import replace
from pathlib import Path
from statistics import mean

import phydict
from phydict.datasets import find_cts, prepare_ct
from phydict.evaluation import body_weights, read_csv, volume_metrics, write_csv
from phydict.methods import METHODS
from phydict.prior import DEFAULT_REFINER
from phydict.xray import Ideal, Projector
from phydict.xray.binning import benchmark_orbit

HERE = Path(__file__)
METHOD = replace(METHODS["phydict_learned"], more_times=())


def scored(refiner: phydict.prior.Refiner, core_hours: float, folder: Path, views: list[int]) -> list[dict]:
    """One row for each CT and number of views."""
    rows = []
    for ct in find_cts(folder):
        volume = prepare_ct(ct.path, refiner.grid, refiner.window, id=ct.id)["volume"][None]
        truth = refiner.window.to_hu(volume)
        body = body_weights(truth, refiner.grid.spacing)
        for number in views:
            projector = Projector(refiner.grid, benchmark_orbit(refiner.grid, number), full_detector=True)
            xrays = Ideal()(projector, refiner.window.to_mu(volume), 0)[0]
            found = phydict.reconstruct(xrays, projector.beam, refiner, METHOD, grid=refiner.grid)
            rows.append({"case": ct.id, "core_hours": core_hours, "views": number}
                        | volume_metrics(found.volume[None, None], truth, body=body))
    return rows


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cts", type=Path)
    parser.add_argument("weights", nargs="+")
    parser.add_argument("--views", type=int, nargs="+", default=[1, 2, 4, 8, 16])
    given = parser.parse_args()
    out = HERE.with_suffix(".csv")
    for hours, file in (pair.split("=") for pair in given.weights):
        found = scored(phydict.load_prior(file or DEFAULT_REFINER), float(hours), given.cts, given.views)
        made = [(row["case"], row["core_hours"], row["views"]) for row in found]
        kept = [row for row in read_csv(out) if (row["case"], row["core_hours"], row["views"]) not in made]
        write_csv(out, kept + found)
        by_views = defaultdict(list)
        for row in found:
            by_views[row["views"]].append(row["psnr"])
        print(hours, *(f"K = {views}: {mean(psnr):.2f} dB" for views, psnr in by_views.items()), flush=True)
