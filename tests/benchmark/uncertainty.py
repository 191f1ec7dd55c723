"""Whether the intervals of phydict_learned hold what they promise, on CTs that neither training nor calibration saw.

    python tests/benchmark/uncertainty.py <folder of CTs> [refiner.safetensors] [--only <words in a scene's name>]

Writes uncertainty.csv beside this file: for each CT, number of views and scene, and for body and lung, the share of
voxels inside the intervals of 50, 80, 90 and 95 %; the rank correlation of their width with the error, and beside it
that of the error's own root mean square over the LOCAL^3 voxels around; half their mean width at 90 %, and half the
width that one interval for all of these voxels would need to hold 90 % of them. Draws uncertainty.png, the reliability
diagram, and prints the means over the CTs.
"""

import argparse
from collections.abc import Iterator
from pathlib import Path
from statistics import mean

import torch
from matplotlib.figure import Figure
from scipy.stats import spearmanr

from phydict import ConeBeam, Grid, Projector, load_prior, reconstruct
from phydict.datasets import body_mask, find_cts, prepare_ct
from phydict.evaluation import read_csv, write_csv
from phydict.prior import DEFAULT_REFINER
from phydict.runtime.shipped import shipped
from phydict.units import HUWindow
from phydict.xray import Ideal, Polychromatic
from phydict.xray.binning import benchmark_orbit
from phydict.xray.simulate import Simulator

WINDOW, BEYOND = HUWindow(), "voxels_"
"""The range of HU, and how scenes on finer voxels than the refiner's are called."""
LOCAL = 5
"""Voxels along the side of the cube whose errors tell how large one of them is."""


def scenes(grid: Grid) -> Iterator[tuple[str, ConeBeam, Simulator, Grid, Grid]]:
    """Name, geometry, simulator, and the voxels of the result and of the volume that X-rays are made of."""
    fine, finest = (Grid.cube(factor * grid.shape[0], grid.extent[0]) for factor in (2, 4))
    for views in (1, 2, 4, 8, 16):
        yield "ideal", benchmark_orbit(grid, views), Ideal(), grid, grid
    for views in (1, 2, 4, 8, 16):
        yield "polychromatic", benchmark_orbit(grid, views), Polychromatic(), grid, fine
    for views in (2, 4, 8, 16):
        yield "scatter", benchmark_orbit(grid, views), Polychromatic(scatter=0.06), grid, fine
    for name in ("arc_60", "truncated"):
        yield name, ConeBeam.load(shipped(f"configs/geometry/{name}.yaml")), Ideal(), grid, grid
    for degrees in (25, 15):
        yield f"arc_{degrees}", benchmark_orbit(grid, 8, degrees), Ideal(), grid, grid
    yield "many", benchmark_orbit(grid, 64), Ideal(), grid, grid
    for views in (1, 2, 4, 8, 16):
        yield f"{BEYOND}{fine.shape[0]}", benchmark_orbit(finest, views), Ideal(), fine, finest


def rows_of(ct, refiner, only: str) -> Iterator[dict]:
    for scene, beam, simulator, grid, made in scenes(refiner.grid):
        if only not in scene:
            continue
        case, source = (prepare_ct(ct.path, voxels, WINDOW, id=ct.id) for voxels in (grid, made))
        xrays = simulator(Projector(made, beam, full_detector=True), WINDOW.to_mu(source["volume"])[None], 0)[0]
        found = reconstruct(xrays, beam, refiner, mu_water=simulator.effective_mu_water,
                            grid=grid if scene.startswith(BEYOND) else None)
        truth = WINDOW.to_hu(torch.nn.functional.avg_pool3d(source["volume"], made.shape[0] // grid.shape[0]))[0]
        error, lung = (found.volume - truth).abs(), case["masks"][0] > 0.5
        around = torch.nn.functional.avg_pool3d(error.square()[None], LOCAL, 1, LOCAL // 2)[0]
        body = torch.from_numpy(body_mask(truth.numpy(), grid.spacing)) | lung
        for part, mask in (("body", body), ("lung", lung)):
            inside = {f"inside_{100 * level:.0f}": float((error <= width)[mask].float().mean())
                      for level, width in found.intervals.items()}
            width = found.intervals[0.9][mask]
            yield {"case": ct.id, "method": "phydict_learned", "scene": scene, "views": beam.views, "part": part,
                   **inside, "rank_correlation": float(spearmanr(width, error[mask])[0]),
                   "rank_correlation_around": float(spearmanr(around[mask], error[mask])[0]),
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


def draw_reliability(rows: list[dict], path: Path) -> None:
    """The share of voxels inside against the share promised, a line per scene, body beside lung."""
    figure = Figure((10, 5), layout="constrained")
    levels = [int(name.removeprefix("inside_")) for name in rows[0] if name.startswith("inside_")]
    for part, axes in zip(("body", "lung"), figure.subplots(1, 2, sharey=True)):
        axes.fill_between([45, 100], [40, 95], [50, 105], color="0.92", label="within 5 points")
        axes.plot([45, 100], [45, 100], color="0.5", linewidth=1)
        for color, scene in enumerate(dict.fromkeys(row["scene"] for row in rows)):
            of_scene = [row for row in rows if (row["scene"], row["part"]) == (scene, part)]
            for views in dict.fromkeys(row["views"] for row in of_scene):
                shares = [mean(100 * row[f"inside_{level}"] for row in of_scene if row["views"] == views)
                          for level in levels]
                axes.plot(levels, shares, "o-", color=f"C{color}", markersize=2 + views**0.5, linewidth=0.8,
                          label=scene.replace("_", " ") if views == of_scene[0]["views"] else None)
        axes.set(title=part, xlabel="promised (%)", xlim=(45, 100), ylim=(25, 102))
    figure.axes[0].set_ylabel("voxels inside (%), mean over the CTs")
    figure.axes[0].legend(fontsize="small", title="larger: more views", title_fontsize="small")
    figure.savefig(path, dpi=100)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cts", type=Path)
    parser.add_argument("refiner", nargs="?", type=Path, default=DEFAULT_REFINER)
    parser.add_argument("--only", default="", help="words in the names of the scenes to compute anew; the rest is kept")
    given = parser.parse_args()
    refiner, out = load_prior(given.refiner), Path(__file__).with_suffix(".csv")
    kept = [row for row in read_csv(out) if given.only not in row["scene"]] if given.only else []
    rows = kept + [row for ct in find_cts(given.cts) for row in rows_of(ct, refiner, given.only)]
    write_csv(out, rows)
    draw_reliability(rows, out.with_suffix(".png"))
    print(table(rows))
