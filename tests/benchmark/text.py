"""Does the report matter? Held-out phantoms from few X-rays with the right report, none, and a wrong-side one.

    python tests/benchmark/text.py [prior.safetensors ...] [--phantoms 48] [--views 1 2 4] [--guidance 1]
                                   [--first_views N] [--first_seed 1001000] [--out FILE]
    python tests/benchmark/text.py [prior.safetensors ...] --lowered 10 [--phantoms 16] [--views 1 2]
    python tests/benchmark/text.py [prior.safetensors ...] --cts <folder of CTs> [--views 1 2 4]

The second: of phantoms that so many voxels at their lower end lie below the volume, in text_lowered.csv beside this
file. The third: what a report that all is normal does to CTs, in text_cts.csv.

Without a prior, the shipped one. The error is the mean absolute HU error over the voxels that the phantom's findings
changed; where the method knows intervals, inside_90 is the share of these voxels, and of the body's, in the 90 % one.
Writes text.csv beside this file, where rows of other priors, numbers of views and guidance scales stay, and prints
means and paired differences to the same case without a report, each with its standard error. With --first_views the
refiner hears reports with up to N views, and its rows say so. Only phantoms with a one-sided finding of at least 50 ml
count: others have no wrong side.
"""

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch.nn.functional import pad

import phydict
from phydict.datasets import Thorax, find_cts, pathology_region, phantom_case, prepare_ct, report, wrong_side
from phydict.datasets.phantoms.cached import HELD_OUT_PHANTOM
from phydict.evaluation import body_weights, read_csv, volume_metrics, write_csv
from phydict.methods import METHODS
from phydict.prior import DEFAULT_PRIOR, Prior
from phydict.xray import Ideal
from phydict.xray.binning import benchmark_orbit

HELD_OUT = HELD_OUT_PHANTOM + 1000
"""The first seed of the phantoms that are compared."""

REPORTS = ("right report", "none", "wrong side")

NORMAL = "The lungs are clear. No pleural effusion or pneumothorax. Heart size is normal. No nodules or masses."


def one_sided(count: int, grid: phydict.Grid, seed: int) -> list[tuple[int, torch.Tensor]]:
    """The first `count` phantoms from a seed on with a sizeable one-sided finding, and where it is."""
    voxel_ml, found = np.prod(grid.spacing) / 1000, []
    while len(found) < count:
        thorax = Thorax.draw(seed)
        if len(thorax.findings) == 1 and thorax.findings[0].side in ("left", "right"):
            region = torch.from_numpy(pathology_region(thorax, grid))
            if region.sum() * voxel_ml >= 50:
                found.append((seed, region))
        seed += 1
    return found


def compared(name: str, prior: Prior, cases: list[tuple[int, torch.Tensor]], views: int, guidance: float,
             method=None, lowered: int = 0) -> list[dict]:
    """One row for each phantom and report, reconstructed from a number of X-rays."""
    rows = []
    beam = phydict.ConeBeam.orbit(views, 1020.0, 740.0, shape=(112, 112), pixel=(5.0, 5.0))
    projector = phydict.Projector(prior.grid.grown(0, 0, lowered), beam, full_detector=bool(lowered))
    for seed, region in cases:
        case, thorax = phantom_case(seed, prior.grid, prior.window), Thorax.draw(seed)
        seen = pad(case["volume"][None], (0, 2 * lowered), value=-1.0)
        xrays = Ideal()(projector, prior.window.to_mu(seen), seed)[0]
        held = slice(lowered, lowered + prior.grid.shape[2])
        truth, region = prior.window.to_hu(seen[..., held]), pad(region, (0, 2 * lowered))[..., held]
        if not region.any():
            continue
        body = body_weights(truth, prior.grid.spacing)
        for kind, text in zip(REPORTS, (report(thorax), "", report(wrong_side(thorax)))):
            result = phydict.reconstruct(xrays, beam, prior, method, text, seed=seed, guidance=guidance)
            error = (result.volume - truth[0, 0]).abs()
            rows.append({"prior": name, "case": f"phantom-{seed}", "finding": thorax.findings[0].kind, "method": kind,
                         "views": views, "guidance": guidance, "region_mae_hu": float(error[region].mean())}
                        | volume_metrics(result.volume[None, None], truth, body=body)
                        | {f"inside_90_{part}": float((error <= result.intervals[0.9])[where].double().mean())
                           for part, where in (("region", region), ("body", body[0, 0] > 0)) if result.intervals})
    return rows


def spared(name: str, prior: Prior, folder: Path, views: int) -> list[dict]:
    """One row for each CT, reconstructed from a number of X-rays without a report and with NORMAL."""
    rows, beam = [], benchmark_orbit(prior.grid, views)
    projector = phydict.Projector(prior.grid, beam, full_detector=True)
    for ct in find_cts(folder):
        case = prepare_ct(ct.path, prior.grid, prior.window, id=ct.id)["volume"][None]
        xrays, truth = Ideal()(projector, prior.window.to_mu(case), 0)[0], prior.window.to_hu(case)
        body = body_weights(truth, prior.grid.spacing)
        for kind, text in (("none", ""), ("normal", NORMAL)):
            result = phydict.reconstruct(xrays, beam, prior, report=text, seed=0, grid=prior.grid)
            rows.append({"prior": name, "case": ct.id, "method": kind, "views": views}
                        | volume_metrics(result.volume[None, None], truth, body=body))
            print(f"{ct.id}, K = {views}, {kind}: {rows[-1]['psnr']:.2f} dB", flush=True)
    return rows


def mean_and_error(values: np.ndarray) -> str:
    """A mean and its standard error."""
    return f"{values.mean():8.2f} +- {values.std(ddof=1) / np.sqrt(len(values)):.2f}"


def summary(rows: list[dict]) -> str:
    """Of rows with one prior and number of views, each report's figures, and what they change in each case."""
    column = {(kind, key): np.array([row[key] for row in rows if row["method"] == kind])
              for kind in REPORTS for key in ("region_mae_hu", "psnr")}
    lines = []
    for kind in REPORTS:
        error, psnr = column[kind, "region_mae_hu"], column[kind, "psnr"]
        lines.append(f"K = {rows[0]['views']}, {kind:12s} region MAE {mean_and_error(error)} HU "
                     f"({mean_and_error(error - column['none', 'region_mae_hu'])} to none), PSNR {psnr.mean():.2f} dB "
                     f"({mean_and_error(psnr - column['none', 'psnr'])})")
    return "\n".join(lines)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("priors", nargs="*", type=Path, default=[DEFAULT_PRIOR])
    parser.add_argument("--phantoms", type=int, default=48)
    parser.add_argument("--views", type=int, nargs="+", default=[1, 2, 4])
    parser.add_argument("--guidance", type=float, default=1.0)
    parser.add_argument("--first_views", type=int)
    parser.add_argument("--first_seed", type=int, default=HELD_OUT, help="of the phantoms")
    parser.add_argument("--lowered", type=int, default=0, help="voxels by which phantoms lie lower")
    parser.add_argument("--cts", type=Path)
    parser.add_argument("--out", type=Path)
    given = parser.parse_args()
    if given.first_seed != HELD_OUT and not given.out:
        parser.error("rows of other phantoms do not belong into text.csv: give --out")
    out = given.out or Path(__file__).with_name(
        "text_cts.csv" if given.cts else "text_lowered.csv" if given.lowered else "text.csv")
    method, suffix = None, ""
    if given.first_views is not None:
        method = replace(METHODS["phydict_learned"], first_views=given.first_views)
        suffix = f" (first_views {given.first_views})"
    for file in given.priors:
        prior, name = phydict.load_prior(file), file.stem + suffix
        cases = [] if given.cts else one_sided(given.phantoms, prior.grid, given.first_seed)
        guidance = 1.0 if given.cts else given.guidance
        for views in given.views:
            if given.cts:
                found = spared(name, prior, given.cts, views)
            else:
                found = compared(name, prior, cases, views, guidance, method, given.lowered)
                print(f"{name}:\n{summary(found)}", flush=True)
            own = name, views, guidance
            write_csv(out, [row for row in read_csv(out)
                            if (row["prior"], row["views"], row.get("guidance", 1.0)) != own] + found)
