"""What it is worth that a network sees the X-rays: the same network, draws and seconds of training, put to three uses.

    python tests/benchmark/refiner.py <folder of training CTs> [--seconds 600]

(a) a denoiser, steered by phydict_fast; (b) one call that corrects the start of phydict_learned, alone and followed by
its last likelihood step; (c) three calls with likelihood steps between, as phydict_learned is trained. On 32^3 voxels
of 12 mm, each for the same CPU seconds of one thread, the learning rate falling to zero over their second half.
LIDC-IDRI-0004 and CPTAC-LSCC-C3N-00247 are held out. Writes refiner.csv beside this file: PSNR and SSIM on them from
2, 4, 8 and 16 ideal views; tv is the method without a network.
"""

import argparse
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from statistics import mean

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import default_collate

from phydict import reconstruct
from phydict.evaluation import body_weights, volume_metrics, write_csv
from phydict.grid import Cube
from phydict.posterior import Measurement, ProximalCG, Unrolled
from phydict.prior import save_prior
from phydict.training.data import PriorData
from phydict.training.prior import PriorTraining
from phydict.training.refiner import RefinerTraining
from phydict.training.scenes import Scenes
from phydict.training.settings import HoldOut, Loading, Optimisation, PriorOptimisation, TextSettings
from phydict.training.stage import StageTraining
from phydict.xray import Ideal, Projector, binned, binning
from phydict.xray.binning import benchmark_orbit

CUBE, VIEWS, DRAWS, RATE = Cube(32), (2, 4, 8, 16), 300, 1e-3
HELD_OUT = ["LIDC-IDRI-0004", "CPTAC-LSCC-C3N-00247"]
STEP = ProximalCG(10, 3, refit_scatter=True, tv_weight=5.0, tv_eps=0.003)
ONE, THREE = (Unrolled(times, (0.5,) + (0.3,) * len(times), likelihood=STEP, more_times=())
              for times in ((0.35,), (0.35, 0.25, 0.2)))


def train(task: StageTraining, cases: list[dict], batch: int, seconds: float) -> int:
    """Trains for CPU seconds and answers with the number of samples."""
    weights = [w for w in task.parameters() if w.requires_grad]
    optimizer, rng, step, begun = torch.optim.AdamW(weights, RATE, weight_decay=0.01), np.random.default_rng(0), 0, 0.0
    start = time.process_time()
    while (begun := time.process_time() - start) < seconds:
        for group in optimizer.param_groups:
            group["lr"] = RATE * min(1.0, (step + 1) / 30) * min(1.0, 2 - 2 * begun / seconds)
        chosen = default_collate([cases[int(i)] for i in rng.integers(len(cases), size=batch)])
        with torch.autocast("cpu", torch.bfloat16):
            loss = task.batch_loss(chosen, (step,))
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(weights, 1.0)
        optimizer.step()
        step += 1
    task.prior.eval().requires_grad_(False)
    return step * batch


def estimates(task: RefinerTraining, method: Unrolled, xrays: Tensor, beam) -> list[Tensor]:
    """CTs in the prior's range: what each call of the network answers, and the end."""
    grid, factor = task.prior.grid, binning(task.prior.grid, beam)
    projector = Projector(grid, beam.binned(factor), full_detector=True)
    measurement = Measurement(projector, binned(xrays, factor), task.prior.window)
    with torch.no_grad():
        return [x0[:, :1] for x0 in method.estimates(task.prior.bind(), measurement)]


def ways(data: PriorData, seconds: float) -> Iterator[tuple[str, int, Callable]]:
    """Name, training samples, and volume in HU (X, Y, Z) of X-rays and beam, of every use."""
    cases = [data.draws(0)[i] for i in range(DRAWS)]
    denoiser = PriorTraining(text=TextSettings("none"), cube=CUBE, optimisation=PriorOptimisation())
    with tempfile.TemporaryDirectory() as folder:
        save_prior(denoiser.prior, file := Path(folder) / "untrained.safetensors")
        refiners = [RefinerTraining(method, Scenes(most_views=16), CUBE, optimisation=Optimisation(), initial=str(file))
                    for method in (ONE, THREE)]
    chest = torch.stack([torch.cat([case["volume"], 2 * case["masks"] - 1]) for case in cases]).mean(0)
    for refiner in refiners:
        refiner.prior.mean.copy_(chest)
    grid, to_hu = data.grid, data.window.to_hu
    yield "tv", 0, lambda y, beam: reconstruct(y, beam, method="tv", grid=grid).volume
    samples = train(denoiser, cases, 4, seconds)
    yield "(a) denoiser, phydict_fast", samples, lambda y, beam: reconstruct(y, beam, denoiser.prior).volume
    one, three = refiners
    samples = train(one, cases, 1, seconds)
    yield "(b) one call", samples, lambda y, beam: to_hu(estimates(one, ONE, y, beam)[0])[0, 0]
    yield "(b) one call, CG", samples, lambda y, beam: to_hu(estimates(one, ONE, y, beam)[-1])[0, 0]
    samples = train(three, cases, 1, seconds)
    yield "(c) three calls, CG between", samples, lambda y, beam: to_hu(estimates(three, THREE, y, beam)[-1])[0, 0]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cts")
    parser.add_argument("--seconds", type=float, default=600.0)
    given = parser.parse_args()
    torch.set_num_threads(1)
    torch.manual_seed(0)
    rows = []
    with tempfile.TemporaryDirectory() as cache:
        data = PriorData(given.cts, holdout=HoldOut(HELD_OUT, phantoms=0), phantoms=200, cache=cache, cube=CUBE,
                         loading=Loading(epoch_size=DRAWS, ct_fraction=0.7))
        held_out = list(data.validation)
        for name, samples, volume in ways(data, given.seconds):
            for case in held_out:
                ct, truth = case["volume"][None], data.window.to_hu(case["volume"][None])
                body = body_weights(truth, data.grid.spacing)
                for views in VIEWS:
                    beam = benchmark_orbit(data.grid, views)
                    y = Ideal()(Projector(data.grid, beam, full_detector=True), data.window.to_mu(ct), 0)[0]
                    scores = volume_metrics(volume(y, beam)[None, None], truth, body=body)
                    rows.append({"case": case["id"], "method": name, "views": views, "samples": samples,
                                 "seconds_of_training": given.seconds * (samples > 0)} | scores)
            write_csv(Path(__file__).with_suffix(".csv"), rows)
            own = [row for row in rows if row["method"] == name]
            print(name, *(f"K = {k}: {mean(row['psnr'] for row in own if row['views'] == k):.2f} dB" for k in VIEWS),
                  f"{samples} samples", sep=", ", flush=True)
