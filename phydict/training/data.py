"""Lightning data for training a prior: a user's CTs, phantoms, or both."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import lightning
import torch
from torch.nn.functional import avg_pool3d
from torch.utils.data import ConcatDataset, DataLoader, Dataset, DistributedSampler

from phydict.datasets import (
    Augmentation,
    CTCases,
    CTSource,
    Thorax,
    as_one_patient,
    patient_of,
    report,
    split_by_patient,
)
from phydict.datasets.phantoms.cached import HELD_OUT_PHANTOM, CachedPhantoms
from phydict.datasets.population import DrawnPatients
from phydict.datasets.population.drawn import POPULATION_VERSION
from phydict.grid import Cube, Grid
from phydict.runtime.console import check_writable
from phydict.runtime.seeds import check_seed
from phydict.runtime.warning import warn
from phydict.training.draws import MixedCases, training_parts
from phydict.training.settings import HoldOut, Loading
from phydict.units import HUWindow


class PriorData(lightning.LightningDataModule):
    """Cases for training a prior.

    Args:
        cts: a NIfTI file, or a folder of any depth in CT-RATE's layout or any other
        source: which CTs of a folder are taken, and what belongs to them
        holdout: what validates instead of training
        phantoms: number of different phantoms
        loading: how cases are drawn
        cache: folder for prepared cases, never inside the CTs' folder
        augmentation: strengths of the random changes of each draw
        seed: of the draws and of the split into patients
        cube: tied to model.cube
        window: tied to model.window
    """

    trainer: lightning.Trainer

    def __init__(self, cts: str | None = None, source: CTSource = CTSource(), holdout: HoldOut = HoldOut(),
                 phantoms: int = 2000, loading: Loading = Loading(), cache: str = "runs/cache",
                 augmentation: Augmentation = Augmentation(), seed: int = 0, cube: Cube = Cube(),
                 window: tuple[float, float] = (-1000.0, 1000.0)):
        super().__init__()
        check_seed(seed)
        self.factor, rest = divmod(loading.simulation_voxels or cube.voxels, cube.voxels)
        if rest or self.factor < 1:
            raise ValueError(f"data.loading.simulation_voxels is a multiple of model.cube.voxels, {cube.voxels}, but "
                             f"{loading.simulation_voxels} was given")
        if not cts and not phantoms:
            raise ValueError("there is nothing to train on: give data.cts, or data.phantoms above 0")
        if phantoms < 0:
            raise ValueError(f"data.phantoms must not be negative, but {phantoms} was given")
        if cts and Path(cache).resolve().is_relative_to(Path(cts).resolve()):
            raise ValueError(f"data.cache {cache} lies inside data.cts {cts}: give a folder elsewhere")
        check_writable(Path(cache), "data.cache")
        hu = HUWindow(*window)
        self.grid, self.window = Grid.cube(self.factor * cube.voxels, cube.side), hu
        self.phantoms = CachedPhantoms(0, phantoms, self.grid, hu, Path(cache))
        files = source.find(cts) if cts else []
        for word in holdout.ids or []:
            if not any(word in f.id for f in files):
                raise ValueError(f"data.holdout.ids names '{word}', but no CT has that in its id"
                                 + (f" (the first id is {files[0].id})" if files else "") + ": correct or remove it")
        validating = set(split_by_patient([f.id for f in files], holdout.fraction, seed)[1])
        named = {patient_of(f.id) for f in files if any(word in f.id for word in holdout.ids or [])}
        held_out = [f for f in files if f.id in validating or patient_of(f.id) in named]
        if len(held_out) == len(files) and not phantoms:
            raise ValueError("there is nothing to train on: data.holdout holds out every CT, and data.phantoms is 0")
        if files and not held_out and holdout.fraction:
            warn(f"no CT is held out, since {holdout.fraction:g} of {len(files)} is none"
                 f"{as_one_patient(f.id for f in files)}: give more CTs, or name some by data.holdout.ids")
        self.held_out = [f.id for f in held_out]
        validating = set(self.held_out)
        self.cts = CTCases([f for f in files if f.id not in validating], cache, self.grid, hu)
        self.population = DrawnPatients(self.cts, loading.population) if loading.population.share else None
        self.held_out_cts = CTCases(held_out, cache, self.grid, hu)
        self.validation: Dataset = ConcatDataset([
            CachedPhantoms(HELD_OUT_PHANTOM, holdout.phantoms, self.grid, hu, Path(cache)), self.held_out_cts])
        self.reports = [f.report for f in files if f.report and f.id not in validating]
        self.reports += [report(Thorax.draw(s)) for s in range(min(phantoms, 1000))]
        self.reports += self.population.reports(1000) if self.population else []
        self.loading, self.seed, self.augmentation = loading, seed, augmentation

    def origin(self) -> list:
        """Of which files and of which versions of phantoms and new patients the cases to train on are, as plain JSON
        values: what is stored of them is of other cases where this differs."""
        drawn = [self.phantoms.folder.name, len(self.phantoms)]
        if self.population:
            drawn += [POPULATION_VERSION, asdict(self.loading.population)]
        return [drawn, *([ct.id, self.cts.key(ct)] for ct in self.cts.cts)]

    def prepare_data(self) -> None:
        if self.population and self.trainer.state.fn == "fit":
            self.population.prepare()

    def train_dataloader(self) -> DataLoader:
        every = self.trainer.reload_dataloaders_every_n_epochs  # type: ignore[attr-defined]
        if every != 1:
            raise ValueError("each epoch has draws of its own, so that trainer.reload_dataloaders_every_n_epochs must "
                             f"be 1, but {every} was given: leave it out, or set it to 1 on a Trainer of your own")
        least = self.loading.batch_size * self.trainer.world_size
        if self.loading.epoch_size < least:
            raise ValueError(f"data.loading.epoch_size is {self.loading.epoch_size}, less than one batch on every "
                             f"device ({least}): raise it, or lower data.loading.batch_size")
        # Lightning's own sampler would shuffle: several processes take turns, so that each step sees what one would.
        draws = self.draws(self.trainer.current_epoch)
        turns: DistributedSampler = DistributedSampler(draws, self.trainer.world_size, self.trainer.global_rank,
                                                       shuffle=False)
        return DataLoader(draws, self.loading.batch_size, sampler=turns, num_workers=self.loading.workers,
                          drop_last=True, collate_fn=self.collate)

    def draws(self, epoch: int) -> Dataset:
        """What is trained on in an epoch."""
        if self.population:
            self.population.prepare()  # here, before loader processes are forked
        return MixedCases(self.cts, self.phantoms, self.loading.ct_fraction, self.grid, self.window,
                          self.loading.epoch_size, epoch, self.seed, self.augmentation, self.population)

    def val_dataloader(self) -> DataLoader:
        return DataLoader(self.validation, 1, num_workers=self.loading.workers, collate_fn=self.collate)

    def collate(self, cases: list[dict]) -> dict:
        """A batch of cases in the model's voxels; drawn in finer ones, these are the batch's "fine" volumes, and their
        means over blocks are what is learnt."""
        batch = torch.utils.data.default_collate([training_parts(case) for case in cases])
        if self.factor == 1:
            return batch
        means = {key: avg_pool3d(batch[key], self.factor) for key in ("volume", "masks")}
        return batch | means | {"fine": batch["volume"]}
