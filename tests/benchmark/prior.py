"""Held-out denoising error of a prior, per noise level: phantoms never trained on, and CTs if a folder is given.

    python tests/benchmark/prior.py [prior.safetensors] [folder of held-out CTs]

Writes prior.csv beside this file: RMSE of the CT in HU, one noise draw per case and level.
"""

import sys
from pathlib import Path
from statistics import mean

import torch

from phydict import load_prior
from phydict.datamodule import HELD_OUT_PHANTOM
from phydict.datasets import find_cts, phantom_case, prepare_ct
from phydict.diffusion import renoise
from phydict.evaluation import write_csv
from phydict.methods import DEFAULT_PRIOR
from phydict.stage_training import NOISE_LEVELS

if __name__ == "__main__":
    prior = load_prior(sys.argv[1] if len(sys.argv) > 1 else DEFAULT_PRIOR)
    cases = [phantom_case(HELD_OUT_PHANTOM + i, prior.grid, prior.window) for i in range(6)]
    if len(sys.argv) > 2:
        cases += [prepare_ct(ct.path, prior.grid, prior.window, id=ct.id) for ct in find_cts(sys.argv[2])]
    rows = []
    for i, case in enumerate(cases):
        x0 = torch.cat([case["volume"], 2 * case["masks"] - 1])[None]
        noise = torch.randn(x0.shape, generator=torch.Generator().manual_seed(i))
        denoiser = prior.bind(case["report"])
        for t in NOISE_LEVELS:
            error = denoiser.denoise(renoise(prior.schedule, x0, t, noise), t) - x0
            rmse, sigma = float(error[:, 0].square().mean().sqrt()), float(prior.schedule.sigma(t))
            rows.append({"case": case["id"], "t": t, "sigma_hu": sigma * prior.window.half_width,
                         "rmse_hu": rmse * prior.window.half_width})
    write_csv(Path(__file__).with_suffix(".csv"), rows)
    kinds = {"phantoms": [r for r in rows if r["case"].startswith("phantom")],
             "CTs": [r for r in rows if not r["case"].startswith("phantom")]}
    print("| t | noise (HU) | " + " | ".join(f"{k} (HU)" for k, own in kinds.items() if own) + " |")
    for t in NOISE_LEVELS:
        level = [[r for r in own if r["t"] == t] for own in kinds.values() if own]
        print(f"| {t} | {level[0][0]['sigma_hu']:.0f} | "
              + " | ".join(f"{mean(r['rmse_hu'] for r in own):.0f}" for own in level) + " |")
