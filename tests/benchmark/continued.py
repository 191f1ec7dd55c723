"""What it costs that a patient goes on above and below the volume, and what a geometry that says so gives back.

    python tests/benchmark/continued.py <folder of CTs> [--views 2 8] [--methods phydict_learned phydict_fast tv]

Each CT's last scanned slices are repeated to 576 mm, and ideal X-rays on the benchmarks' orbit are made of all of that
(`goes on`), or of the CT as it is in its 384 mm (`ends`). Each is reconstructed on the 384 mm without and with
`ConeBeam.continued`. Scored over these voxels, and over the middle 264 mm. Repeated slices are what is assumed, so that
a real patient gains less. Writes continued.csv beside this file and prints the means.
"""

import argparse
from dataclasses import replace
from pathlib import Path
from statistics import mean

import torch
from torch import Tensor

from phydict import Projector, reconstruct
from phydict.datasets import find_cts, prepare_ct
from phydict.evaluation import body_weights, volume_metrics, write_csv
from phydict.grid import Grid
from phydict.units import HUWindow
from phydict.xray import Ideal
from phydict.xray.binning import benchmark_orbit
from phydict.xray.projectors.continued import with_slices

GRID, WINDOW, MORE = Grid.cube(64), HUWindow(), 16
SOFT, LEAST = -300, 150
"""HU, and voxels above it, by which a slice was scanned."""
MIDDLE = slice(10, 54)


def going_on(volume: Tensor) -> Tensor:
    """A CT (1, 1, X, Y, Z) on MORE slices to both sides, those that were not scanned replaced by the last that were."""
    scanned = ((WINDOW.to_hu(volume)[0, 0] > SOFT).sum((0, 1)) > LEAST).nonzero().flatten()
    first, last = int(scanned[0]) + 1, int(scanned[-1]) - 1  # whose averages hold no slice beyond the scan
    return volume[..., torch.arange(-MORE, GRID.shape[2] + MORE).clamp(first, last)]


def rows_of(ct, views: list[int], methods: list[str]) -> list[dict]:
    plain = prepare_ct(ct.path, GRID, WINDOW, id=ct.id)["volume"][None]
    tall, rows = going_on(plain), []
    for k in views:
        beam = benchmark_orbit(GRID, k)
        for patient, volume, grid in (("goes on", tall, with_slices(GRID, MORE)), ("ends", plain, GRID)):
            xrays = Ideal()(Projector(grid, beam, full_detector=True), WINDOW.to_mu(volume), 0)[0]
            truth = WINDOW.to_hu(tall[..., MORE:-MORE] if patient == "goes on" else plain)
            for name in methods:
                for continued in (False, True):
                    found = reconstruct(xrays, replace(beam, continued=continued), method=name, grid=GRID)
                    hu = found.volume[None, None]
                    scores = volume_metrics(hu, truth, body=body_weights(truth, GRID.spacing))
                    middle = volume_metrics(hu[..., MIDDLE].contiguous(), truth[..., MIDDLE].contiguous())
                    rows.append({"case": ct.id, "patient": patient, "continued": continued, "method": name, "views": k,
                                 "misfit": found.misfit, "psnr_middle": middle["psnr"]} | scores)
                    print(*rows[-1].values(), flush=True)
    return rows


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cts", type=Path)
    parser.add_argument("--views", type=int, nargs="+", default=[2, 8])
    parser.add_argument("--methods", nargs="+", default=["phydict_learned", "phydict_fast", "tv"])
    given = parser.parse_args()
    rows = [row for ct in find_cts(given.cts) for row in rows_of(ct, given.views, given.methods)]
    write_csv(Path(__file__).with_suffix(".csv"), rows)
    for name in given.methods:
        for k in given.views:
            of = [row for row in rows if row["method"] == name and row["views"] == k]
            print(name, k, {(patient, continued): round(mean(
                row["psnr"] for row in of if row["patient"] == patient and row["continued"] == continued), 2)
                for patient in ("goes on", "ends") for continued in (False, True)})
