"""One epoch of what is drawn from CTs and phantoms."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence

import numpy as np
from torch.nn.functional import avg_pool3d
from torch.utils.data import Dataset

from phydict.datasets.cts.augment import Augmentation, augment
from phydict.datasets.population import DrawnPatients
from phydict.grid import Grid
from phydict.units import HUWindow

KEYS = ("volume", "masks", "has_masks", "report")
"""The parts of a Case that training needs, beside the "fine" volume that its X-rays are made of."""


class Draws(Dataset):
    """One epoch of items, each made of a CT or a phantom; item n of epoch e is the same on every machine."""

    def __init__(self, cts: Sequence, phantoms: Sequence, ct_fraction: float, length: int, epoch: int, seed: int):
        self.cts, self.phantoms, self.ct_fraction = cts, phantoms, ct_fraction
        self.length, self.epoch, self.seed = length, epoch, seed

    def __len__(self) -> int:
        return self.length

    def __getitem__(self, i: int) -> dict:
        rng = np.random.default_rng((self.seed, self.epoch, i))
        source = self.source(rng)
        return self.item(source[int(rng.integers(len(source)))], rng)

    def source(self, rng: np.random.Generator) -> Sequence:
        """What the next item is drawn from."""
        from_ct = len(self.phantoms) == 0 or (len(self.cts) > 0 and rng.random() < self.ct_fraction)
        return self.cts if from_ct else self.phantoms

    @abstractmethod
    def item(self, drawn, rng: np.random.Generator) -> dict:
        """What is learnt from of a CT or phantom that was drawn; `rng` decides all else."""


class MixedCases(Draws):
    """Deformed cases on a grid, of which blocks of `factor`^3 voxels are learnt; with a population, its share of the draws
    from CTs is taken from there."""

    def __init__(self, cts: Sequence, phantoms: Sequence, ct_fraction: float, grid: Grid, window: HUWindow,
                 length: int, epoch: int, seed: int, augmentation: Augmentation = Augmentation(),
                 population: DrawnPatients | None = None, factor: int = 1):
        super().__init__(cts, phantoms, ct_fraction, length, epoch, seed)
        self.grid, self.window, self.augmentation, self.population = grid, window, augmentation, population
        self.factor = factor

    def source(self, rng: np.random.Generator) -> Sequence:
        source = super().source(rng)
        if source is not self.cts or self.population is None or rng.random() >= self.population.settings.share:
            return source
        return self.population

    def item(self, drawn: dict, rng: np.random.Generator) -> dict:
        deformed = augment(drawn, int(rng.integers(2**31)), self.grid, self.window, self.augmentation)
        return training_parts(deformed, self.factor)


def training_parts(case: dict, factor: int = 1) -> dict:
    """A Case without what training does not need; where it has finer voxels than are learnt, their means over blocks of
    `factor`^3, beside its own volume as "fine"."""
    parts = {key: case[key] for key in KEYS if key in case}
    if factor == 1:
        return parts
    means = {key: avg_pool3d(parts[key], factor) for key in ("volume", "masks")}
    return parts | means | {"fine": case["volume"]}
