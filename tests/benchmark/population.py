"""How far drawn patients are from the patients they are drawn of and from one another, and what they look like.

    python tests/benchmark/population.py <folder of training CTs> [--hold_out ids] [--draws 24] [--cache runs/cache]

Writes population.csv beside this file, a row per figure with mean, least and most over patients, draws and held-out
patients, and data/pictures/population.jpg, the first twelve draws as coronal and axial sections (-1000 to 400 HU).

    RMSE              in HU over both bodies without tables, on 64^3 voxels of 6 mm, after the best shift by whole
                      voxels, 8 at most
    spread of shape   standard deviation inside the body of the logarithm of the Jacobian of the map to a case from its
                      own patient (draws), or from another patient (patients)
    seconds           of one thread's time
"""

import argparse
import time
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from phydict.datasets import CTCases, find_cts
from phydict.datasets.cts.acquisition import without_table
from phydict.datasets.cts.anatomy import body_mask
from phydict.datasets.population import Anatomy, DrawnPatients, PopulationSettings
from phydict.datasets.population.registration import features, register
from phydict.datasets.population.velocity import jacobian
from phydict.evaluation import write_csv
from phydict.grid import Grid
from phydict.units import HUWindow

GRID, WINDOW, REACH = Grid.cube(64), HUWindow(), 8
ROOT = Path(__file__).parents[2]


class Chest:
    """A case without its table: HU above air (64, 64, 64), its Fourier transform, its body."""

    def __init__(self, case: dict):
        self.hu = without_table(WINDOW.to_hu(case["volume"]), GRID)[0] + 1000
        self.body = torch.from_numpy(body_mask(self.hu.numpy() - 1000, GRID.spacing))
        self.waves = torch.fft.rfftn(self.hu)
        lung = case["masks"][0] > 0.5
        self.sizes = {"lungs L": float(case["masks"][0].sum()) * 0.216e-3}
        for name, axis in (("width of the lungs mm", 0), ("depth of the lungs mm", 1), ("height of the lungs mm", 2)):
            self.sizes[name] = 6.0 * float((lung.sum(tuple({0, 1, 2} - {axis})) > 0).sum())


def rmse(a: Chest, b: Chest) -> float:
    """HU, over both bodies, after the best shift of b."""
    alike = torch.fft.irfftn(a.waves * b.waves.conj(), s=a.hu.shape)
    near = torch.roll(alike, (REACH,) * 3, (0, 1, 2))[(slice(0, 2 * REACH + 1),) * 3]
    shift = [int(i) - REACH for i in np.unravel_index(int(near.argmax()), near.shape)]
    hu, body = (torch.roll(image, shift, (0, 1, 2)) for image in (b.hu, b.body))
    both = a.body | body
    return float((a.hu - hu)[both].square().mean().sqrt())


def spread(points: torch.Tensor, chest: Chest) -> float:
    logs = jacobian(points).clamp(min=1e-3).log()
    return float(logs[chest.body[:-1, :-1, :-1]].std())


def row(figure: str, **values) -> dict:
    """Mean, least and most of each group's values."""
    result = {"figure": figure}
    for group in ("patients", "draws", "held_out"):
        found = values.get(group, [])
        result |= {f"{group}_{name}": round(float(of(found)), 3) if len(found) else ""
                   for name, of in (("mean", np.mean), ("least", np.min), ("most", np.max))}
    return result


def picture(cases: list[dict], file: Path) -> None:
    """Twelve cases, four side by side, each as a coronal and an axial section."""
    tiles = []
    for case in cases:
        hu = ((WINDOW.to_hu(case["volume"][0]).clamp(-1000, 400) + 1000) / 1400 * 255).flip(0)
        both = torch.cat([hu[:, 32].T.flip(0), hu[:, :, 30].T.flip(0)], 1)
        tiles.append(torch.nn.functional.interpolate(both[None, None], scale_factor=2, mode="bilinear")[0, 0])
    rows = [torch.cat(tiles[i:i + 4], 1) for i in range(0, len(tiles), 4)]
    Image.fromarray(torch.cat(rows).clamp(0, 255).byte().numpy()).save(file, quality=88)


def parser() -> argparse.ArgumentParser:
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("cts", help="folder of training CTs")
    arguments.add_argument("--hold_out", nargs="*", default=[], help="ids that are not drawn from")
    arguments.add_argument("--draws", type=int, default=24)
    arguments.add_argument("--cache", type=Path, default=Path("runs/cache"))
    return arguments


if __name__ == "__main__":
    given = parser().parse_args()
    files = find_cts(given.cts)
    cts = CTCases([file for file in files if file.id not in given.hold_out], given.cache, GRID)
    unseen = CTCases([file for file in files if file.id in given.hold_out], given.cache, GRID)
    drawn = DrawnPatients(cts, PopulationSettings(1.0, draws=given.draws))
    drawn.prepare()
    population, count = drawn.population, len(drawn.population.cases)
    start = time.process_time()
    anatomies = [population.draw(seed, drawn.settings.variation) for seed in range(given.draws)]
    made = [population.case(anatomy, seed) for seed, anatomy in enumerate(anatomies)]
    seconds = (time.process_time() - start) / given.draws
    picture(made[:12], ROOT / "data" / "pictures" / "population.jpg")

    patients, draws, held_out = ([Chest(case) for case in cases] for cases in (
        population.cases, made, [unseen[i] for i in range(len(unseen))]))
    among = np.array([[rmse(a, b) for b in patients] for a in patients])
    to_patients = np.array([[rmse(a, b) for b in patients] for a in draws])
    between = np.array([[rmse(a, b) if i != j else np.nan for j, b in enumerate(draws)] for i, a in enumerate(draws)])
    np.fill_diagonal(among, np.nan)
    maps = [population.sources(anatomy) for anatomy in anatomies]
    others = [population.sources(Anatomy((i + 1) % count, Anatomy.of(i, count).weights)) for i in range(count)]
    first, second = (features(population.cases[(population.template + i) % count], GRID, WINDOW) for i in range(2))
    start = time.process_time()
    register(first, second)
    to_register = time.process_time() - start
    rows = [
        row("RMSE to the nearest other patient", patients=np.nanmin(among, 1),
            held_out=[min(rmse(a, b) for b in patients) for a in held_out]),
        row("RMSE to its own patient", draws=[to_patients[i, a.patient] for i, a in enumerate(anatomies)]),
        row("RMSE to the nearest patient", draws=to_patients.min(1)),
        row("RMSE to the nearest other draw", draws=np.nanmin(between, 1),
            held_out=[min(rmse(a, b) for b in draws) for a in held_out]),
        row("RMSE to all others of the kind", patients=np.nanmean(among, 1), draws=np.nanmean(between, 1)),
        row("spread of shape", patients=[spread(points, chest) for points, chest in zip(others, patients)],
            draws=[spread(points, chest) for points, chest in zip(maps, draws)]),
        row("smallest Jacobian", patients=[float(jacobian(points).min()) for points in others],
            draws=[float(jacobian(points).min()) for points in maps]),
        *(row(name, patients=[c.sizes[name] for c in patients], draws=[c.sizes[name] for c in draws],
              held_out=[c.sizes[name] for c in held_out]) for name in patients[0].sizes),
        row("overlap of the lungs after registration", patients=drawn.overlaps),
        row("seconds", patients=[to_register], draws=[seconds])]
    write_csv(Path(__file__).with_suffix(".csv"), rows)
    for line in rows:
        print(*line.values(), sep="\t")
