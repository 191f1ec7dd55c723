"""One epoch of what is drawn from CTs and phantoms."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np
from torch.utils.data import Dataset

from phydict.datasets.case import Case
from phydict.datasets.cts.augment import Augmentation, augment
from phydict.datasets.population import DrawnPatients
from phydict.grid import Grid
from phydict.units import HUWindow

KEYS = ("volume", "masks", "has_masks", "report")
"""The parts of a Case that training needs."""


class Items(Protocol):
    """A data set of known length, or a list."""

    def __len__(self) -> int: ...

    def __getitem__(self, i: int, /) -> Any: ...


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


def training_parts(case: Mapping) -> dict:
    """A Case without what training does not need."""
    return {key: case[key] for key in KEYS if key in case}
