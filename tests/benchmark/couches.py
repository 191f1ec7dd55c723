"""Methods on CTs that lie on other couches, beside total variation, from numbers of views that no other table has.

    python tests/benchmark/couches.py <folder of CTs> [--views 3 6 12 24] [--draws 2]
                                      [--methods tv phydict_fast phydict_learned]
    python tests/benchmark/couches.py <folder of CTs> --views 24 --methods "tv, a third of its weight"

Ideal X-rays of draws of each CT: turned, shifted and bent, on another couch, at times with covers, leads and arms or a
scan that is cut (`held_out.scenes`). Writes couches.csv beside this file, where rows of other methods and numbers of
views stay, and prints each method's means and its least lead over the first one.
"""

import argparse
from dataclasses import replace
from itertools import product
from pathlib import Path
from statistics import mean

from held_out import scenes

from phydict import load_prior, reconstruct
from phydict.datasets import find_cts
from phydict.evaluation import read_csv, write_csv
from phydict.methods import METHODS
from phydict.prior import DEFAULT_PRIOR

FILE = Path(__file__).with_suffix(".csv")
CHANGED = {"tv, a third of its weight": replace(METHODS["tv"], weight=METHODS["tv"].weight / 3)}


def rows_of(ct, methods: list[str], views: list[int], draws: int) -> list[dict]:
    prior, rows = load_prior(DEFAULT_PRIOR), list[dict]()
    for scene, xrays, beam, scores in scenes(ct, prior, views, range(1, draws + 1)):
        for method in methods:
            found = reconstruct(xrays, beam, method=CHANGED.get(method, method), grid=prior.grid)
            rows.append(scene | {"method": method} | scores(found.volume))
            print(*rows[-1].values(), flush=True)
    return rows


def table(rows: list[dict], methods: list[str], views: list[int]) -> str:
    """Means, and the least lead in PSNR over the first method with the CT and draw where it is."""
    score = {(row["method"], row["views"], row["case"], row["draw"]): row for row in rows}
    lines = ["| method | K | PSNR (dB) | SSIM | body: PSNR | least lead (dB) |", "|---|---:|---:|---:|---:|---|"]
    for method, k in product(methods, views):
        own = [row for (name, count, *_), row in score.items() if (name, count) == (method, k)]
        means = [mean(row[key] for row in own) for key in ("psnr", "ssim", "psnr_body")]
        lead, case = min((row["psnr"] - score[methods[0], k, row["case"], row["draw"]]["psnr"], row["case"])
                         for row in own)
        lines.append(f"| {method} | {k} | {means[0]:.2f} | {means[1]:.3f} | {means[2]:.2f} | {lead:+.2f} {case} |")
    return "\n".join(lines)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cts", type=Path)
    parser.add_argument("--methods", nargs="+", default=["tv", "phydict_fast", "phydict_learned"])
    parser.add_argument("--views", type=int, nargs="+", default=[3, 6, 12, 24])
    parser.add_argument("--draws", type=int, default=2)
    given = parser.parse_args()
    kept = [row for row in read_csv(FILE) if row["method"] not in given.methods or row["views"] not in given.views]
    rows = [row for ct in find_cts(given.cts) for row in rows_of(ct, given.methods, given.views, given.draws)]
    write_csv(FILE, kept + rows)
    print(table(rows, given.methods, given.views))
