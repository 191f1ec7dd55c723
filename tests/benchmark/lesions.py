"""Whether the intervals of phydict_learned hold nodules that it misses, and the truth where it invents one.

    python tests/benchmark/lesions.py <folder of CTs> [--draws 2]

In each draw NODULES balls of 10 to 20 mm, 100 to 800 HU denser than the lung, lie in the lungs of a CT on 64^3 voxels,
50 mm or more apart; K ideal views of it are reconstructed. The contrast of a place is the mean over a ball there less
that over the shell around it. A nodule is missed where the reconstruction shows less than half of its contrast.
Invented is a local maximum of the contrast of balls of 14 mm in the lungs, 50 HU or more, of which the truth has less
than half. Writes lesions.csv beside this file, a row per CT and K: how many are put in, missed and invented; of the
missed and of the invented, how often the true mean over the ball lies within the 90 % interval, averaged over the ball,
of the reconstruction's, and the mean share of the ball's voxels inside; and the share of all lung voxels inside.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from statistics import mean

import numpy as np
from balls import SHELL, nodule
from scipy.ndimage import binary_erosion, maximum_filter
from torch import Tensor
from torch.nn.functional import conv3d

from phydict import Grid, HUWindow, Projector, load_prior, reconstruct
from phydict.datasets import find_cts, prepare_ct
from phydict.evaluation import write_csv
from phydict.prior import DEFAULT_REFINER
from phydict.runtime.seeds import case_seed
from phydict.xray import Ideal
from phydict.xray.binning import benchmark_orbit

WINDOW, GRID = HUWindow(), Grid.cube(64)
NODULES, APART, VIEWS = 5, 50.0, (2, 4, 8)
MISSED, INPUT_CHANNELS = 0.5, 50.0
"""Share of its contrast below which a nodule is missed; HU of contrast from which a blob is taken for one."""
BLOB = 14.0


def places(lung: np.ndarray, random: np.random.Generator) -> list[np.ndarray]:
    """World points (mm) of nodules in the lungs, apart from their edges and from each other."""
    inside = random.permutation(np.argwhere(binary_erosion(lung, iterations=2)))
    chosen: list[np.ndarray] = []
    for index in inside:
        point = GRID.affine[:3, :3] @ index + GRID.affine[:3, 3]
        if all(np.linalg.norm(point - other) >= APART for other in chosen):
            chosen.append(point)
        if len(chosen) == NODULES:
            break
    return chosen


def ball_and_shell(point: np.ndarray, diameter: float) -> tuple[Tensor, Tensor]:
    """Weights (X, Y, Z) that sum to 1."""
    ball = nodule(GRID, point, diameter)
    shell = (nodule(GRID, point, SHELL * diameter + 12) - nodule(GRID, point, diameter + 6)).clamp(min=0)
    return ball / ball.sum(), shell / shell.sum()


def contrast(volume: Tensor, ball: Tensor, shell: Tensor) -> float:
    return float((volume * (ball - shell)).sum())


def contrasts(volume: Tensor) -> Tensor:
    """The contrast (X, Y, Z) of a ball of BLOB mm around every voxel."""
    middle = GRID.affine[:3, :3] @ np.array([32, 32, 32]) + GRID.affine[:3, 3]
    ball, shell = ball_and_shell(middle, BLOB)
    kernel = (ball - shell)[24:41, 24:41, 24:41]
    return conv3d(volume[None, None], kernel[None, None], padding=8)[0, 0]


def held(error: Tensor, width: Tensor, ball: Tensor) -> tuple[bool, float]:
    """Whether the mean error lies within the mean half-width, and the share of the ball's voxels inside."""
    return bool((error * ball).sum().abs() <= (width * ball).sum()), float(((error.abs() <= width) * ball).sum())


def draw(ct, views: int, number: int, refiner) -> dict[str, list]:
    """What became of the nodules of one draw."""
    case, random = prepare_ct(ct.path, GRID, WINDOW, id=ct.id), np.random.default_rng(case_seed(number, ct.id))
    lung, truth = case["masks"][0].numpy() > 0.5, WINDOW.to_hu(case["volume"])[0]
    put = [(point, random.uniform(10, 20), random.uniform(100, 800)) for point in places(lung, random)]
    for point, diameter, denser in put:
        truth = truth + nodule(GRID, point, diameter) * denser
    truth = truth.clamp(WINDOW.low, WINDOW.high)
    beam = benchmark_orbit(GRID, views)
    xrays = Ideal()(Projector(GRID, beam, full_detector=True), WINDOW.to_mu(WINDOW.to_range(truth))[None, None], number)
    result = reconstruct(xrays[0], beam, refiner)
    error, width = result.volume - truth, result.intervals[0.9]
    found: dict[str, list] = {"put": put, "missed": [], "invented": [],
                              "lung": [float((error.abs() <= width)[lung].float().mean())]}
    for point, diameter, _ in put:
        ball, shell = ball_and_shell(point, diameter)
        if contrast(result.volume, ball, shell) < MISSED * contrast(truth, ball, shell):
            found["missed"].append(held(error, width, ball))
    shown, there = contrasts(result.volume), contrasts(truth)
    peaks = (shown.numpy() == maximum_filter(shown.numpy(), 5)) & binary_erosion(lung, iterations=2)
    for index in np.argwhere(peaks & (shown.numpy() >= INPUT_CHANNELS) & (there < MISSED * shown).numpy()):
        point = GRID.affine[:3, :3] @ index + GRID.affine[:3, 3]
        found["invented"].append(held(error, width, ball_and_shell(point, BLOB)[0]))
    return found


def row(ct: str, views: int, draws: list[dict[str, list]]) -> dict:
    """A CT's draws together; "all" for several CTs'."""
    every = {name: [one for each in draws for one in each[name]] for name in draws[0]}
    made: dict = {"case": ct, "method": "phydict_learned", "views": views, "nodules": len(every["put"])}
    for name in ("missed", "invented"):
        made |= {name: len(every[name]),
                 f"{name}_mean_inside": mean(inside for inside, _ in every[name]) if every[name] else None,
                 f"{name}_voxels_inside": mean(share for _, share in every[name]) if every[name] else None}
    return made | {"lung_voxels_inside": mean(every["lung"])}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cts", type=Path)
    parser.add_argument("--draws", type=int, default=2)
    given = parser.parse_args()
    refiner, rows = load_prior(DEFAULT_REFINER), []
    for views in VIEWS:
        every = []
        for ct in find_cts(given.cts):
            every.append([draw(ct, views, number, refiner) for number in range(given.draws)])
            rows.append(row(ct.id, views, every[-1]))
        rows.append(row("all", views, [one for draws in every for one in draws]))
        write_csv(Path(__file__).with_suffix(".csv"), rows)
        print(rows[-1], flush=True)


if __name__ == "__main__":
    main()
