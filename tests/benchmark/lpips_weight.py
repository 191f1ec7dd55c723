"""What LPIPS does in the paper's likelihood step: the gradients of the two terms, and results over its weight.

    TORCH_HOME=<folder with LPIPS' AlexNet> python tests/benchmark/lpips_weight.py <CT> [--out lpips_weight.csv]

`phydict_paper` in fewer steps on one CT from four ideal X-rays. Along a run without LPIPS, the gradients of both terms
with respect to the volume are taken at each estimate of the prior: their norms, and the share of voxels whose first
Adam step a weight of LPIPS turns round. A fresh Adam state divides each voxel's gradient by its own size, so that its
first step has the length of the learning rate and depends on the gradient's sign alone.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass, field, replace
from pathlib import Path

import torch
from torch import Tensor

from phydict.datasets import CTFile, load_case
from phydict.evaluation import write_csv
from phydict.inference.scoring import case_scores
from phydict.methods import METHODS, reconstructor
from phydict.posterior import GradientSteps, Reward, Sampler
from phydict.posterior.measurement import Measurement
from phydict.prior import load_prior
from phydict.runtime.seeds import case_seed
from phydict.xray import ConeBeam, Ideal, Projector

sys.path.append(str(Path(__file__).parents[1]))
from fitting import fit_to_grid

WEIGHTS = (0, 1, 1e3, 1e4, 1e5, 1e6)
WITH_EC = (0, 1, 1e5)
STEPS, EC_STEPS = 10, 8
SQUARED, LPIPS = Reward(), Reward(squared=0, lpips=1, backbone="alex")


@dataclass(frozen=True)
class Watched(GradientSteps):
    """The paper's step, which keeps the gradients of both terms at every estimate that it is given."""

    seen: list[dict] = field(default_factory=list)

    def __call__(self, measurement: Measurement, x0: Tensor, x0_std: float) -> Tensor:
        squared, lpips = (gradient(reward, measurement, x0) for reward in (SQUARED, LPIPS))
        acting = squared != 0
        self.seen.append({"ratio": float(squared.norm() / lpips.norm()),
                          "cosine": float((squared * lpips).sum() / squared.norm() / lpips.norm())} | {
            f"turned {w:g}": float(((squared + w * lpips).sign() != squared.sign())[acting].float().mean())
            for w in WEIGHTS})
        return super().__call__(measurement, x0, x0_std)


def gradient(reward: Reward, measurement: Measurement, x0: Tensor) -> Tensor:
    """The gradient of -J with respect to the volume x0."""
    x = x0.detach().clone().requires_grad_(True)
    with torch.enable_grad():
        return torch.autograd.grad(reward(measurement, x).sum(), x)[0]


def paper(step: GradientSteps, ec: bool) -> Sampler:
    """phydict_paper in fewer steps, with a likelihood step, and with or without Extra Compute."""
    return replace(METHODS["phydict_paper"], iterations=STEPS, likelihood=step, ec_delta=0.8 if ec else 0.0,
                   ec_steps=EC_STEPS)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("ct", type=Path)
    parser.add_argument("--out", type=Path, default=Path(__file__).with_suffix(".csv"))
    given = parser.parse_args()
    prior, beam = load_prior(), ConeBeam.orbit(4, 1020, 740, (448, 448), 1.25)
    case = load_case(CTFile(given.ct, given.ct.name.split(".")[0]), prior.grid, prior.window)
    seed = case_seed(0, case["id"])
    xrays = Ideal()(Projector(prior.grid, beam, full_detector=True), prior.window.to_mu(case["volume"])[None], seed)[0]
    y, A = fit_to_grid(reconstructor("phydict_paper", prior), prior.grid, xrays, beam)
    measurement = Measurement(A, y, prior.window)

    watched = Watched()
    reconstructor(paper(watched, False), prior).reconstruct(y, A, seed=seed)
    rows = [{"case": case["id"], "part": "gradients", "lpips": weight, "iterations": STEPS, "views": beam.views,
             **{name: float(f"{value:.3g}") for name, value in gradients(watched.seen, weight).items()}}
            for weight in WEIGHTS]
    write_csv(given.out, rows)
    for weight in WEIGHTS:
        for ec in (False, True)[:1 + (weight in WITH_EC)]:
            step = GradientSteps(reward=Reward(lpips=weight, backbone="alex"))
            result = reconstructor(paper(step, ec), prior).reconstruct(y, A, seed=seed)
            scores = case_scores(result.volume, result.misfit, case, prior.grid, prior.window)
            with torch.no_grad():
                views = float(-LPIPS(measurement, prior.window.to_range(result.volume)[None, None]))
            rows.append({"case": case["id"], "part": "result", "lpips": weight, "iterations": STEPS,
                         "views": beam.views, "ec": ec, **{name: scores[name] for name in (
                             "ssim", "psnr", "mae_hu", "ssim_body", "psnr_body", "misfit")}, "lpips_views": views})
            print({k: f"{v:.4g}" if isinstance(v, float) else v for k, v in rows[-1].items()}, flush=True)
            write_csv(given.out, rows)


def gradients(seen: list[dict], weight: float) -> dict[str, float]:
    """Means over the estimates of a run, and the norms' ratio at the first and the last."""
    means = {name: sum(row[name] for row in seen) / len(seen) for name in ("ratio", "cosine", f"turned {weight:g}")}
    return {"norm_ratio": means["ratio"], "norm_ratio_first": seen[0]["ratio"], "norm_ratio_last": seen[-1]["ratio"],
            "cosine": means["cosine"], "turned": means[f"turned {weight:g}"]}


if __name__ == "__main__":
    main()
