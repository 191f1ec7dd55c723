"""Phantoms as a dataset, each built once."""

from __future__ import annotations

from pathlib import Path

import torch
from torch.utils.data import Dataset

from phydict.datasets.case import Case
from phydict.datasets.cts.cache import kept_case, key_of
from phydict.datasets.phantoms.phantom import phantom_case
from phydict.datasets.phantoms.thorax import Thorax, report
from phydict.grid import Grid
from phydict.units import HUWindow

PHANTOM_VERSION = 4
"""Raised whenever a phantom of the same seed comes out differently, so that cached ones are made anew."""

HELD_OUT_PHANTOM = 1_000_000
"""Phantoms with this seed and above are never trained on: the first of them are for tests."""

VALIDATION_PHANTOM = 2_000_000
"""Phantoms with this seed and above validate trainings."""


class CachedPhantoms(Dataset):
    """Phantom cases of consecutive seeds, each built at its first use and stored as a file in `cache`."""

    def __init__(self, first_seed: int, count: int, grid: Grid, window: HUWindow, cache: Path):
        self.first_seed, self.count, self.grid, self.window = first_seed, count, grid, window
        size, cube = "x".join(map(str, grid.shape)), Grid.cube(grid.shape[0], grid.extent[0])
        other = "" if grid.same_as(cube) else f"-{key_of(grid.to_dict())}"
        self.folder = cache / (f"phantoms{PHANTOM_VERSION}-{size}-{grid.spacing[0]:g}mm{other}-{window.low:g}-"
                               f"{window.high:g}")

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, i: int) -> Case:
        seed = self.first_seed + i
        case = kept_case(self.folder / f"{seed:07d}.npz", lambda: phantom_case(seed, self.grid, self.window),
                         ("volume", "masks"))
        return case | {"has_masks": torch.ones(len(case["masks"]), dtype=torch.bool),
                       "report": report(Thorax.draw(seed))}
