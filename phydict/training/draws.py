"""One epoch of what is drawn from CTs and phantoms."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from torch.nn.functional import avg_pool3d
from torch.utils.data import Dataset

from phydict.datasets.case import Case
from phydict.datasets.cts.augment import Augmentation, augment
from phydict.datasets.cts.cache import TRAINING_PARTS, kept_case
from phydict.datasets.population import DrawnPatients
from phydict.grid import Grid
from phydict.units import HUWindow

DRAW_VERSION = 2
"""Raised whenever an augmentation, a scene's X-rays or a reconstruction of the same seed comes out differently, so that
draws, roll-outs and reconstructions that are kept are made anew."""

ALL_NEW = 500
"""Draws before any is given again, so that the first steps do not see the same few."""


class Items(Protocol):
    """A data set of known length, or a list."""

    def __len__(self) -> int: ...

    def __getitem__(self, i: int, /) -> Any: ...


def random_cube(volume: np.ndarray, size: int, rng: np.random.Generator, align: int = 1) -> tuple[slice, ...]:
    """Where a cube of `size` voxels lies in a volume (X, Y, Z) in the prior's range; it starts at a multiple of `align`
    voxels. Mere air is drawn again, up to three times."""
    for _ in range(4):
        starts = [align * int(rng.integers((n - size) // align + 1)) for n in volume.shape]
        cube = tuple(slice(start, start + size) for start in starts)
        if torch.from_numpy(volume[cube].astype(np.float32)).std() > 0.05:
            break
    return cube


class Draws(Dataset):
    """One epoch of items, each made of a CT or a phantom; item n of epoch e is the same on every machine."""

    def __init__(self, cts: Items, phantoms: Items, ct_fraction: float, length: int, epoch: int, seed: int):
        self.cts, self.phantoms, self.ct_fraction = cts, phantoms, ct_fraction
        self.length, self.epoch, self.seed = length, epoch, seed

    def __len__(self) -> int:
        return self.length

    def __getitem__(self, i: int) -> dict:
        rng = np.random.default_rng((self.seed, self.epoch, i))
        source = self.source(rng)
        return self.item(source[int(rng.integers(len(source)))], rng)

    def source(self, rng: np.random.Generator) -> Items:
        """What the next item is drawn from."""
        from_ct = len(self.phantoms) == 0 or (len(self.cts) > 0 and rng.random() < self.ct_fraction)
        return self.cts if from_ct else self.phantoms

    @abstractmethod
    def item(self, drawn, rng: np.random.Generator) -> dict:
        """What is learnt from of a CT or phantom that was drawn; `rng` decides all else."""


class MixedCases(Draws):
    """Deformed cases; with a population, its share of the draws from CTs is taken from there."""

    def __init__(self, cts: Items, phantoms: Items, ct_fraction: float, grid: Grid, window: HUWindow,
                 length: int, epoch: int, seed: int, augmentation: Augmentation = Augmentation(),
                 population: DrawnPatients | None = None):
        super().__init__(cts, phantoms, ct_fraction, length, epoch, seed)
        self.grid, self.window, self.augmentation, self.population = grid, window, augmentation, population

    def source(self, rng: np.random.Generator) -> Items:
        source = super().source(rng)
        if source is not self.cts or self.population is None or rng.random() >= self.population.settings.share:
            return source
        return self.population

    def item(self, drawn: Case, rng: np.random.Generator) -> dict:
        return training_parts(augment(drawn, int(rng.integers(2**31)), self.grid, self.window, self.augmentation))


class Averaged(Dataset):
    """Draws with the means of their volumes and masks over blocks of `block`^3 voxels."""

    def __init__(self, drawn: Items, block: int):
        self.drawn, self.block = drawn, block

    def __len__(self) -> int:
        return len(self.drawn)

    def __getitem__(self, i: int) -> dict:
        return averaged(self.drawn[i], self.block)


class KeptDraws(Dataset):
    """Draws that are each made once, kept as a file in `folder`, and given `reuse` times on average: when they are new,
    and then at random between later ones. Item n of epoch e is the same on every machine."""

    def __init__(self, drawn: Items, folder: Path, reuse: int, length: int, epoch: int, seed: int):
        self.drawn, self.folder, self.reuse = drawn, folder, reuse
        self.length, self.epoch, self.seed = length, epoch, seed

    def __len__(self) -> int:
        return self.length

    def __getitem__(self, i: int) -> dict:
        return self.draw(self.number(self.epoch * self.length + i))

    def draw(self, number: int) -> dict:
        """Draw `number`, counted from the training's first."""
        return dict(kept_case(self.folder / f"{number:08d}.npz", lambda: self.drawn[number], TRAINING_PARTS))

    def number(self, item: int) -> int:
        """Which draw the item of this number, over all epochs, is."""
        later = max(item - ALL_NEW, 0)
        newest = min(item, ALL_NEW) + later // self.reuse
        if later % self.reuse == 0:
            return newest
        return int(np.random.default_rng((self.seed, 17, item)).integers(newest + 1))


def averaged(case: Mapping, block: int) -> dict:
    """A Case or a batch of them with the means of volume and masks over blocks of `block`^3 voxels."""
    return dict(case) | {key: avg_pool3d(case[key], block) for key in ("volume", "masks")}


def training_parts(case: Mapping) -> dict:
    """A Case without what training does not need."""
    return {key: case[key] for key in TRAINING_PARTS if key in case}
