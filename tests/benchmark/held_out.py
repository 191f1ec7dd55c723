"""Weights of one method beside each other on CTs that were held out, as they are and as other scans would show them.

    python tests/benchmark/held_out.py <folder of CTs> <name>=<weights> <name>=<weights> ... [--method phydict_fast]
        [--views 2 4 8 16] [--changed 3]

For choosing among weights, by CTs that neither trained them nor evaluate the result. Ideal X-rays of each CT, and of
`--changed` draws of it: turned, shifted and bent, on another couch, at times with covers, leads and arms or a scan that
is cut. Writes held_out.csv beside this file, where rows of other names and methods stay. Prints the mean differences of
PSNR from the first weights, over all voxels and in the body, with their standard errors over CTs and draws.
"""

import argparse
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from itertools import product
from pathlib import Path
from statistics import mean, stdev

from torch import Tensor

from phydict import ConeBeam, Projector, load_prior, reconstruct
from phydict.datasets import Augmentation, Surroundings, augment, find_cts, prepare_ct
from phydict.evaluation import body_weights, read_csv, volume_metrics, write_csv
from phydict.xray import Ideal
from phydict.xray.binning import benchmark_orbit

FILE = Path(__file__).with_suffix(".csv")
CHANGES = Augmentation(girth=0.0, surroundings=Surroundings(table=1.0, couch=1.0))
"""Of each changed CT: its couch is always another."""


def scenes(ct, prior, views: list[int], draws: Iterable[int]) -> Iterator[tuple[dict, Tensor, ConeBeam, Callable]]:
    """Of each draw of a CT, 0 as it is, and each number of views: these, the X-rays, their beam, and what scores a
    volume (X, Y, Z) in HU."""
    grid, window = prior.grid, prior.window
    plain = prepare_ct(ct.path, grid, window, id=ct.id)
    for draw in draws:
        volume = (augment(plain, draw, grid, window, CHANGES) if draw else plain)["volume"][None]
        truth = window.to_hu(volume)
        scores = partial(volume_metrics, true_hu=truth, body=body_weights(truth, grid.spacing))
        for k in views:
            beam = benchmark_orbit(grid, k)
            xrays = Ideal()(Projector(grid, beam, full_detector=True), window.to_mu(volume), draw)[0]
            yield {"case": ct.id, "views": k, "draw": draw}, xrays, beam, lambda hu: scores(hu[None, None])


def rows_of(ct, weights: dict, method: str, views: list[int], changed: int) -> list[dict]:
    rows: list[dict] = []
    for scene, xrays, beam, scores in scenes(ct, next(iter(weights.values())), views, range(changed + 1)):
        for name, prior in weights.items():
            found = reconstruct(xrays, beam, prior, method)
            rows.append({"weights": name, "method": method} | scene | scores(found.volume))
            print(*rows[-1].values(), flush=True)
    return rows


def table(rows: list[dict]) -> str:
    """Differences from the first weights, a row for each of the others, of the CTs as they are and of changed ones."""
    score = {(row["weights"], row["case"], row["views"], row["draw"]): row for row in rows}
    names, views = (list(dict.fromkeys(row[key] for row in rows)) for key in ("weights", "views"))
    lines = ["| weights | CTs | " + " | ".join(f"K = {k}" for k in views) + " |", "|---|---|" + "---|" * len(views)]
    for name, changed in product(names[1:], sorted({bool(row["draw"]) for row in rows})):
        cells = []
        for k in views:
            pairs = [(row, score[names[0], *place]) for (own, *place), row in score.items()
                     if own == name and place[1] == k and bool(place[2]) == changed]
            cells.append(", body ".join(of_differences([own[key] - other[key] for own, other in pairs])
                                        for key in ("psnr", "psnr_body")))
        lines.append(f"| {name} | {'changed' if changed else 'as they are'} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def of_differences(values: list[float]) -> str:
    if len(values) < 2:
        return "".join(f"{value:+.2f}" for value in values)
    return f"{mean(values):+.2f} ({stdev(values) / len(values) ** 0.5:.2f})"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cts", type=Path)
    parser.add_argument("weights", nargs="+", metavar="name=file")
    parser.add_argument("--method", default="phydict_fast")
    parser.add_argument("--views", type=int, nargs="+", default=[2, 4, 8, 16])
    parser.add_argument("--changed", type=int, default=3)
    given = parser.parse_args()
    weights = {name: load_prior(file) for name, _, file in (each.partition("=") for each in given.weights)}
    kept = [row for row in read_csv(FILE) if str(row["weights"]) not in weights or row["method"] != given.method]
    rows = [row for ct in find_cts(given.cts) for row in rows_of(ct, weights, given.method, given.views, given.changed)]
    write_csv(FILE, kept + rows)
    print(table(rows))
