"""Held-out denoising error of priors, per noise level: phantoms never trained on, and CTs if folders are given.

    python tests/benchmark/prior.py [prior.safetensors ...] [--cts folder of held-out CTs ...]

Without a prior, the shipped one. Writes prior.csv beside this file, where rows of other priors stay: RMSE of the CT in
HU, one noise draw per case and level, the same for all priors.
"""

import argparse
from pathlib import Path
from statistics import mean

import torch

from phydict import load_prior
from phydict.datasets import find_cts, phantom_case, prepare_ct
from phydict.datasets.phantoms.cached import HELD_OUT_PHANTOM
from phydict.evaluation import read_csv, write_csv
from phydict.prior import Prior
from phydict.prior.files import DEFAULT_PRIOR
from phydict.training.denoising import NOISE_LEVELS, denoising_errors


def errors(name: str, prior: Prior, cts: list) -> list[dict]:
    """One row for each held-out case and noise level."""
    cases = [phantom_case(HELD_OUT_PHANTOM + i, prior.grid, prior.window) for i in range(6)]
    cases += [prepare_ct(ct.path, prior.grid, prior.window, id=ct.id) for ct in cts]
    rows = []
    for i, case in enumerate(cases):
        x0 = torch.cat([case["volume"], 2 * case["masks"] - 1])[None]
        noise = torch.randn(x0.shape, generator=torch.Generator().manual_seed(i))
        denoiser = prior.bind(case["report"])
        for t, error in denoising_errors(denoiser, x0, noise, prior.window).items():
            sigma_hu = float(prior.schedule.sigma(t)) * prior.window.half_width
            rows.append({"prior": name, "case": case["id"], "t": t, "sigma_hu": sigma_hu, "rmse_hu": float(error)})
    return rows


def table(rows: list[dict]) -> str:
    """Mean errors in Markdown, a row for each prior and kind of case."""
    lines = ["| prior | cases | " + " | ".join(f"t = {t}" for t in NOISE_LEVELS) + " |",
             "|---|---|" + "---:|" * len(NOISE_LEVELS)]
    for name in dict.fromkeys(row["prior"] for row in rows):
        for kind, made in (("phantoms", True), ("CTs", False)):
            own = [row for row in rows if row["prior"] == name and row["case"].startswith("phantom") == made]
            if own:
                lines.append(f"| {name} | {kind} | " + " | ".join(
                    f"{mean(row['rmse_hu'] for row in own if row['t'] == t):.0f}" for t in NOISE_LEVELS) + " |")
    return "\n".join(lines)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("priors", nargs="*", type=Path, default=[DEFAULT_PRIOR])
    parser.add_argument("--cts", nargs="*", default=[])
    given = parser.parse_args()
    held_out = [ct for folder in given.cts for ct in find_cts(folder)]
    rows = [row for file in given.priors for row in errors(file.stem, load_prior(file), held_out)]
    file = Path(__file__).with_suffix(".csv")
    write_csv(file, [row for row in read_csv(file) if row["prior"] not in {own["prior"] for own in rows}] + rows)
    print(table(rows))
