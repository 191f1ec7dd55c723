"""How real priors' unconditional samples look: beside CTs as a picture, and by the Frechet distance of slice features.

    python tests/benchmark/samples.py <folder of evaluation CTs> <folder of training CTs> [prior.safetensors ...]
        [--samples 16] [--picture data/pictures/samples.png]

Features: the 30 figures of an axial slice through the lungs that realism.py's classifier sees (shares of HU classes,
steps from voxel to voxel, sizes of body and lung), each divided by its standard deviation over the evaluation CTs.
Distance: Frechet's between normal distributions with the features' means and covariances (Dowson & Landau 1982,
doi:10.1016/0047-259X(82)90077-X), each to the evaluation CTs, none of which a prior has seen; the training CTs' own
distance says how near eight other patients come. Writes samples.csv beside this file, and the picture.
"""

import argparse
from pathlib import Path

import numpy as np
import torch
from realism import GRID, Case, ct, phantom
from scipy.linalg import sqrtm

from phydict import load_prior
from phydict.datasets import find_cts
from phydict.datasets.phantoms.cached import HELD_OUT_PHANTOM
from phydict.evaluation import method_panel, write_csv
from phydict.posterior.samplers.sampler import ddim_sample
from phydict.prior import Prior
from phydict.prior.files import DEFAULT_PRIOR

ITERATIONS = 50


def samples(prior: Prior, count: int) -> list[Case]:
    """Unconditional samples of a prior, with the lung masks that it drew."""
    found, shape = [], (1, prior.state_channels, *prior.grid.shape)
    for seed in range(count):
        noise = torch.randn(shape, generator=torch.Generator().manual_seed(seed))
        x0 = ddim_sample(prior.bind(), noise, ITERATIONS)[0]
        found.append(Case(f"sample {seed}", prior.window.to_hu(x0[0]).numpy(), ((x0[1:] + 1) / 2).numpy()))
    return found


def frechet(a: np.ndarray, b: np.ndarray) -> float:
    """Frechet distance of the normal distributions with the means and covariances of a and b (slices, features)."""
    first, second = np.cov(a.T), np.cov(b.T)
    mixed = sqrtm(first @ second).real
    return float(np.square(a.mean(0) - b.mean(0)).sum() + np.trace(first + second - 2 * mixed))


def features(cases: list[Case]) -> np.ndarray:
    return np.concatenate([case.slices()[1] for case in cases])


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("evaluation")
    parser.add_argument("training")
    parser.add_argument("priors", nargs="*", type=Path, default=[DEFAULT_PRIOR])
    parser.add_argument("--samples", type=int, default=16)
    parser.add_argument("--picture", type=Path)
    given = parser.parse_args()
    drawn = {file.stem: samples(load_prior(file), given.samples) for file in given.priors}
    evaluation, training = ([ct(file) for file in find_cts(folder)] for folder in (given.evaluation, given.training))
    phantoms = [phantom(HELD_OUT_PHANTOM + i) for i in range(given.samples)]
    real = features(evaluation)
    scale = real.std(0) + 1e-6
    rows = []
    for name, cases in ({"training CTs": training, "phantoms": phantoms} | drawn).items():
        own = features(cases)
        rows.append({"cases": name, "number": len(cases), "slices": len(own),
                     "frechet_distance": frechet(own / scale, real / scale)})
    write_csv(Path(__file__).with_suffix(".csv"), rows)
    for row in rows:
        print("{cases:24s} {number:3d} of {slices} slices: {frechet_distance:.2f}".format(**row))
    if given.picture:
        shown = {f"{name}, {case.name}": case.hu for name, cases in drawn.items() for case in cases[:3]}
        shown = {f"CT {case.name}": case.hu for case in evaluation[:3]} | shown
        method_panel(given.picture, shown, None, GRID, title="CTs and unconditional samples")
