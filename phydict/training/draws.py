"""Draws: one epoch of deformed cases."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from torch.utils.data import Dataset

from phydict.datasets.cts.augment import Augmentation, augment
from phydict.grid import Grid
from phydict.units import HUWindow

KEYS = ("volume", "masks", "has_masks", "report")
"""The parts of a Case that training needs."""


class MixedCases(Dataset):
    """One epoch of deformed draws from CTs and phantoms; draw n of epoch e is the same on every machine."""

    def __init__(self, cts: Sequence, phantoms: Sequence, ct_fraction: float, grid: Grid, window: HUWindow,
                 length: int, epoch: int, seed: int, augmentation: Augmentation = Augmentation()):
        self.cts, self.phantoms, self.ct_fraction, self.grid, self.window = cts, phantoms, ct_fraction, grid, window
        self.length, self.epoch, self.seed, self.augmentation = length, epoch, seed, augmentation

    def __len__(self) -> int:
        return self.length

    def __getitem__(self, i: int) -> dict:
        draw = np.random.default_rng((self.seed, self.epoch, i))
        from_ct = len(self.phantoms) == 0 or (len(self.cts) > 0 and draw.random() < self.ct_fraction)
        source = self.cts if from_ct else self.phantoms
        case = source[int(draw.integers(len(source)))]
        return _training_parts(augment(case, int(draw.integers(2**31)), self.grid, self.window, self.augmentation))


def _training_parts(case: dict) -> dict:
    return {key: case[key] for key in KEYS if key in case}
