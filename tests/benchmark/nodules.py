"""Which nodules a user may hope to see: the share of their contrast that a reconstruction shows.

    python tests/benchmark/nodules.py <folder of CTs> [--views 2 4 8 16] [--methods phydict_learned=64 ...]

Into the lungs of a CT of 256^3 voxels a ball of each of SIZES is put, 50 mm or more apart, all denser than the lung by
one of CONTRASTS. Each method, on its voxels, reconstructs K ideal views with and without them, of the same noise.
Writes nodules.csv beside this file, a row per CT, method, K, contrast and size: the difference of the two in the ball
less that in the shell around it, over the contrast (`recovered_contrast`); nodules.png, a curve per method; and prints
the means over CTs. Rows that are there already are kept.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from statistics import mean

import numpy as np
import torch
from balls import nodule, recovered_contrast
from lesions import GRID, places
from matplotlib.figure import Figure
from torch import Tensor

from phydict import Grid, HUWindow, Projector, reconstruct
from phydict.baselines import FISTATV
from phydict.datasets import find_cts, prepare_ct
from phydict.evaluation import read_csv, write_csv
from phydict.runtime.seeds import case_seed
from phydict.xray import Ideal
from phydict.xray.binning import benchmark_orbit

OUT = Path(__file__).with_suffix(".csv")
WINDOW, FINE = HUWindow(), Grid.cube(256)
SIZES, CONTRASTS = (6.0, 8.0, 10.0, 14.0, 20.0), (100.0, 300.0, 800.0)
METHODS = ("phydict_learned=128", "phydict_learned=64", "tv=64")
"""Method and voxels; the weight of total variation grows with their number along an axis, from its default on 64."""


def reconstructed(hu: Tensor, views: int, method: str, seed: int) -> tuple[Tensor, Grid]:
    """HU (X, Y, Z) by a method, named with its voxels, of ideal views of HU on FINE, and their grid."""
    name, voxels = method.split("=")
    ready = FISTATV(weight=int(voxels) / 64 * FISTATV.weight) if name == "tv" else name
    beam, grid = benchmark_orbit(FINE, views), Grid.cube(int(voxels))
    xrays = Ideal()(Projector(FINE, beam, full_detector=True), WINDOW.to_mu(WINDOW.to_range(hu))[None, None], seed)[0]
    return reconstruct(xrays, beam, method=ready, grid=grid).volume, grid


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cts", type=Path)
    parser.add_argument("--views", type=int, nargs="+", default=[2, 4, 8, 16])
    parser.add_argument("--methods", nargs="+", default=METHODS)
    given = parser.parse_args()
    rows = read_csv(OUT)
    done = {(row["case"], row["method"], row["views"], row["contrast_hu"]) for row in rows}
    for ct in find_cts(given.cts):
        plain = WINDOW.to_hu(prepare_ct(ct.path, FINE, WINDOW, id=ct.id)["volume"])[0]
        lung = prepare_ct(ct.path, GRID, WINDOW, id=ct.id)["masks"][0].numpy() > 0.5
        seed = case_seed(0, ct.id)
        put = list(zip(places(lung, np.random.default_rng(seed)), SIZES))
        balls = torch.stack([nodule(FINE, point, size) for point, size in put]).amax(0)
        for method, views in ((method, views) for method in given.methods for views in given.views):
            missing = [contrast for contrast in CONTRASTS if (ct.id, method, views, contrast) not in done]
            without, grid = reconstructed(plain, views, method, seed) if missing else (plain, FINE)
            for contrast in missing:
                found, _ = reconstructed((plain + contrast * balls).clamp(max=WINDOW.high), views, method, seed)
                rows += [{"case": ct.id, "method": method, "views": views, "contrast_hu": contrast, "diameter_mm": size,
                          "recovered": recovered_contrast(found, without, grid, point, size, contrast)}
                         for point, size in put]
                write_csv(OUT, rows)
                print(*rows[-1].values(), flush=True)
    draw(rows)


def draw(rows: list[dict]) -> None:
    """Prints and plots the means over CTs."""
    scenes = sorted({(row["views"], row["contrast_hu"]) for row in rows})
    methods = sorted({row["method"] for row in rows})
    figure = Figure(figsize=(4 * len(CONTRASTS), 3 * len(scenes) / len(CONTRASTS)))
    axes = figure.subplots(-(-len(scenes) // len(CONTRASTS)), len(CONTRASTS), sharex=True, sharey=True, squeeze=False)
    for ax, (views, contrast) in zip(axes.flat, scenes):
        scene = [row for row in rows if (row["views"], row["contrast_hu"]) == (views, contrast)]
        for color, method in enumerate(methods):
            own = [row for row in scene if row["method"] == method]
            if not own:
                continue
            means = [mean(row["recovered"] for row in own if row["diameter_mm"] == size) for size in SIZES]
            ax.plot(SIZES, means, marker="o", color=f"C{color}", label=method)
            print("", views, f"{contrast:.0f}", method, *(f"{value:.2f}" for value in means), "", sep=" | ")
        ax.set_title(f"K = {views}, {contrast:.0f} HU denser")
        ax.grid(True, linewidth=0.3)
    named = {line.get_label(): line for ax in axes.flat for line in ax.get_lines()}
    axes[0, 0].legend(named.values(), named.keys(), fontsize=8)
    figure.supxlabel("diameter (mm)")
    figure.supylabel("share of the contrast that is shown")
    figure.tight_layout()
    figure.savefig(OUT.with_suffix(".png"), dpi=100)


if __name__ == "__main__":
    main()
