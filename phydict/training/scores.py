"""How far a training's estimates and reconstructions are from the CTs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from phydict.evaluation import body_weights, volume_metrics
from phydict.methods import reconstruct
from phydict.posterior import Sampler
from phydict.reconstruction import Reconstructor
from phydict.training.stage import StageTraining
from phydict.xray import ConeBeam, Ideal, Projector
from phydict.xray.binning import benchmark_orbit


def log_error(x0: Tensor, ct: Tensor, body_weight: float) -> Tensor:
    """The logarithms of the mean squared and of the mean absolute error of an estimate of a CT, both (B, 1, X, Y, Z) in
    the prior's range, whose voxels of the body count 1 + body_weight times as much as those of air."""
    weight, error = 1 + body_weight * (ct > -0.9), x0 - ct
    weight = weight / weight.mean()
    return ((weight * error.square()).mean() + 2e-5).log() / 2 + ((weight * error.abs()).mean() + 1e-3).log()


def log_scores(module: StageTraining, batch: dict, index: int, views: Sequence[int],
               method: Sampler | Reconstructor, beam: ConeBeam | None = None) -> None:
    """Logs how well a training's network reconstructs a held-out case from each of these numbers of X-rays, or from
    those of `beam`."""
    scores, seed = [], module.validation_number(index)
    with torch.autocast(module.device.type, enabled=False):
        for count in views:
            view_scores = reconstruction_scores(module.prior, batch["volume"], count, seed, method, beam)
            module.log_case(index, f"val/psnr_{count}", view_scores["psnr"])
            scores.append(view_scores)
    for name in ("psnr", "ssim"):
        mean = float(np.mean([view_scores[name] for view_scores in scores]))
        module.log_case(index, f"val/{name}", mean, prog_bar=name == "psnr")
    module.log("samples", float(module.samples), rank_zero_only=True, batch_size=1)


def reconstruction_scores(prior, ct: Tensor, views: int, seed: int,
                          method: str | Sampler | Reconstructor | None = None,
                          beam: ConeBeam | None = None) -> dict[str, float]:
    """SSIM, PSNR (dB) and MAE (HU), whole and in the body, of a method's reconstruction, without a report, from
    ideal X-rays of a CT (1, 1, X, Y, Z) in the range of `prior`, a Prior, Refiner or Rival, on `beam` or
    `benchmark_orbit`."""
    beam = beam or benchmark_orbit(prior.grid, views)
    exact = Projector(prior.grid, beam, device=ct.device, full_detector=True)
    result = reconstruct(Ideal()(exact, prior.window.to_mu(ct), seed)[0], beam, prior, method, seed=seed,
                        grid=prior.grid)
    truth = prior.window.to_hu(ct)
    return volume_metrics(result.volume[None, None], truth, body=body_weights(truth, prior.grid.spacing))
