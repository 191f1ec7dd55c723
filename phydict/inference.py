"""Reconstruction with Lightning: pairs with infer.py.

predict: X-ray folders -> volumes, or with --dry_run pages that show their geometry, and nothing else.
test: CTs or phantoms -> simulated X-rays -> volumes -> scores.
Each finished case is one folder of the output; a run that was stopped goes on where it was.
"""

from __future__ import annotations

import os
import platform
import resource
import sys
import warnings
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path

import lightning
from lightning.pytorch.cli import LightningCLI
from lightning.pytorch.utilities.exceptions import MisconfigurationException, SIGTERMException
from rich.console import Console
from torch import Tensor

from phydict.ablation import main as ablate
from phydict.case_results import CaseResults
from phydict.command_line import (
    TRACEBACK, check_apart, check_command, check_configured, check_processes, check_writable, noted,
    one_sentence_errors, quiet, read_configurations, sentence, with_configurations)
from phydict.datasets import load_xrays
from phydict.dry_run import dry_run
from phydict.evaluation import CaseMetrics, panel, rich_table
from phydict.grid import Grid
from phydict.methods import fit_to_grid, reconstructor
from phydict.posterior import CascadePosterior, Sampler
from phydict.precision import instruction_set
from phydict.prior import (
    DEFAULT_PRIOR, MedSynCheckpoint, file_read, fingerprint, load_prior, load_super_resolution)
from phydict.profiling import profiled, stage
from phydict.progress import CaseProgress
from phydict.reading import reading
from phydict.reconstruction_data import ReconstructionData, case_scores
from phydict.reconstructor import Reconstruction, Reconstructor, case_seed, check_seed, describe, save_nifti
from phydict.units import HUWindow

class ReconstructionTask(lightning.LightningModule):
    """Reconstructs every case with one method and writes it; in test, scores it against the CT it came from.

    In test the method takes its attenuation of water from the simulator, so that the HU scale fits the spectrum.

    Args:
        method: a Sampler, which is run with the prior, or a Reconstructor
        name: what tables and folders call the method
        prior: the prior's file, or a file or folder of MedSyn's, read where the method is a Sampler
        guidance: scale of classifier-free guidance when a report is given; 1: none
        super_resolution: file of a cascade's second stage, which refines what the prior gives; none given: none
        guide_fine: whether the X-rays guide the second stage too
        fine_sampler: how they do; none given: the cascade's own
        fine_noise: level in [0, 1] of the noise that the prior's estimate is given before the second stage sees it;
            none given: the stage's own, 0.05, or 0 for MedSyn's
        samples: how many are drawn; of several the volume is the mean, and deviation.nii.gz their standard deviation
        fine_memory: GiB that the second stage's network may take; it works in tiles where the whole takes more, and
            MedSyn's, which cannot, is refused
        precision: of the networks: auto (bfloat16 where the device computes it), float32 or bfloat16
        out: output folder; cases go to <out>/<name>/<case>
        overwrite: do finished cases again; a new result takes the old one's place when it is complete
        seed: the only source of randomness; of each case in predict, as in Python, and by phydict.case_seed in test
        voxels: voxels along each side of the cube, for methods without a prior
        side: side of the cube in mm, for methods without a prior
    """

    def __init__(self, method: Sampler | Reconstructor, name: str,
                 prior: str | MedSynCheckpoint = str(DEFAULT_PRIOR), guidance: float = 1.0,
                 super_resolution: str | MedSynCheckpoint | None = None, guide_fine: bool = True,
                 fine_sampler: Sampler | None = None, fine_noise: float | None = None, fine_memory: float = 4.0,
                 out: str = "runs/reconstructions", overwrite: bool = False, seed: int = 0, voxels: int = 64,
                 side: float = 384.0, samples: int = 1, precision: str = "auto"):
        super().__init__()
        check_seed(seed)
        if name in ("", "..") or name != Path(name).name:
            raise ValueError(f"model.name is the name of one folder inside model.out, but '{name}' was given")
        self.method_name, self.seed, self.pages = name, seed, Path(out) / "dry_run"
        self.results = CaseResults(Path(out) / name, overwrite)
        check_writable(self.results.folder, "model.out")
        self.settings = {"name": name, "seed": seed, "method": describe(method)}
        self.grid, self.window = Grid.cube(voxels, side), HUWindow()
        self.prior = load_prior(prior) if isinstance(method, Sampler) else None
        if self.prior is not None:
            self.grid, self.window = self.prior.grid, self.prior.window
            self.settings |= _identity("prior", prior) | {"guidance": guidance}
            if samples != 1:
                self.settings["samples"] = samples
            if precision != "auto":
                self.settings["precision"] = precision
        self.fine = None
        if super_resolution:
            if not 0 < fine_memory < 2**20:
                raise ValueError(f"model.fine_memory is an amount in GiB, above 0, but {fine_memory:g} was given")
            self.fine = load_super_resolution(super_resolution)
            self.fine.memory = int(fine_memory * 2**30)
            self.grid = self.fine.grid
        self.reconstructor = reconstructor(method, self.prior, guidance, name, self.fine, guide_fine, fine_sampler,
                                           fine_noise, samples, precision)
        if isinstance(self.reconstructor, CascadePosterior):
            self.settings |= _identity("super_resolution", super_resolution) | {
                "fine_noise": self.reconstructor.level, "second": describe(self.reconstructor.second)}
        self.metrics = CaseMetrics([name])
        self.progress = CaseProgress()
        self.cases: list[str] = []
        self.profile = self.said_no_text = False

    @property
    def reads_no_text(self) -> bool:
        return self.prior is not None and self.prior.text is None and self.prior.load_text is None

    def setup(self, stage: str) -> None:
        self.settings["data"] = self.trainer.datamodule.settings(stage)
        check_apart(self.results.folder, "model.out", self.trainer.datamodule.inputs(stage))

    def unfinished(self, sources: dict[str, str]) -> list[str]:
        """Of this run's cases, id -> what identifies their data, those that remain to be done."""
        self.cases = list(sources)
        left = self.results.unfinished(sources, self.settings)
        if len(left) < len(sources) and self.trainer.is_global_zero:
            print(f"{len(sources) - len(left)} of {len(sources)} cases are finished already and are kept"
                  + (", so they are not profiled: --model.overwrite true does them again" if self.profile else ""),
                  file=sys.stderr)
        return left

    def predict_step(self, case: dict, _=None) -> None:
        self._attempt(case, self._predict)

    def test_step(self, case: dict, _=None) -> None:
        self._attempt(case, self._test)

    def _predict(self, case: dict) -> None:
        self._finish(case, self._reconstruct(case, self.seed))

    def _test(self, case: dict) -> None:
        case["beam"], seed = self.trainer.datamodule.beam, case_seed(self.seed, case["id"])
        with stage("simulate"):
            case["xrays"] = self.trainer.datamodule.simulate(case, seed, self.grid, self.window, self.device)
        case["mu_water"] = self.trainer.datamodule.simulator.effective_mu_water
        result = self._reconstruct(case, seed)
        if "affine" in case:  # back to its place in the CT it came from
            result = replace(result, grid=Grid(self.grid.shape, affine=case["affine"].numpy()))
        with stage("metrics"):
            scores = case_scores(result.volume, result.misfit, case, self.window)
        self.metrics.update(case["index"], self.method_name, scores, seconds=sum(result.seconds.values()))
        self._finish(case, result, scores, self.window.to_hu(case["volume"])[0].cpu())

    def _attempt(self, case: dict, work: Callable[[dict], None]) -> None:
        """Bad input ends the run, or, where there are more cases, this one alone; a signal ends it between cases."""
        if self.trainer.received_sigterm:
            raise SIGTERMException
        self.progress.case(case["id"])
        try:
            if "error" in case:
                raise ValueError(case["error"]) from case["error"]
            case["report"] = self._report(case)
            with noted(case["warnings"], case["id"]), profiled() if self.profile else nullcontext() as profile:
                work(case)
            if profile:
                print(f"{case['id']}: {self.method_name}", profile.table(), sep="\n")
        except (ValueError, FloatingPointError) as error:
            if os.environ.get(TRACEBACK):
                raise
            if len(self.cases) == 1:
                raise
            self.progress.finished("not reconstructed")
            print(f"error: {case['id']}: {sentence(error)}", file=sys.stderr)

    def on_test_epoch_end(self) -> None:
        self.log_dict(self.metrics.compute())

    def on_predict_start(self) -> None:
        self._start(self.trainer.num_predict_batches[0])

    def on_test_start(self) -> None:
        self._start(self.trainer.num_test_batches[0])

    def on_predict_end(self) -> None:
        self.trainer.strategy.barrier()

    def on_test_end(self) -> None:
        self.trainer.strategy.barrier()

    def _start(self, cases: int) -> None:
        if isinstance(self.reconstructor, CascadePosterior):
            self.reconstructor.check_memory(self.device)
        self.progress.begin(self.method_name, cases, self.reconstructor.steps())

    def _report(self, case: dict) -> str:
        """The report of a case where it is used; says once that a prior without text uses none."""
        if not case["report"] or not self.trainer.datamodule.with_report:
            return ""
        if self.reads_no_text and not self.said_no_text:
            warnings.warn("the prior was trained without text: reports are not used", stacklevel=2)
            self.said_no_text = True
        return "" if self.reads_no_text else case["report"]

    def _reconstruct(self, case: dict, seed: int) -> Reconstruction:
        with stage("fit to grid"):
            xrays, projector = fit_to_grid(self.reconstructor, self.grid, case["xrays"].to(self.device), case["beam"])
        ready = self.reconstructor.assuming(case["mu_water"]) if "mu_water" in case else self.reconstructor
        return ready.reconstruct(xrays, projector, case["report"], case.get("display", False), seed,
                                 self.progress.advance)

    def _finish(self, case: dict, result: Reconstruction, scores: dict | None = None,
                truth: Tensor | None = None) -> None:
        def write_files(folder: Path) -> None:
            result.save_nifti(folder / "volume.nii.gz")
            if result.deviation is not None:
                save_nifti(folder / "deviation.nii.gz", result.deviation.numpy(), result.grid)
            panel(folder / "panel.png", result.volume, result.grid, result.xrays, result.reprojection, truth,
                  title=f"{case['id']}: {self.method_name}", deviation_hu=result.deviation)

        with stage("write"):
            self.results.write(case["id"], self._record(case, result, scores), write_files)
        self.progress.finished(f"{sum(result.seconds.values()):.1f} s, misfit {result.misfit:.4f}")

    def _record(self, case: dict, result: Reconstruction, scores: dict | None) -> dict:
        """All that is known of a finished case, as plain JSON values."""
        return {"case": case["id"], "method": self.method_name,
                "citation": self.reconstructor.citation, "scores": scores, "misfit": result.misfit,
                "misfit_per_view": result.misfit_per_view, "diverged_at": result.diverged_at, "scatter": result.scatter,
                "seconds": result.seconds, "network_calls": result.network_calls,
                "projector_calls": result.projector_calls,
                "process_peak_memory_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
                "mu_water": case.get("mu_water", self.reconstructor.mu_water), "views": len(result.xrays),
                "precision": result.precision, "instruction_set": instruction_set(self.device),
                "grid": result.grid.to_dict(), "seed": result.seed,
                "warnings": case["warnings"], "report": case["report"], "source": case["source"],
                "settings": self.settings, "versions": versions()}

    def summarise(self) -> None:
        """Prints and writes the scores of this run's cases. Raises ValueError, naming them, where some have failed."""
        missing = self.results.missing()
        rows = self.results.summarise(case for case in self.cases if case not in missing)
        if rows:
            console = Console()
            console.width = max(console.width, 80 if console.is_terminal else 120)
            console.print(rich_table(rows))
        print(f"results in {self.results.folder}")
        if missing:
            raise ValueError(f"{len(missing)} of {len(self.cases)} cases were not reconstructed "
                             f"({', '.join(missing)}): see the messages above, and run the same command again")


def _identity(role: str, prior: str | MedSynCheckpoint) -> dict:
    """What a record tells of a prior: its name, CRC-32 and, where it was chosen from a folder of MedSyn's, its file."""
    file = file_read(prior)
    return {role: Path(prior).name if isinstance(prior, str) else describe(prior),
            f"{role}_crc32": fingerprint(prior)} | ({f"{role}_file": file} if file else {})


def versions() -> dict[str, str]:
    """Versions of Python and of the packages that a result depends on."""
    return {"python": platform.python_version()} | {
        name: version(name) for name in ("phydict", "torch", "lightning", "monai", "torchmetrics", "numpy")}


COMMANDS = {"predict": "X-rays -> volumes", "test": "CTs -> X-rays -> volumes and scores",
            "ablate": "methods compared on the same X-rays"}


class InferenceCLI(LightningCLI):
    """predict and test only; no logs, no checkpoints, gradients allowed inside the steps."""

    @staticmethod
    def subcommands() -> dict[str, set[str]]:
        unused = {"model", "dataloaders", "datamodule", "ckpt_path", "weights_only"}
        return {"predict": unused | {"return_predictions"}, "test": unused | {"verbose"}}

    def _prepare_subcommand_parser(self, klass: type, subcommand: str, **kwargs):
        parser = super()._prepare_subcommand_parser(klass, subcommand, **kwargs)
        parser.add_argument("--profile", action="store_true",
                            help="print the seconds and the peak memory of every stage of each case")
        if subcommand == "predict":
            parser.add_argument("--dry_run", action="store_true",
                                help="draw the geometry of every case and reconstruct nothing")
        return parser

    @property
    def dry_run(self) -> bool:
        """Whether the geometry is drawn and nothing reconstructed."""
        return self._flag("dry_run")

    @property
    def profile(self) -> bool:
        """Whether each case's stages are timed and their memory measured."""
        return self._flag("profile")

    def _flag(self, name: str) -> bool:
        value = self._get(self.config, name, False)
        if not isinstance(value, bool):
            raise ValueError(f"{name} is true or false, but {value!r} was given")
        return value

    def instantiate_trainer(self, **kwargs) -> lightning.Trainer:
        with reading("the settings of trainer", "correct them"):
            made = super().instantiate_trainer(**kwargs)
        check_processes(made.num_devices)
        return made

    def predict(self, model: ReconstructionTask, datamodule: ReconstructionData) -> None:
        """Reconstruct X-rays, or draw their geometry."""
        if self.dry_run:
            check_apart(model.pages, "model.out", datamodule.inputs("predict"))
            self._draw(datamodule.xray_cases(), model, datamodule.geometry)
            return
        model.profile = self.profile
        with model.progress:
            self.trainer.predict(model, datamodule=datamodule, return_predictions=False)

    @staticmethod
    def _draw(folders: dict[str, Path], model: ReconstructionTask, geometry: str | None) -> None:
        """The page of every case, id -> folder. Raises ValueError, naming them, where some cannot be drawn."""
        bad = []
        for name, folder in folders.items():
            try:
                with noted([], name):
                    case = load_xrays(folder, geometry) | {"id": name}
                    print(*dry_run(model.pages / f"{name}.png", case, model.grid), sep="\n")
            except (ValueError, OSError) as error:
                if len(folders) == 1:
                    raise
                bad.append(name)
                print(f"error: {name}: {sentence(error)}", file=sys.stderr)
        print(f"pages in {model.pages}")
        if bad:
            raise ValueError(f"{len(bad)} of {len(folders)} cases cannot be reconstructed ({', '.join(bad)}): see the "
                             "messages above")

    def test(self, model: ReconstructionTask, datamodule: ReconstructionData) -> None:
        """Simulate the X-rays of CTs, reconstruct and score them."""
        model.profile = self.profile
        with model.progress:
            self.trainer.test(model, datamodule=datamodule, verbose=False)


def main(args: list[str] | None = None) -> None:
    """Command line of inference: predict, test, ablate. A bad input ends in one sentence and exit code 2."""
    args = sys.argv[1:] if args is None else args
    if args[:1] == ["ablate"]:
        return ablate(args[1:])
    with one_sentence_errors(MisconfigurationException), quiet():
        check_command(args, COMMANDS, InferenceCLI.subcommands(), "predict -c "
                      "configs/reconstruct/phydict_fast.yaml --data.xrays data/example/xrays")
        check_configured(args, ("--model", "--model.method", "--model.method.class_path"),
                         "configs/reconstruct/phydict_fast.yaml")
        args = with_configurations(args, ("reconstruct", "simulate"))
        read_configurations(args)
        cli = InferenceCLI(
            ReconstructionTask, ReconstructionData, args=args, seed_everything_default=0, save_config_callback=None,
            parser_kwargs={"exit_on_error": False, "allow_abbrev": False, "description": (
                "Reconstruct chest CTs from X-rays. A third subcommand, ablate, compares methods: ablate --help.")},
            trainer_defaults={"inference_mode": False, "logger": False, "enable_progress_bar": False,
                              "enable_checkpointing": False, "enable_model_summary": False, "accelerator": "auto",
                              "devices": 1})
        if cli.trainer.is_global_zero and not cli.dry_run:
            cli.model.summarise()
