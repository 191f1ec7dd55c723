"""Runs the trials of a specification on every case, and keeps one row of results for each."""

from __future__ import annotations

import os
import warnings
import zlib
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from pathlib import Path

import numpy as np
import torch
from safetensors import SafetensorError

from phydict.ablation.results import DETAILS, Results, features_file, volume_folder
from phydict.ablation.spec import Specification
from phydict.ablation.trials import Trial, key, prior_of, stage_of
from phydict.baselines.extended import covering
from phydict.datasets.case import Case
from phydict.evaluation.fid import save_features
from phydict.inference.case_files import VOLUME, write_page_files
from phydict.inference.record import versions
from phydict.inference.scoring import Scoring
from phydict.inference.voxels import in_its_ct
from phydict.methods import onto_grid, reconstruct_by, reconstructor
from phydict.posterior import Sampler
from phydict.reconstruction import Reconstruction, save_nifti
from phydict.runtime.console import TRACEBACK, noted, sentence
from phydict.runtime.files import atomic_directory, remove_leftovers
from phydict.runtime.memory import TooLittleMemory
from phydict.runtime.precision import instruction_set
from phydict.runtime.profiling import peak_memory, profiled, reset_peak_memory
from phydict.runtime.progress import CaseProgress
from phydict.runtime.progress_log import log_progress
from phydict.runtime.reading import not_written
from phydict.runtime.seeds import case_seed
from phydict.runtime.strict_json import strict_json

Work = list[tuple[Trial, str, Callable[[], Case]]]
"""Trials of a case, the keys of their rows, and the functions that make the case."""


def planned(specification: Specification, scoring: Scoring) -> tuple[Results, dict[str, Work]]:
    """The table of a specification's rows, with those that its file holds already, and the work of each case, by its
    id. Raises ValueError where the volumes of a trial are too small for a metric."""
    cases_of, rows = {}, {}  # by acquisition; key -> columns
    cases: dict[str, Work] = {}
    for trial in specification.trials:
        scoring.check(trial.voxels.scored)
        if (acquisition := trial.acquisition()) not in cases_of:
            cases_of[acquisition] = trial.data.test_cases(*trial.scene())
        for case, source, make in cases_of[acquisition]:
            name = key(trial, case, source, scoring.settings())
            rows[name] = {"case": case} | trial.columns | trial.scored_columns() | {
                "data": f"d{zlib.crc32(source.encode()):08x}"} | (
                {"training": trial.training} if trial.training else {})
            cases.setdefault(case, []).append((trial, name, make))
    if followed := next(filter(None, (trial.followed for trial in specification.trials)), None):
        log_progress(f"methods without voxels of their own take the {'x'.join(map(str, followed[0].shape))} of "
                     f"{followed[1]}: the setting voxels gives others", event="voxels",
                     voxels=list(followed[0].shape), prior=followed[1])
    return Results(specification.out, rows), cases


def run(results: Results, cases: dict[str, Work], device: torch.device, progress: CaseProgress, scoring: Scoring,
        keep_volumes: bool = False) -> None:
    """Runs what a table lacks of what is `planned`, with the metrics of `scoring`; keep_volumes: each row's volume in a
    folder beside the table, of rows that lack theirs too.

    Case by case; the X-rays of a case are simulated once for all trials that share an acquisition.
    """
    out = results.file.parent
    for folder in (features_file(out, "").parent, volume_folder(out, "")):
        remove_leftovers(folder)
    if scoring.network:
        results.forget(lambda name: not features_file(out, name).is_file())
    if keep_volumes:
        results.forget(lambda name: not volume_folder(out, name).is_dir())
    of = len(results.planned)
    left = sum(not results.finished(name) for name in results.planned)
    log_progress(f"{of - left} of {of} rows are there already, {left} are to be run", event="kept",
                 cases=of - left, of=of)
    if others := len(results.others):
        log_progress(f"{others} rows of other settings or data are kept in {results.file} and left out of tables",
                     event="others", cases=others, out=str(results.file))
    runner = Runner(device, scoring, out, progress, keep_volumes)
    progress.begin("ablate", left, verb="run", out=out, noun="row")
    for case, work in cases.items():
        groups: dict[str, Work] = {}
        made: dict[str, Case] = {}
        for trial, name, make in work:
            if not results.finished(name):
                groups.setdefault(trial.acquisition(), []).append((trial, name, make))
        for group in groups.values():
            first, _, make = group[0]
            scene = _attempt(lambda: MeasuredCase(case, first, _made(case, first, make, made), runner))
            for trial, name, _ in group:
                progress.case(f"{case}: {trial.label}")
                measured = scene if isinstance(scene, dict) else runner.measure(trial, scene, name)
                results.add(name, measured)
                progress.finished(f"{measured['seconds']:.2f} s, {measured['psnr']:.2f} dB"
                                  if measured["status"] == "ok" else f"{measured['status']}: {measured['error']}")
    results.write()


def _made(case: str, trial: Trial, make: Callable[[], Case], kept: dict[str, Case]) -> Case:
    """A case as a trial needs it, with the warnings that making it took; made once, and then `kept`, for each grid, HU
    window and voxels of its simulation."""
    grid, window = trial.scene()
    like = str((grid.to_dict(), window, trial.data.simulation_voxels))
    if like not in kept:
        warned: list[str] = []
        with noted(warned, case):
            kept[like] = make() | {"warnings": warned}
    return kept[like]


class MeasuredCase:
    """One case under one acquisition: X-rays for all methods, and the truth, which no method is shown."""

    def __init__(self, case: str, trial: Trial, made: Case, runner: Runner):
        self.case = case
        (grid, self.window), data = trial.scene(), trial.data
        self.beam, self.mu_water = data.beam, data.simulator.effective_mu_water
        self.warnings = list(made["warnings"])
        self.truth, self.grid = trial.voxels.as_scored(made, self.window), trial.voxels.scored
        runner.scoring.prepare(self.truth, self.grid)
        with noted(self.warnings, case):
            self.xrays = data.simulate(made, case_seed(trial.seed, case), grid, self.window, runner.device)

    def report(self, trial: Trial) -> str:
        """The report, where the trial uses it and its prior reads text."""
        prior = prior_of(trial.prior) if trial.prior else None
        return self.truth["report"] if getattr(prior, "reads_text", False) and trial.with_report else ""


class Runner:
    """Runs trials and measures them; what only a first call costs is spent before the clock runs.

    out: where the features of slices are kept, where the Frechet distance is measured, and volumes if these are."""

    def __init__(self, device: torch.device, scoring: Scoring, out: Path, progress: CaseProgress, keep_volumes: bool):
        self.device, self.scoring, self.out, self.progress, self.warm = device, scoring, out, progress, set[str]()
        self.keep_volumes = keep_volumes

    def measure(self, trial: Trial, scene: MeasuredCase, key: str) -> dict:
        """The measured columns of one trial on one case, the row of `key`."""
        if (state := str(trial.identity() | {"seed": None})) not in self.warm:
            self.warm.add(state)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # the measured run repeats them
                _attempt(lambda: self._warm_up(trial, scene))
        warned = list(scene.warnings)
        with noted(warned, f"{scene.case}, {trial.label}"):
            measured = _attempt(lambda: self._measured(trial, scene, key))
        return measured | {"warning": "; ".join(warned) or None}

    def _warm_up(self, trial: Trial, scene: MeasuredCase) -> None:
        with suppress(WarmUp.Warm):
            self._reconstruct(trial, scene, WarmUp(self.progress.advance))

    def _measured(self, trial: Trial, scene: MeasuredCase, key: str) -> dict:
        known = reset_peak_memory(self.device)
        with profiled(memory=False) as profile:
            result = _attempt(lambda: self._reconstruct(trial, scene, self.progress.advance), "refused")
        if isinstance(result, dict):
            return result
        peak = peak_memory(self.device) if known else None
        seconds = result.seconds | profile.seconds("network", "projector")
        scores, features = self.scoring.measured(result, scene.truth, scene.grid, scene.window, self.device,
                                                 trial.data.protocol)
        try:
            if features:
                save_features(features_file(self.out, key), features)
            if self.keep_volumes:
                _keep(volume_folder(self.out, key), result, scene, trial)
        except (OSError, SafetensorError) as error:
            raise NotKept(not_written(f"what is kept of row {key} in {self.out}", error,
                                      "give another out")) from error
        return scores | {
            "status": "ok", "error": None, "misfit": result.misfit,
            "seconds": sum(result.seconds.values()),
            **{f"seconds_{stage}": value for stage, value in seconds.items()},
            "network_calls": result.network_calls,
            "projector_calls": result.projector_calls or profile.calls("projector"),
            "peak_memory_mb": peak,
            "device": self.device.type, "threads": torch.get_num_threads(), "precision": result.precision,
            "instruction_set": instruction_set(self.device)}

    def _reconstruct(self, trial: Trial, scene: MeasuredCase, on_step: Callable[[], None]) -> Reconstruction:
        seed = case_seed(trial.seed, scene.case)
        torch.manual_seed(seed)
        prior = _on(prior_of, trial.prior, self.device) if isinstance(trial.method, Sampler) else None
        stage = _on(stage_of, trial.super_resolution, self.device) if trial.super_resolution else None
        ready = reconstructor(trial.method, prior, trial.guidance, trial.name, stage, samples=trial.samples,
                              precision=trial.precision)
        ready = onto_grid(ready, trial.box.grid() if trial.box else None, trial.refinement)
        self.progress.follow(ready.steps())
        ready = ready.of_case(scene.case).with_mu_water(scene.mu_water)
        grid = trial.voxels.result
        if trial.fixed:
            ready = covering(ready, trial.fixed)
            grid = ready.grid or grid
        return reconstruct_by(ready, grid, scene.xrays.clone(), scene.beam, scene.report(trial), False, seed, on_step,
                              trial.projector)


def _keep(folder: Path, result: Reconstruction, scene: MeasuredCase, trial: Trial) -> None:
    """Writes a volume, in its place in the CT that it came from, what the page shows of it, and what the table's row
    does not hold."""
    result, truth = in_its_ct(result, scene.truth, scene.grid, scene.window)
    details = {"misfit_per_view": result.misfit_per_view, "grid": result.grid.to_dict(), "report": scene.report(trial),
               "settings": trial.identity(), "versions": versions()}
    with atomic_directory(folder) as partial:
        save_nifti(partial / VOLUME, result.volume.numpy(), result.grid, np.int16)
        write_page_files(partial, result, truth, scene.beam)
        (partial / DETAILS).write_text(strict_json(details))


class NotKept(OSError):
    """What is to be kept of a row could not be written, which is no fault of its method's."""


@cache
def _on(read: Callable, file: str, device: torch.device):
    """What `read` finds in a file, on a device."""
    found = read(file)
    return found.to(device) if isinstance(found, torch.nn.Module) else found


def _attempt(work: Callable[[], object], unwilling: str = "failed"):
    """What `work` gives, or the columns of a row that says why there is nothing; with PHYDICT_TRACEBACK=1 the trace of
    a failure instead. unwilling: the status after a ValueError, unless another machine could do it. Raises NotKept."""
    try:
        return work()
    except NotKept:
        raise
    except Exception as error:  # of whatever kind: one method's failure must not end the others' runs
        if os.environ.get(TRACEBACK):
            raise
        if isinstance(error, ValueError):
            return {"status": "failed" if isinstance(error, TooLittleMemory) else unwilling, "error": sentence(error)}
        if isinstance(error, FloatingPointError):
            return {"status": "diverged", "error": sentence(error)}
        return {"status": "failed", "error": f"{type(error).__name__}: {sentence(error)}"}


class WarmUp:
    """An on_step that ends a reconstruction, by raising Warm, after its second step."""

    class Warm(Exception):
        """The reconstruction has seen all of its code."""

    def __init__(self, on_step: Callable[[], None]):
        self.steps, self.on_step = 0, on_step

    def __call__(self) -> None:
        self.steps += 1
        self.on_step()
        if self.steps == 2:
            raise self.Warm
