"""Reconstruction with Lightning: pairs with infer.py.

predict: X-ray folders -> volumes, or with --dry_run pages that show their geometry, and nothing else.
test: CTs or phantoms -> simulated X-rays -> volumes -> scores.
Each finished case is one folder of the output; a stopped run resumes where it was.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import lightning
from torch import Tensor

from phydict.baselines import Region
from phydict.baselines.extended import covering
from phydict.datasets.case import Case
from phydict.evaluation import CaseMetrics
from phydict.evaluation.fid import Features, PlaneFID
from phydict.grid import Box, Grid
from phydict.inference.case_files import body_interval, write_result
from phydict.inference.data import ReconstructionData
from phydict.inference.orientation import orientation_doubts
from phydict.inference.record import cascade_settings, case_record, grid_settings, method_settings, prior_settings
from phydict.inference.results import CaseResults
from phydict.inference.scoring import Scoring
from phydict.inference.settings import CascadeSettings, Sampling
from phydict.inference.summary import show_finished, summarise
from phydict.inference.voxels import Voxels, in_its_ct
from phydict.methods import DEFAULT_GRID, METHODS, default_method, onto_grid, reconstruct_by, reconstructor
from phydict.page import check_own_page
from phydict.poses import PoseSearch
from phydict.posterior import CascadePosterior, Refined, Sampler
from phydict.prior import MedSynCheckpoint, PriorContract, find_prior, load_super_resolution
from phydict.reconstruction import Reconstruction, Reconstructor
from phydict.runtime.console import TRACEBACK, check_apart, check_writable, noted, sentence
from phydict.runtime.memory import enough_memory
from phydict.runtime.profiling import profiled, stage
from phydict.runtime.progress import CaseProgress
from phydict.runtime.progress_log import log_problem, log_progress
from phydict.runtime.reading import name_of
from phydict.runtime.seeds import case_seed, check_seed
from phydict.runtime.warning import Remark, warn
from phydict.units import HUWindow
from phydict.xray.checks import is_smaller_scene
from phydict.xray.poses.uncertain import Uncertain
from phydict.xray.projectors.own import projector_kind

PREDICTED_VOXELS = 128
"""Along each side of 384 mm, of what phydict_learned predicts: 2.1 to 2.5 times the seconds of its network's 64."""

WIDER = 1.05
"""The factor, of intervals over those that were calibrated, from which on it is warned of."""


class ReconstructionTask(lightning.LightningModule):
    """Reconstructs every case with one method and writes it; in test, scores it against the CT it came from.

    In test the method takes its attenuation of water from the simulator, so that the HU scale fits the spectrum.

    Args:
        method: a Sampler, which is run with the prior, or a Reconstructor; none given: phydict_learned, or
            phydict_fast with a prior that is no refiner, with several samples or with guidance
        name: what tables and folders call the method; none given: the name it was given by, or its class's
        prior: the prior's file, a file or folder of MedSyn's, or the path of a PriorContract's class, read where the
            method is a Sampler; none given: the method's own
        sampling: how the prior is sampled
        super_resolution: a cascade's second stage, which refines what the prior gives
        out: output folder; cases go to <out>/<name>/<case>
        overwrite: do finished cases again; a new result takes the old one's place when it is complete
        seed: the only source of randomness; of each case in predict, as in Python, and by phydict.case_seed in test
        grid: the result's voxels along each side of 384 mm, such as 128, or a box: voxels, side, centre, keep_coarse;
            none given: the prior's own, without a prior 64; in predict, of phydict_learned with its own network, 128
        projector: auto (the fastest that suits the geometry), separable, siddon, eq4, joseph or matrix, or the path of
            a class that is made of a grid and a beam
    """

    def __init__(self, method: Sampler | Reconstructor | None = None, name: str | None = None,
                 prior: PriorContract | str | MedSynCheckpoint | None = None, sampling: Sampling = Sampling(),
                 super_resolution: CascadeSettings = CascadeSettings(), out: str = "runs/reconstructions",
                 overwrite: bool = False, seed: int = 0, grid: int | Box | None = None, projector: str = "auto"):
        super().__init__()
        check_seed(seed)
        if method is None:
            chosen = default_method(prior, sampling.samples, sampling.guidance)
            method, name = METHODS[chosen], name or chosen
        self.predicted, coarse_too = None, grid == Box(keep_coarse=True)
        own_choice = prior is None and (grid is None or coarse_too) and not super_resolution.file
        if own_choice and isinstance(method, Sampler) and method.needs_refiner:
            self.predicted, grid = Box(PREDICTED_VOXELS, keep_coarse=coarse_too), None
        name = type(method).__name__ if name is None else name
        if not name or name.startswith(".") or name != name_of(name):
            raise ValueError("model.name is the name, in UTF-8 and without a dot at its beginning, of one folder "
                             f"inside model.out, but {name!r} was given")
        self.method_name, self.seed, self.pages = name, seed, Path(out) / "dry_run"
        self.projector = projector_kind(projector, "model.projector")
        self.results = CaseResults(Path(out) / name, overwrite)
        check_writable(self.results.folder, "model.out")
        self.settings = method_settings(name, seed, method, self.projector, sampling)
        self.window = HUWindow()
        prior = prior or (str(method.default_prior) if isinstance(method, Sampler) else None)
        self.prior = find_prior(prior) if prior and isinstance(method, Sampler) else None
        if self.prior is not None:
            self.window = self.prior.window
            self.settings |= prior_settings(self.prior, prior, sampling)
        self.super_resolution = None
        if super_resolution.file:
            self.super_resolution = load_super_resolution(super_resolution.file)
            self.super_resolution.memory = int(super_resolution.memory * 2**30)
        guided = super_resolution.guided or self.super_resolution is None
        self.plain = reconstructor(
            method, self.prior, sampling.guidance, name, self.super_resolution, guided, super_resolution.sampler,
            super_resolution.noise_augmentation, sampling.samples, sampling.precision)
        if isinstance(self.plain, CascadePosterior) and super_resolution.file:
            self.settings |= cascade_settings(super_resolution.file, self.plain)
        self._take(Box(grid) if isinstance(grid, int) else grid)
        self.metrics, self.scoring = CaseMetrics([name]), Scoring()
        self.slices: PlaneFID | None = None
        self.with_report = sampling.with_report
        self.progress = CaseProgress()
        self.cases: list[str] = []
        self.profile = self.calibrate = self.warned_of_text = False

    def _take(self, box: Box | None) -> None:
        """Reconstruct on the voxels of a box, if one is given."""
        self.keep_coarse = box is not None and box.keep_coarse
        chosen = None if box is None else box.grid()
        self.voxels = Voxels(self.plain.grid or DEFAULT_GRID, chosen)
        self.reconstructor = onto_grid(self.plain, chosen)
        if chosen is None:
            return
        if self.keep_coarse and not isinstance(self.reconstructor, Refined | Region):
            warn(f"there is no coarse volume to keep: {self.method_name} works on the given voxels directly", Remark)
        self.settings |= grid_settings(chosen, self.plain, self.reconstructor)

    def measure(self, scoring: Scoring) -> None:
        """Take these metrics in test."""
        self.scoring = scoring
        self.slices = PlaneFID(scoring.network.dimensions) if scoring.network else None

    @property
    def reads_no_text(self) -> bool:
        return self.prior is not None and not getattr(self.prior, "reads_text", False)

    @property
    def _data(self) -> ReconstructionData:
        return self.trainer.datamodule  # type: ignore[attr-defined]

    def setup(self, stage: str) -> None:
        data = self._data
        self.settings["data"] = {"with_report": self.with_report} | data.settings(stage)
        if self.calibrate:
            self.settings["calibrate"] = True
        if self.predicted and stage == "predict":
            self._take(self.predicted)
        elif self.predicted and self.predicted.keep_coarse:
            self._take(Box(keep_coarse=True))  # which lacks its voxels
        if stage == "test":
            self.settings |= self.scoring.settings()
            self.voxels = replace(self.voxels, protocol=data.protocol)
            if data.protocol and (fixed := data.protocol.grid):
                data.protocol.check_voxels(self.voxels.box, self.plain.grid is not None)
                self.reconstructor = self.plain if self.plain.grid is None else covering(self.reconstructor, fixed)
                self.voxels = Voxels(self.reconstructor.grid or fixed, None, data.protocol)
            self.scoring.check(self.voxels.scored)
        check_apart(self.results.folder, "model.out", data.inputs(stage))
        check_own_page(self.results.folder.parent, "model.out")

    def scene(self) -> tuple[Grid, HUWindow]:
        """The voxels and the HU range of the CTs that X-rays are made of."""
        return self.voxels.made, self.voxels.window(self.window)

    def is_chest(self, case: Case) -> bool:
        """Whether the X-rays of a case are of a chest, and not of a smaller scene, which no prior takes."""
        return self.plain.grid is not None or not is_smaller_scene(case["beam"], self.voxels.made)

    def unfinished(self, sources: dict[str, str]) -> list[str]:
        """Of this run's cases, id -> what identifies their data, those that remain to be done."""
        self.cases = list(sources)
        coarse = self.keep_coarse and isinstance(self.reconstructor, Refined | Region)
        left = self.results.unfinished(sources, self.settings, coarse)
        if len(left) < len(sources) and self.trainer.is_global_zero:
            kept = len(sources) - len(left)
            log_progress(f"{kept} of {len(sources)} cases are finished already and are kept"
                         + (", so they are not profiled: --model.overwrite true does them again" if self.profile
                            else ""), event="kept", cases=kept, of=len(sources))
        return left

    def predict_step(self, case: Case, index: int = 0) -> None:
        self._attempt(case, self._predict)

    def test_step(self, case: Case, index: int = 0) -> None:
        self._attempt(case, self._test)

    def _predict(self, case: Case) -> None:
        result = self._reconstruct(case, self.seed)
        for doubt in orientation_doubts(case["xrays"], case["beam"], self.voxels.made) if self.is_chest(case) else []:
            warn(doubt)
        self._finish(case, result)

    def _test(self, case: Case) -> None:
        data = self._data
        case["beam"], seed = data.beam, case_seed(self.seed, case["id"])
        grid, window = self.scene()
        with stage("simulate"):
            case["xrays"] = data.simulate(case, seed, grid, window, self.device)
        case["mu_water"] = data.simulator.effective_mu_water
        case, grid = self.voxels.as_scored(case, window), self.voxels.scored
        with stage("metrics"):
            self.scoring.prepare(case, grid)
        result = self._reconstruct(case, seed)
        with stage("metrics"):
            scores, features = self.scoring.measured(result, case, grid, window, self.device, data.protocol)
        self.metrics.update(case["index"], self.method_name, scores, seconds=sum(result.seconds.values()))
        if self.slices is not None and features:
            self.slices.update(case["index"], features)
        result, truth = in_its_ct(result, case, grid, window)
        self._finish(case, result, scores, truth, features)

    def _attempt(self, case: Case, work: Callable[[Case], None]) -> None:
        """Bad input ends the run, or, where there are more cases, this one alone."""
        self.progress.case(case["id"])
        try:
            if "error" in case:
                raise ValueError(case["error"]) from case["error"]
            case["ct_report"], case["report"] = case["report"], self._report(case)
            with (enough_memory(), noted(case["warnings"], case["id"]),
                  profiled() if self.profile else nullcontext() as profile):
                work(case)
            if profile:
                print(f"{case['id']}: {self.method_name}", profile.table(), sep="\n")
        except (ValueError, FloatingPointError, FileNotFoundError) as error:
            if os.environ.get(TRACEBACK):
                raise
            if len(self.cases) == 1:
                raise
            self.progress.finished("not reconstructed")
            log_problem("error", f"{case['id']}: {sentence(error)}")

    def on_test_epoch_end(self) -> None:
        self.log_dict(self.metrics.compute())
        if self.slices is not None:
            self.log_dict({f"{self.method_name}/{name}": value for name, value in self.slices.compute().items()})

    def on_predict_start(self) -> None:
        self._start(int(self.trainer.num_predict_batches[0]))

    def on_test_start(self) -> None:
        self._start(int(self.trainer.num_test_batches[0]))

    def on_predict_end(self) -> None:
        self.trainer.strategy.barrier()

    def on_test_end(self) -> None:
        self.trainer.strategy.barrier()

    def _start(self, cases: int) -> None:
        if isinstance(self.plain, CascadePosterior):
            self.plain.check_memory(self.device)
        steps = self.reconstructor.steps() + (PoseSearch().rounds if self.calibrate else 0)
        self.progress.begin(self.method_name, cases, steps, out=self.results.folder)

    def _report(self, case: Case) -> str:
        """The report of a case where it is used; says once that a prior without text uses none."""
        if not case["report"] or not self.with_report:
            return ""
        if self.reads_no_text and not self.warned_of_text:
            warn("the prior was trained without text: reports are not used")
            self.warned_of_text = True
        return "" if self.reads_no_text else case["report"]

    def _reconstruct(self, case: Case, seed: int) -> Reconstruction:
        ready = self.reconstructor.of_case(case["id"])
        ready = ready.with_mu_water(case["mu_water"]) if "mu_water" in case else ready
        xrays, beam, display = case["xrays"].to(self.device), case["beam"], case.get("display", False)
        uncertain = _uncertain_of(case) if self.calibrate else None
        return reconstruct_by(ready, self.voxels.result, xrays, beam, case["report"], display, seed,
                              self.progress.advance, self.projector, uncertain)

    def _finish(self, case: Case, result: Reconstruction, scores: dict | None = None,
                truth: Tensor | None = None, features: Features | None = None) -> None:
        with stage("write"):
            record = case_record(case, result, self.method_name, self.reconstructor, scores, self.settings, self.device)
            self.results.write(case["id"], record, lambda folder: write_result(
                folder, case, result, self.method_name, truth, self.keep_coarse, features))
        self.progress.finished(_finished_line(result))

    def show_finished(self) -> None:
        """Writes the page of what a stopped run has finished, if that is anything."""
        if self.trainer.is_global_zero:
            show_finished(self.results, self.cases, self.scoring)

    def summarise(self) -> None:
        """Prints and writes the scores of this run's cases. Raises ValueError, naming them, where some have failed."""
        if self.trainer.is_global_zero:
            summarise(self.results, self.cases, self.method_name, self.scoring, self._data.protocol)


def _uncertain_of(case: Case) -> Uncertain:
    """What is uncertain of a case's geometry, where `--calibrate` seeks its poses: what its file says not to know
    exactly; with a warning, of radiographs whose tags are their geometry, what is usual.

    Raises ValueError where a file of other measured ones does not say it.
    """
    if case["uncertain"] is None:
        raise ValueError(f"--calibrate needs to know what {case['description'].source} is not sure of: state "
                         "`uncertain:` there, such as {detector_shift_mm: 5, rotation_degrees: 2}, or leave "
                         "--calibrate out")
    if case["description"].uncertain is None:
        stated = ", ".join(f"{name}: {value:g}" for name, value in vars(case["uncertain"]).items() if value)
        warn(f"the tags do not say how exactly source and detector stood: taken is what is usual where a patient turns "
             f"by hand ({stated}); state `uncertain:` in {case['description'].source.name} for other values")
    return case["uncertain"]


def _finished_line(result: Reconstruction) -> str:
    """What a line tells of a finished case."""
    wider, half_width = result.interval_widening, body_interval(result)
    return (f"{sum(result.seconds.values()):.1f} s, misfit {result.misfit:.4f}"
            + (f", 90 % intervals of ±{half_width:.0f} HU in the body" if half_width is not None else "")
            + (f", intervals {wider:.1f} times as wide as calibrated" if wider >= WIDER else ""))
