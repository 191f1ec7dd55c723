"""Lightning data for training a prior: a user's CTs, phantoms, or both."""

from __future__ import annotations

import math
import signal
from collections.abc import Mapping
from dataclasses import asdict
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Any

import lightning
import torch
from lightning.pytorch.loops.loop import _Loop
from torch.utils.data import ConcatDataset, DataLoader, Dataset, DistributedSampler, Subset

from phydict.datasets import (
    Augmentation,
    CTCases,
    CTFile,
    CTSource,
    Thorax,
    as_one_patient,
    patient_of,
    report,
    split_by_patient,
)
from phydict.datasets.cts.cache import key_of
from phydict.datasets.cts.reading import check_header
from phydict.datasets.phantoms.cached import HELD_OUT_PHANTOM, VALIDATION_PHANTOM, CachedPhantoms
from phydict.datasets.population import DrawnPatients
from phydict.datasets.population.drawn import POPULATION_VERSION
from phydict.grid import Cube, Grid
from phydict.runtime.console import check_writable
from phydict.runtime.files import remove_leftovers
from phydict.runtime.progress_log import log_progress
from phydict.runtime.ranges import check_between
from phydict.runtime.seeds import check_seed
from phydict.runtime.warning import warn
from phydict.training.draws import DRAW_VERSION, Averaged, KeptDraws, MixedCases, averaged, training_parts
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

    made_by: Mapping[str, int | None] = MappingProxyType({})
    """Of the networks that make what is learnt from, where any do, the setting that gives each -> its checksum."""

    def __init__(self, cts: str | None = None, source: CTSource = CTSource(), holdout: HoldOut = HoldOut(),
                 phantoms: int = 2000, loading: Loading = Loading(), cache: str = "runs/cache",
                 augmentation: Augmentation = Augmentation(), seed: int = 0, cube: Cube = Cube(),
                 window: tuple[float, float] = (-1000.0, 1000.0)):
        super().__init__()
        check_seed(seed)
        self.factor = _multiple("simulation_voxels", loading.simulation_voxels, "model.cube.voxels", cube.voxels)
        trained = self.factor * cube.voxels
        self.block = _multiple("draw_voxels", loading.draw_voxels, "the voxels that are trained on", trained)
        if not cts and not phantoms:
            raise ValueError("there is nothing to train on: give data.cts, or data.phantoms above 0")
        check_between("data.phantoms", phantoms, 0, HELD_OUT_PHANTOM)  # those from there on are kept for tests
        if cts and Path(cache).resolve().is_relative_to(Path(cts).resolve()):
            raise ValueError(f"data.cache {cache} lies inside data.cts {cts}: give a folder elsewhere")
        check_writable(Path(cache), "data.cache")
        hu = HUWindow(*window)
        hu.check_air("model.window")
        self.grid, self.window = Grid.cube(trained, cube.side), hu
        self.draw_grid = Grid.cube(self.block * trained, cube.side)
        self.phantoms = CachedPhantoms(0, phantoms, self.draw_grid, hu, Path(cache))
        files = source.find(cts) if cts else []
        held_out = _held_out(files, holdout, seed)
        if len(held_out) == len(files) and not phantoms:
            raise ValueError("there is nothing to train on: data.holdout holds out every CT, and data.phantoms is 0")
        self.held_out = [f.id for f in held_out]
        validating = set(self.held_out)
        self.cts = CTCases([f for f in files if f.id not in validating], cache, self.draw_grid, hu)
        self.population = DrawnPatients(self.cts, loading.population) if loading.population.share else None
        self.held_out_cts, self.headers_checked = CTCases(held_out, cache, self.grid, hu), False
        self.validation: Dataset = ConcatDataset([
            CachedPhantoms(VALIDATION_PHANTOM, holdout.phantoms, self.grid, hu, Path(cache)), self.held_out_cts])
        self.loading, self.seed, self.augmentation, self.cache = loading, seed, augmentation, Path(cache)

    def __getstate__(self) -> dict:
        """What a loader's processes are given where none are forked: all but the trainer."""
        return self.__dict__ | {"trainer": None}

    @cached_property
    def reports(self) -> list[str]:
        """Reports such as the cases to train on have."""
        reports = [ct.report for ct in self.cts.cts if ct.report]
        reports += [report(Thorax.draw(s)) for s in range(min(len(self.phantoms), 1000))]
        return reports + (self.population.reports(1000) if self.population else [])

    def origin(self) -> list:
        """Of which files and of which versions of draws, phantoms and new patients the cases to train on are, as plain
        JSON values: what is stored of them is of other cases where this differs."""
        drawn = [DRAW_VERSION, self.phantoms.folder.name, len(self.phantoms)]
        if self.population:
            drawn += [POPULATION_VERSION, asdict(self.loading.population)]
        return [drawn, *([ct.id, self.cts.key(ct)] for ct in self.cts.cts)]

    def state_dict(self) -> dict:
        return {"held_out": self.held_out, "trained": len(self.cts), "made_by": dict(self.made_by)}

    def load_state_dict(self, state_dict: dict) -> None:
        """Raises ValueError where a training that resumes holds out patients that it did not, trains on those that it
        held out, or learns from what another network makes; warns of CTs that are no longer there, and in validation of
        those that it did not hold out."""
        before = state_dict["held_out"]
        if self.trainer.state.fn != "fit":
            return self.check_unseen(before if state_dict.get("trained", True) else None, "the training")
        patients = {patient_of(id) for id in before}
        now_trained = [ct.id for ct in self.cts.cts if patient_of(ct.id) in patients]
        if changed := sorted([id for id in self.held_out if patient_of(id) not in patients] + now_trained):
            is_now = "held out" if changed[0] in self.held_out else "not held out"
            raise ValueError(f"a training resumes with the CTs held out that were before, but {changed[0]} is {is_now} "
                             "now: give the same data.cts, data.holdout and data.seed, or --data.holdout.ids "
                             "<out>/held_out.txt with data.holdout.fraction 0, or start anew with model.initial")
        if other := [name for name, crc in state_dict.get("made_by", {}).items() if crc != self.made_by[name]]:
            raise ValueError(f"a training resumes with what the same network makes, but {other[0]} is not the one that "
                             "it was before: give that file again, or start anew with another --out")
        if gone := sorted({*before} - {*self.held_out}):
            warn(f"of the {len(before)} CTs that were held out, {len(gone)} are not among the data now (the first is "
                 f"{gone[0]}): the training goes on with the others, whose scores are not those of all")

    def check_unseen(self, before: list[str] | None, training: str) -> None:
        """Warns where a CT is held out that an earlier training did not hold out; None: that is not known."""
        if before is not None and (trained := sorted(set(self.held_out) - set(before))):
            warn(f"{trained[0]} was not among the held-out CTs of {training}: unless it is new, it was trained on, and "
                 "tells nothing of unseen patients; hold out those of that training's held_out.txt by data.holdout.ids")

    def prepare_data(self) -> None:
        if self.trainer.state.fn != "fit":
            return
        for folder in [*self.cache.glob("**")]:
            remove_leftovers(folder)
        self.check_headers()
        self._read_held_out()
        if self.population:
            self.population.prepare()

    def check_headers(self) -> None:
        """Raises ValueError where the header of a CT is not that of one; each is read once."""
        if not self.headers_checked:
            for ct in (*self.cts.cts, *self.held_out_cts.cts):
                check_header(ct.path)
        self.headers_checked = True

    def _read_held_out(self) -> None:
        """Reads, and caches, the CTs that validation will need, so that a damaged one ends no training on its way."""
        limit, held_out = self.trainer.limit_val_batches, self.held_out_cts
        count = min(len(held_out), limit if isinstance(limit, int) else math.ceil(limit * len(held_out)))
        if count:
            log_progress(f"{count} of {len(held_out)} held-out CTs are read before the training begins", event="read",
                         cts=count)
        for _ in DataLoader(Subset(held_out, range(count)), 1, num_workers=self.loading.workers, collate_fn=len):
            pass

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
        draws, fit = self.draws(self.trainer.current_epoch), self.trainer.fit_loop
        epoch: Any = fit.epoch_progress.current
        if fit.restarting and fit.epoch_loop.batch_progress.is_last_batch and epoch.ready == epoch.processed:
            # Where steps are counted, Lightning takes a finished epoch for a part of one, and would continue within it.
            _Loop.restarting.fset(fit, False)  # type: ignore[attr-defined]
        if fit.restarting:  # perhaps within an epoch, whose first batches are done
            length = self.loading.epoch_size
            done = least * (fit.epoch_loop.batch_progress.current.ready % (length // least))
            draws = Subset(draws, [n % length for n in range(done, done + length)])
        turns: DistributedSampler = DistributedSampler(draws, self.trainer.world_size, self.trainer.global_rank,
                                                       shuffle=False, drop_last=True)
        return DataLoader(draws, self.loading.batch_size, sampler=turns, num_workers=self.loading.workers,
                          drop_last=True, collate_fn=self.collate, worker_init_fn=leave_signals)

    def draws(self, epoch: int) -> Dataset:
        """What is trained on in an epoch."""
        if self.population:
            self.population.prepare()  # here, before loader processes are forked
        length, kept = self.loading.epoch_size, self.loading.reuse > 1
        mixed = MixedCases(self.cts, self.phantoms, self.loading.ct_fraction, self.draw_grid, self.window, length,
                           0 if kept else epoch, self.seed, self.augmentation, self.population)
        drawn = Averaged(mixed, self.block) if self.block > 1 else mixed
        return KeptDraws(drawn, self._kept_in(), self.loading.reuse, length, epoch, self.seed) if kept else drawn

    def _kept_in(self) -> Path:
        """The folder of kept draws, another for whatever else decides what they are."""
        parts = [self.origin(), [ct.report for ct in self.cts.cts], asdict(self.augmentation), self.loading.ct_fraction,
                 self.seed, asdict(self.window), self.draw_grid.to_dict(), self.block]
        return self.cache / f"draws-{key_of(parts)}"

    def val_dataloader(self) -> DataLoader:
        limit, cases = self.trainer.limit_val_batches, self.validation
        if isinstance(limit, int):  # which Lightning lets each process take
            cases = Subset(cases, range(min(limit, len(cases))))  # type: ignore[arg-type]
        return DataLoader(cases, 1, num_workers=self.loading.workers, collate_fn=self.collate,
                          worker_init_fn=leave_signals)

    def collate(self, cases: list[dict]) -> dict:
        """A batch of cases in the model's voxels; drawn in finer ones, these are the batch's "fine" volumes, and their
        means over blocks are what is learnt."""
        batch = torch.utils.data.default_collate([training_parts(case) for case in cases])
        return batch if self.factor == 1 else averaged(batch, self.factor) | {"fine": batch["volume"]}


def leave_signals(worker: int) -> None:
    """Has a loader process leave Ctrl-C and SIGTERM, which a terminal or a scheduler sends to every process of a
    training, to the one that trains: it ends the loaders when it ends."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)


def _held_out(files: list[CTFile], holdout: HoldOut, seed: int) -> list[CTFile]:
    """The CTs that validate instead of training. Raises ValueError where a word is in no CT's id, and only warns where
    it is one of many in a file, whose lines also mean the other CTs of the patient that they name."""
    names, patients, words = {f.id for f in files}, {patient_of(f.id) for f in files}, holdout.words()

    def meant(word: str, id: str) -> bool:
        if word in names | patients:
            return word == id if word in names else word == patient_of(id)
        return word in id or (holdout.is_file and patient_of(word) == patient_of(id))

    if unknown := [word for word in words if not any(meant(word, f.id) for f in files)]:
        said = (f"data.holdout.ids names '{unknown[0]}', but no CT has that in its id"
                + (f" (the first id is {files[0].id})" if files else ""))
        if len(unknown) == len(words) or not holdout.is_file:
            raise ValueError(f"{said}: correct or remove it")
        warn(f"{said}: of the {len(words)} lines of {holdout.ids}, {len(unknown)} hold out nothing")
    validating = set(split_by_patient([f.id for f in files], holdout.fraction, seed)[1])
    named = {patient_of(f.id) for f in files if any(meant(word, f.id) for word in words)}
    held_out = [f for f in files if f.id in validating or patient_of(f.id) in named]
    if files and not held_out and holdout.fraction:
        warn(f"no CT is held out, since {holdout.fraction:g} of {len(files)} is none"
             f"{as_one_patient(f.id for f in files)}: give more CTs, or name some by data.holdout.ids")
    return held_out


def check_plain(loading: Loading) -> None:
    """Raises ValueError where draws are requested as only stages that learn from whole cases have them."""
    for name, unlike in (("draw_voxels", loading.draw_voxels is not None), ("reuse", loading.reuse > 1)):
        if unlike:
            raise ValueError(f"this stage makes its draws in its own way, but data.loading.{name} is "
                             f"{getattr(loading, name)}: leave it out")


def _multiple(name: str, voxels: int | None, of: str, base: int) -> int:
    """How many times `base` voxels a setting of data.loading has; 1 where it is not given."""
    factor, rest = divmod(voxels or base, base)
    if rest or factor < 1:
        raise ValueError(f"data.loading.{name} is a multiple of {of}, {base}, but {voxels} was given")
    return factor
