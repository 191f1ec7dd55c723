"""Reconstruction with Lightning: pairs with infer.py.

predict: X-ray folders -> volumes, or with --dry_run pages that show their geometry, and nothing else.
test: CTs or phantoms -> simulated X-rays -> volumes -> scores.
Each finished case is one folder of the output; a run that was stopped goes on where it was.
"""

from __future__ import annotations

import json
import os
import platform
import resource
import shutil
import sys
import tempfile
import zlib
from contextlib import suppress
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path

import lightning
import torch
from lightning.pytorch.cli import LightningCLI
from rich.console import Console
from torch import Tensor

from phydict.command_line import one_sentence_errors, quiet
from phydict.dry_run import dry_run
from phydict.evaluation import CaseMetrics, markdown, panel, rich_table, volume_metrics, write_csv
from phydict.grid import Grid
from phydict.methods import DEFAULT_PRIOR, fit_to_grid, reconstructor
from phydict.posterior import Sampler
from phydict.prior import load_prior
from phydict.progress import CaseProgress
from phydict.reconstruction_data import ReconstructionData
from phydict.reconstructor import Reconstruction, Reconstructor, describe
from phydict.units import HUWindow

RECORD = "reconstruction.json"
"""The file that marks a case as finished."""


class ReconstructionTask(lightning.LightningModule):
    """Reconstructs every case with one method and writes it; in test, scores it against the CT it came from.

    method: a Sampler (run with the prior) or a Reconstructor; name: what tables call it; prior: the prior's file;
    guidance: classifier-free guidance when a report is given; out: output folder; overwrite: redo finished cases;
    seed: with the case's id, the only source of randomness. In test the method takes its attenuation of water from the
    simulator, so that the HU scale fits the spectrum.
    """

    def __init__(self, method: Sampler | Reconstructor, name: str, prior: str = str(DEFAULT_PRIOR),
                 guidance: float = 2.0, out: str = "runs/reconstructions", overwrite: bool = False, seed: int = 0):
        super().__init__()
        self.method_name, self.folder, self.overwrite, self.seed = name, Path(out) / name, overwrite, seed
        self.pages = Path(out) / "dry_run"
        check_writable(self.folder)
        self.settings = {"name": name, "seed": seed, "method": describe(method)}
        self.grid, self.window = Grid.cube(64), HUWindow()
        if isinstance(method, Sampler):
            self.prior = load_prior(prior)
            self.grid, self.window = self.prior.grid, self.prior.window
            self.settings |= {"prior": Path(prior).name, "prior_crc32": zlib.crc32(Path(prior).read_bytes()),
                              "guidance": guidance}
        self.reconstructor = reconstructor(method, getattr(self, "prior", None), guidance, name)
        self.metrics = CaseMetrics([name])
        self.progress = CaseProgress()

    def setup(self, stage: str) -> None:
        self.settings["data"] = self.trainer.datamodule.settings(stage)

    def pending(self, cases: list[tuple]) -> list[tuple]:
        """The (id, loader) pairs that are not finished yet; a case finished with other settings is an error."""
        if self.overwrite:
            return cases
        for name, _ in cases:
            record = self.folder / name / RECORD
            if record.exists() and json.loads(record.read_text())["settings"] != self._json(self.settings):
                raise ValueError(f"{self.folder / name} was finished with other settings: "
                                 "set model.overwrite to true, or give another model.out")
        left = [case for case in cases if not (self.folder / case[0] / RECORD).exists()]
        if len(left) < len(cases) and self.trainer.is_global_zero:
            print(f"{len(cases) - len(left)} of {len(cases)} cases are finished already and are kept", file=sys.stderr)
        return left

    def predict_step(self, case: dict, _=None) -> None:
        self._finish(case, self._reconstruct(case))

    def test_step(self, case: dict, _=None) -> None:
        case["beam"] = self.trainer.datamodule.beam
        case["xrays"] = self.trainer.datamodule.simulate(case, self._seed(case), self.grid, self.window, self.device)
        case["mu_water"] = self.trainer.datamodule.simulator.effective_mu_water
        result = self._reconstruct(case)
        if "affine" in case:  # back to its place in the CT it came from
            result = replace(result, grid=Grid(self.grid.shape, affine=case["affine"].numpy()))
        truth = self.window.to_hu(case["volume"])[None].cpu()
        lung = case["masks"][None, :1].cpu() if bool(case["has_masks"][0]) else None
        scores = volume_metrics(result.volume[None, None], truth, lung) | {"misfit": result.misfit}
        self.metrics.update(case["index"], self.method_name, scores, seconds=sum(result.seconds.values()))
        self._finish(case, result, scores, truth[0, 0])

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
        self.progress.begin(self.method_name, cases, self.reconstructor.steps())

    def _seed(self, case: dict) -> int:
        return zlib.crc32(f"{self.seed}/{case['id']}".encode())

    def _reconstruct(self, case: dict) -> Reconstruction:
        case["report"] = case["report"] if self.trainer.datamodule.with_report else ""
        xrays, projector = fit_to_grid(self.reconstructor, self.grid, case["xrays"].to(self.device), case["beam"])
        self.progress.case(case["id"])
        ready = self.reconstructor.assuming(case["mu_water"]) if "mu_water" in case else self.reconstructor
        return ready.reconstruct(xrays, projector, case["report"], case.get("display", False), self._seed(case),
                                 self.progress.advance)

    def _finish(self, case: dict, result: Reconstruction, scores: dict | None = None,
                truth: Tensor | None = None) -> None:
        """Writes a case's folder beside its place and moves it there when it is complete."""
        final = self.folder / case["id"]
        partial = self.folder / f".{case['id']}.{os.getpid()}.partial"
        try:
            partial.mkdir(parents=True, exist_ok=True)
            result.save_nifti(partial / "volume.nii.gz")
            panel(partial / "panel.png", result.volume, result.grid, result.xrays, result.reprojection, truth,
                  title=f"{case['id']}: {self.method_name}")
            (partial / RECORD).write_text(json.dumps(self._record(case, result, scores), indent=1))
            while partial.exists():  # another process may have finished the same case, with the same result
                shutil.rmtree(final, ignore_errors=True)
                with suppress(FileExistsError):
                    partial.rename(final)
        except OSError as error:
            raise OSError(f"the case {final} could not be written ({error.strerror or error}): "
                          "free some space, or give another model.out") from error
        finally:
            shutil.rmtree(partial, ignore_errors=True)
        self.progress.finished(f"{sum(result.seconds.values()):.1f} s, misfit {result.misfit:.4f}")

    def _record(self, case: dict, result: Reconstruction, scores: dict | None) -> dict:
        """All that is known of a finished case, as plain JSON values."""
        return {"case": case["id"], "method": self.method_name, "scores": scores, "misfit": result.misfit,
                "misfit_per_view": result.misfit_per_view, "seconds": result.seconds,
                "network_calls": result.network_calls, "projector_calls": result.projector_calls,
                "peak_memory_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
                "mu_water": case.get("mu_water", self.reconstructor.mu_water), "views": len(result.xrays),
                "grid": result.grid.to_dict(), "seed": result.seed,
                "report": case["report"], "settings": self.settings, "versions": versions()}

    def summarise(self) -> list[dict]:
        """Scores of all finished cases; written as results.csv and results.md and printed."""
        rows = []
        for record in sorted(self.folder.glob(f"*/{RECORD}")):
            case = json.loads(record.read_text())
            if case["scores"]:
                rows.append({"case": case["case"], "method": case["method"], "views": case["views"],
                             "grid": "x".join(map(str, case["grid"]["shape"]))} | case["scores"] | {
                                 "seconds": sum(case["seconds"].values()), "network_calls": case["network_calls"],
                                 "projector_calls": case["projector_calls"]})
        if rows:
            write_csv(self.folder / "results.csv", rows)
            (self.folder / "results.md").write_text(markdown(rows))
            console = Console()
            console.width = max(console.width, 80 if console.is_terminal else 120)
            console.print(rich_table(rows))
        return rows

    @staticmethod
    def _json(value: dict) -> dict:
        return json.loads(json.dumps(value))


def check_writable(folder: Path) -> None:
    """Raises ValueError, in one sentence, unless files can be written at `folder` (which need not exist yet)."""
    there = folder.absolute()
    while not there.exists():
        there = there.parent
    try:
        with tempfile.TemporaryFile(dir=there):
            pass
    except OSError as error:
        reason = "is a file" if there.is_file() else f"cannot be written to ({error.strerror})"
        raise ValueError(f"the output folder {folder} cannot be used because {there} {reason}: "
                         "give another model.out") from error


def versions() -> dict[str, str]:
    """Versions of Python and of the packages that a result depends on."""
    return {"python": platform.python_version()} | {
        name: version(name) for name in ("phydict", "torch", "lightning", "monai", "torchmetrics", "numpy")}


class InferenceCLI(LightningCLI):
    """predict and test only; no logs, no checkpoints, gradients allowed inside the steps."""

    @staticmethod
    def subcommands() -> dict[str, set[str]]:
        unused = {"model", "dataloaders", "datamodule", "ckpt_path", "weights_only"}
        return {"predict": unused | {"return_predictions"}, "test": unused | {"verbose"}}

    def _prepare_subcommand_parser(self, klass: type, subcommand: str, **kwargs):
        parser = super()._prepare_subcommand_parser(klass, subcommand, **kwargs)
        if subcommand == "predict":
            parser.add_argument("--dry_run", action="store_true",
                                help="draw the geometry of every case and reconstruct nothing")
        return parser

    @property
    def dry_run(self) -> bool:
        """Whether the geometry is drawn and nothing reconstructed."""
        return bool(self._get(self.config, "dry_run", False))

    def predict(self, model: ReconstructionTask, datamodule: ReconstructionData) -> None:
        """Reconstruct X-rays, or draw their geometry."""
        if self.dry_run:
            for name, load in datamodule.xray_cases():
                print(*dry_run(model.pages / f"{name}.png", load() | {"id": name}, model.grid), sep="\n")
            return
        with model.progress:
            self.trainer.predict(model, datamodule=datamodule, return_predictions=False)

    def test(self, model: ReconstructionTask, datamodule: ReconstructionData) -> None:
        """Simulate the X-rays of CTs, reconstruct and score them."""
        with model.progress:
            self.trainer.test(model, datamodule=datamodule, verbose=False)


def main(args: list[str] | None = None) -> None:
    """Command line of inference: predict, test. A bad input ends in one sentence and exit code 2."""
    with one_sentence_errors(), quiet():
        cli = InferenceCLI(
            ReconstructionTask, ReconstructionData, args=args, seed_everything_default=0, save_config_callback=None,
            parser_kwargs={"exit_on_error": False},
            trainer_defaults={"inference_mode": False, "logger": False, "enable_progress_bar": False,
                              "enable_checkpointing": False, "enable_model_summary": False, "accelerator": "auto",
                              "devices": 1})
        if cli.trainer.is_global_zero:
            if cli.dry_run:
                print(f"pages in {cli.model.pages}")
                return
            cli.model.summarise()
            print(f"results in {cli.model.folder}")
