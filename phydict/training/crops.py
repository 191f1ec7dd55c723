"""Lightning data for training a super-resolution stage: crops of fine CTs and phantoms."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import ConcatDataset, Dataset

from phydict.datasets import CTCases, CTSource, Deformation, load_case, phantom_case
from phydict.datasets.phantoms.cached import VALIDATION_PHANTOM, CachedPhantoms
from phydict.grid import Cube
from phydict.training.data import PriorData, check_plain
from phydict.training.draws import Draws, Items, random_cube
from phydict.training.made import mapped_volume
from phydict.training.settings import Crops, HoldOut, Loading
from phydict.units import AIR, HUWindow

VOLUME_ENDING = ".volume2.npy"
"""Of cached CTs. Its number is raised when CTVolumes changes its result, so that older caches are not read."""


class PhantomVolumes(CachedPhantoms):
    """The CTs alone of CachedPhantoms, as `mapped_volume`s."""

    def __getitem__(self, i: int):
        seed = self.first_seed + i
        return mapped_volume(self.folder / f"{seed:07d}.npy",
                             lambda: phantom_case(seed, self.grid, self.window)["volume"][0])


class CTVolumes(CTCases):
    """The CTs alone of CTCases, as `mapped_volume`s. Raises what `load_case` raises."""

    cache: Path

    def __getitem__(self, index: int):
        ct = self.cts[index]
        return mapped_volume(self.cache / f"{ct.id}-{self.key(ct)}{VOLUME_ENDING}",
                             lambda: load_case(ct, self.grid, self.window)["volume"][0])


class CropDataset(Draws):
    """Random cubes of volumes.

    Each starts at a multiple of `align` voxels. augmented: mirrored left to right half the time, with a small change of
    HU (the super-resolution stage sees too little of the body for a side to matter).
    """

    def __init__(self, cts: Items, phantoms: Items, ct_fraction: float, window: HUWindow, size: int, align: int,
                 length: int, epoch: int, seed: int, augmented: bool = True):
        super().__init__(cts, phantoms, ct_fraction, length, epoch, seed)
        self.window, self.size, self.align, self.augmented = window, size, align, augmented

    def item(self, drawn: np.ndarray, rng: np.random.Generator) -> dict:
        cube = random_cube(drawn, self.size, rng, self.align)
        crop = torch.from_numpy(drawn[cube].astype(np.float32))[None]
        return {"volume": self._augment(crop, rng) if self.augmented else crop}

    def _augment(self, crop: Tensor, rng: np.random.Generator) -> Tensor:
        change = Deformation.draw(int(rng.integers(2**31)))
        crop = self.window.to_range(change.changed_hu(self.window.to_hu(crop).clamp(min=AIR)))
        return crop.flip(1) if rng.random() < 0.5 else crop


class SuperResolutionData(PriorData):
    """Crops for training a super-resolution stage.

    Volumes are cached in half precision without compression, so that a crop is read without the rest: 32 MiB for 256^3.

    Args:
        crops: the cubes
        cts: a NIfTI file, or a folder of any depth in CT-RATE's layout or any other
        source: which CTs of a folder are taken, and what belongs to them
        holdout: what validates instead of training
        phantoms: number of different phantoms
        loading: how cases are drawn
        cache: folder for prepared cases, never inside the CTs' folder
        seed: of the draws and of the split into patients
        cube: tied to model.cube
        window: tied to model.window
    """

    def __init__(self, crops: Crops = Crops(), cts: str | None = None, source: CTSource = CTSource(),
                 holdout: HoldOut = HoldOut(phantoms=2), phantoms: int = 32, loading: Loading = Loading(),
                 cache: str = "runs/cache", seed: int = 0, cube: Cube = Cube(256),
                 window: tuple[float, float] = (-1000.0, 1000.0)):
        if loading.population.share:
            raise ValueError(f"a super-resolution stage learns from CTs and phantoms alone, but "
                             f"data.loading.population.share is {loading.population.share}: set it to 0")
        check_plain(loading)
        super().__init__(cts, source, holdout, phantoms, loading, cache, seed=seed, cube=cube, window=window)
        if self.factor != 1:
            raise ValueError(f"a super-resolution stage learns from volumes of {cube.voxels} voxels alone, but "
                             f"data.loading.simulation_voxels is {loading.simulation_voxels}: leave it out")
        if not 0 < crops.size <= cube.voxels or crops.size % crops.factor:
            raise ValueError(f"data.crops.size is a multiple of the factor {crops.factor}, up to the {cube.voxels} "
                             f"voxels of a volume, but {crops.size} was given")
        self.crops, folder = crops, Path(cache)
        self.phantoms = PhantomVolumes(0, phantoms, self.grid, self.window, folder)
        self.cts = CTVolumes(self.cts.cts, folder, self.grid, self.window)
        self.held_out_cts = CTVolumes(self.held_out_cts.cts, folder, self.grid, self.window)
        self.validation = ConcatDataset([self._fixed([], [], 0)] + [
            self._fixed([], PhantomVolumes(VALIDATION_PHANTOM + i, 1, self.grid, self.window, folder), crops.validation)
            for i in range(holdout.phantoms)] + [
            self._fixed(CTVolumes([ct], folder, self.grid, self.window), [], crops.validation)
            for ct in self.held_out_cts.cts])

    def _fixed(self, cts: Items, phantoms: Items, count: int) -> CropDataset:
        return CropDataset(cts, phantoms, 1.0, self.window, self.crops.size, self.crops.factor, count, 0, 0,
                           augmented=False)

    def draws(self, epoch: int) -> Dataset:
        return CropDataset(self.cts, self.phantoms, self.loading.ct_fraction, self.window, self.crops.size,
                           self.crops.factor, self.loading.epoch_size, epoch, self.seed)
