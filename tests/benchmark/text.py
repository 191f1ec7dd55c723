"""Does the report matter? Held-out phantoms from two X-rays with the right report, none, and a wrong-side one.

    python tests/benchmark/text.py [prior.safetensors ...] [--phantoms number]

Without a prior, the shipped one. The error is the mean absolute HU error over the voxels that the phantom's findings
changed. Writes text.csv beside this file. Only phantoms with a one-sided finding of at least 50 ml count: others have
no wrong side.
"""

import argparse
from pathlib import Path
from statistics import mean

import torch

import phydict
from phydict.datasets import Thorax, body_mask, pathology_region, phantom_case, report, wrong_side
from phydict.datasets.phantoms.cached import HELD_OUT_PHANTOM
from phydict.evaluation import volume_metrics, write_csv
from phydict.prior.files import DEFAULT_PRIOR
from phydict.xray import Ideal

VOXEL_ML = 0.216


def one_sided(count: int, grid: phydict.Grid) -> list[tuple[int, torch.Tensor]]:
    """The first `count` held-out seeds with a sizeable one-sided finding, and where it is."""
    found, seed = [], HELD_OUT_PHANTOM + 1000
    while len(found) < count:
        thorax = Thorax.draw(seed)
        if len(thorax.findings) == 1 and thorax.findings[0].side in ("left", "right"):
            region = torch.from_numpy(pathology_region(thorax, grid))
            if region.sum() * VOXEL_ML >= 50:
                found.append((seed, region))
        seed += 1
    return found


def compared(file: Path, count: int) -> list[dict]:
    """One row for each phantom and report, reconstructed with the prior in a file."""
    prior, rows = phydict.load_prior(file), []
    beam = phydict.ConeBeam.orbit(2, 1020.0, 740.0, shape=(112, 112), pixel=(5.0, 5.0))
    projector = phydict.Projector(prior.grid, beam)
    for seed, region in one_sided(count, prior.grid):
        case, thorax = phantom_case(seed, prior.grid, prior.window), Thorax.draw(seed)
        xrays = Ideal()(projector, prior.window.to_mu(case["volume"])[None], seed)[0]
        truth = prior.window.to_hu(case["volume"])[None]
        body = torch.from_numpy(body_mask(truth[0, 0].numpy(), prior.grid.spacing))[None, None]
        for name, text in (("correct", report(thorax)), ("none", ""), ("wrong side", report(wrong_side(thorax)))):
            result = phydict.reconstruct(xrays, beam, prior, report=text, seed=seed)
            error = (result.volume - truth[0, 0]).abs()[region].mean()
            rows.append({"prior": file.stem, "case": f"phantom-{seed}", "finding": thorax.findings[0].kind,
                         "method": name, "views": 2, "region_mae_hu": float(error)}
                        | volume_metrics(result.volume[None, None], truth, body=body))
    return rows


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("priors", nargs="*", type=Path, default=[DEFAULT_PRIOR])
    parser.add_argument("--phantoms", type=int, default=12)
    given = parser.parse_args()
    rows = [row for file in given.priors for row in compared(file, given.phantoms)]
    write_csv(Path(__file__).with_suffix(".csv"), rows)
    for file in given.priors:
        for name in ("correct", "none", "wrong side"):
            own = [row for row in rows if (row["prior"], row["method"]) == (file.stem, name)]
            print(f"{file.stem}, {name:12s} region MAE {mean(r['region_mae_hu'] for r in own):6.1f} HU   "
                  f"PSNR {mean(r['psnr'] for r in own):.2f} dB")
