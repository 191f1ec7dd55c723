"""Training a prior from the command line: pairs with train.py."""

from __future__ import annotations

import argparse
import math
import reprlib
import sys
from datetime import timedelta
from pathlib import Path

import lightning
import torch
from lightning.pytorch.callbacks import LambdaCallback, ModelCheckpoint, Timer
from lightning.pytorch.cli import LightningCLI
from lightning.pytorch.loggers import CSVLogger
from lightning.pytorch.strategies import DDPStrategy, ModelParallelStrategy
from lightning.pytorch.utilities.exceptions import MisconfigurationException

from phydict.cli.export import export_prior, print_prior
from phydict.cli.help import describe_commands, fit_help
from phydict.cli.progress_cli import ProgressCLI
from phydict.prior import DEFAULT_REFINER
from phydict.runtime.configurations import check_configured, read_configurations, with_configurations
from phydict.runtime.console import (
    check_apart,
    check_command,
    check_writable,
    cli_errors,
    quiet,
)
from phydict.runtime.files import alone_in, atomic_write
from phydict.runtime.help import HelpFormatter
from phydict.runtime.precision import PRECISIONS, resolve_precision, trainer_precision
from phydict.runtime.progress_log import log_progress, progress_as, progress_options, run_command
from phydict.runtime.ranges import check_between
from phydict.training.checkpoints import (
    BEST,
    HELD_OUT,
    RESUMED,
    BestCheckpoint,
    RecentCheckpoint,
    StopBetweenSteps,
    WholeCheckpoints,
    read_checkpoint,
)
from phydict.training.crops import SuperResolutionData
from phydict.training.data import PriorData
from phydict.training.finer_uncertainty import FinerUncertaintyTraining
from phydict.training.prior import PriorTraining
from phydict.training.progress import TrainingProgress
from phydict.training.reconstructions import RefinedResultsData, RefinementData
from phydict.training.refinement import RefinementTraining
from phydict.training.refiner import RefinerTraining
from phydict.training.rivals import LiftedTraining
from phydict.training.rollouts import ReplayTraining, RollOutData
from phydict.training.stage import CHECKPOINT, StageTraining
from phydict.training.super_resolution import SuperResolutionTraining
from phydict.training.throughput import Throughput
from phydict.training.uncertainty import UncertaintyTraining
from phydict.training.x2ct import X2CTTraining
from phydict.training.xray2ctpa import XrayToCTPATraining

COMMANDS = {"fit": "train a prior", "validate": "measure one on held-out cases", "export": "checkpoint -> prior",
            "inspect-prior": "what a file is"}

STAGES = {"base": (PriorTraining, PriorData), "super_resolution": (SuperResolutionTraining, SuperResolutionData),
          "refiner": (RefinerTraining, PriorData), "replay": (ReplayTraining, RollOutData),
          "uncertainty": (UncertaintyTraining, PriorData), "refinement": (RefinementTraining, RefinementData),
          "finer_uncertainty": (FinerUncertaintyTraining, RefinedResultsData),
          "lifted": (LiftedTraining, PriorData), "x2ct": (X2CTTraining, PriorData),
          "xray2ctpa": (XrayToCTPATraining, PriorData)}
"""What trains a stage, and on which data."""

NAMED_CHECKPOINTS = {"last": CHECKPOINT, "best": BEST}
"""Words for --ckpt_path -> files in --out. `fit` begins where `last` is not there yet."""


def stage_of(args: list[str]) -> str:
    """The stage that a command line trains: its --stage, or the `stage` of the last configuration with one."""
    look = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    look.add_argument("--stage")
    given, _ = look.parse_known_args(args)
    stages = [given.stage] if given.stage else []
    stages += [settings["stage"] for settings in reversed(read_configurations(args)) if "stage" in settings]
    stage = stages[0] if stages else "base"
    if not isinstance(stage, str) or stage not in STAGES:
        raise ValueError(f"the stages that can be trained are {', '.join(STAGES)}, but {reprlib.repr(stage)} was "
                         "given")
    return stage


class PriorCLI(ProgressCLI):
    """fit and validate; ties the data's grid and HU window to the model's, and writes everything below `out`."""

    @staticmethod
    def subcommands() -> dict[str, set[str]]:
        return {name: LightningCLI.subcommands()[name] for name in ("fit", "validate")}

    def setup_parser(self, *args) -> None:
        super().setup_parser(*args)
        describe_commands(self.parser, COMMANDS)

    def _prepare_subcommand_parser(self, klass: type, subcommand: str, **kwargs):
        parser = super()._prepare_subcommand_parser(klass, subcommand, **kwargs)
        fit_help(parser, subcommand, COMMANDS[subcommand])
        return parser

    def add_arguments_to_parser(self, parser) -> None:
        parser.add_argument("--out", default="runs/prior", help="folder for checkpoint, logs and samples")
        parser.add_argument("--stage", default="base", choices=list(STAGES), help="what to train")
        parser.add_argument("--precision", default="auto", choices=list(PRECISIONS),
                            help="of the network: bfloat16 where the device computes it faster, else float32 (auto), "
                                 "or one of the two; trainer.precision takes Lightning's own names instead")
        parser.add_lightning_class_args(ModelCheckpoint, "checkpoint")
        parser.set_defaults({"checkpoint.filename": "last", "checkpoint.enable_version_counter": False,
                             "checkpoint.every_n_epochs": 1, "checkpoint.save_on_train_epoch_end": True})
        parser.add_lightning_class_args(RecentCheckpoint, "recent")  # within an epoch that takes longer
        parser.set_defaults({"recent.filename": "last", "recent.enable_version_counter": False,
                             "recent.train_time_interval": timedelta(minutes=10)})
        parser.link_arguments("out", "recent.dirpath")
        parser.add_lightning_class_args(Throughput, "throughput")
        parser.add_lightning_class_args(TrainingProgress, "progress")
        parser.link_arguments("out", "checkpoint.dirpath")
        parser.link_arguments("out", "trainer.default_root_dir")
        for name in ("cube.voxels", "cube.side", "window"):
            parser.link_arguments(f"model.{name}", f"data.{name}")
        if self.model_class is PriorTraining:
            parser.link_arguments("data.reports", "model.text.reports", apply_on="instantiate")
        if self.model_class is ReplayTraining:
            parser.set_defaults({"model.initial": str(DEFAULT_REFINER)})
            parser.link_arguments("model.initial", "data.rollouts.initial")
        if self.model_class is SuperResolutionTraining:
            parser.link_arguments("model.factor", "data.crops.factor")
        else:
            parser.add_lightning_class_args(BestCheckpoint, "best")
            parser.set_defaults({"best.filename": Path(BEST).stem, "best.enable_version_counter": False,
                                 "best.monitor": "val/psnr", "best.mode": "max", "best.save_on_train_epoch_end": False})
            parser.link_arguments("out", "best.dirpath")

    def instantiate_trainer(self, **kwargs) -> lightning.Trainer:
        trainer = self._get(self.config_init, "trainer")
        given = trainer.plugins or []
        plugins = [*(given if isinstance(given, list) else [given]), WholeCheckpoints()]
        logger = CSVLogger(self._get(self.config, "out"), name="logs")
        if str(trainer.precision) in ("16-true", "bf16-true", "64-true", "64"):
            raise ValueError(f"weights are learnt in float32, but trainer.precision is {trainer.precision}: leave it "
                             "out, and give --precision bfloat16 for networks that compute in that")
        if self.subcommand == "fit" and trainer.limit_train_batches == 0:
            raise ValueError("nothing is learnt from no batches, but trainer.limit_train_batches is "
                             f"{trainer.limit_train_batches}: leave it out, or measure by validate")
        for name in ("accumulate_grad_batches", "check_val_every_n_epoch"):
            if (number := getattr(trainer, name)) is not None:
                check_between(f"trainer.{name}", number, 1, math.inf)
        gpu = None if trainer.accelerator == "cpu" else torch.accelerator.current_accelerator(check_available=True)
        device = gpu or torch.device("cpu")
        if trainer.precision is None:
            kwargs["precision"] = trainer_precision(self._get(self.config, "precision"), device)
        elif "bf16" in str(trainer.precision):
            resolve_precision("bfloat16", device)  # warns where that is slow
        made = super().instantiate_trainer(logger=logger, plugins=plugins, **kwargs)
        if isinstance(made.strategy, DDPStrategy):  # several devices, also where no strategy is asked for
            made.strategy._ddp_kwargs.setdefault("find_unused_parameters", True)  # a step may leave parts aside
        return made

    def fit(self, model: StageTraining, datamodule: PriorData, ckpt_path: str | None = None,
            weights_only: bool | None = None) -> None:
        """Train, alone in the folder of the run."""
        out, cts = Path(self.config.fit.out), self.config.fit.data.cts
        check_apart(out, "--out", [Path(cts)] if cts else [])
        self._check_shared_out()
        with alone_in(out, "--out") if self.trainer.is_global_zero else progress_as(quiet=True, json_lines=False):
            last = out / CHECKPOINT
            before = last.is_file() and last.stat().st_mtime_ns
            try:
                self._begin(out, ckpt_path)
                self.trainer.callbacks.append(StopBetweenSteps(last))  # type: ignore[attr-defined]
                if cts:
                    held_out, trained = datamodule.held_out, len(datamodule.cts)
                    phantoms = bool(self.config.fit.data.holdout.phantoms)
                    beside = ", beside phantoms (data.holdout.phantoms)" * phantoms
                    validates = "phantoms alone validate" if phantoms else "nothing validates"
                    log_progress(f"{len(held_out)} of {len(held_out) + trained} CTs are held out for validation{beside}"
                                 if held_out else f"no CT is held out, so that {validates}: data.holdout.ids may name "
                                 "some", event="held_out", cts=held_out)
                self.trainer.fit(model, datamodule=datamodule, ckpt_path=ckpt_path, weights_only=weights_only)
            except BaseException as stop:
                written = last.is_file() and last.stat().st_mtime_ns != before
                stop.add_note(f"add --ckpt_path {last}" if written else
                              "run the same command again: no checkpoint was written, and nothing is kept")
                raise
            left = [timer.time_remaining() for timer in self.trainer.callbacks  # type: ignore[attr-defined]
                    if isinstance(timer, Timer)]
            if any(seconds is not None and seconds <= 0 for seconds in left):
                log_progress(f"trainer.max_time is over after step {self.trainer.global_step}: to go on, give "
                             "--ckpt_path last and a longer one, which counts from the start of the training",
                             event="ended")

    def _check_shared_out(self) -> None:
        """Raises ValueError where a strategy shares the weights out to another number of devices than there are."""
        strategy, devices = self.trainer.strategy, self.trainer.world_size
        if isinstance(strategy, ModelParallelStrategy):
            sizes = strategy._data_parallel_size, strategy._tensor_parallel_size
            if "auto" not in sizes and math.prod(sizes) != devices:
                raise ValueError("trainer.strategy shares the weights out to data_parallel_size x tensor_parallel_size "
                                 f"= {sizes[0]} x {sizes[1]} devices, but this run has {devices}: change one of the "
                                 "two, the strategy's numbers or trainer.devices")

    def _begin(self, out: Path, resumed: str | None) -> None:
        """What comes before the first step, such as the list of the CTs that are held out. Raises ValueError where
        another training's files would be replaced."""
        if resumed and Path(resumed).resolve().parent == out.resolve():
            return
        for name in (CHECKPOINT, BEST):
            if (out / name).exists():
                raise ValueError(f"{out} holds a training already: resume it with --ckpt_path {out / name}, or give "
                                 "another folder with --out")
        held_out = "".join(f"{case}\n" for case in self.datamodule.held_out)
        if held_out and (file := out / HELD_OUT).exists() and file.read_bytes() != held_out.encode():
            raise ValueError(f"{file} is there already and names other cases than this training holds out: move it "
                             "away, or give another folder with --out")
        if resumed:  # the checkpoint may yet refuse what is held out
            listing = LambdaCallback(on_train_start=lambda *_: self._write_held_out(out, held_out))
            self.trainer.callbacks.append(listing)  # type: ignore[attr-defined]
            return
        if self.trainer.is_global_zero:
            self.datamodule.check_headers()
        self._write_held_out(out, held_out)
        self.model.learn_reports()

    def _write_held_out(self, out: Path, held_out: str) -> None:
        if self.trainer.is_global_zero and held_out:
            with atomic_write(out / HELD_OUT) as part:
                part.write_text(held_out, encoding="utf-8")

    def before_validate(self) -> None:
        if not (self.config.validate.ckpt_path or self.config.validate.model.initial):
            raise ValueError("validate needs trained weights: give --ckpt_path, or a prior's file as model.initial")

    def parse_arguments(self, parser, args) -> None:
        super().parse_arguments(parser, args)
        command = self.config.get("subcommand")  # none where nothing is run
        if not command:
            return
        settings = self.config[command]
        check_writable(Path(settings.out), "--out")
        if self.model_class is PriorTraining and settings.data.loading.simulation_voxels is not None:
            raise ValueError("this stage learns from no X-rays, but data.loading.simulation_voxels is "
                             f"{settings.data.loading.simulation_voxels}: leave it out")
        if settings.ckpt_path in NAMED_CHECKPOINTS:
            file = Path(settings.out) / NAMED_CHECKPOINTS[settings.ckpt_path]
            begins = command == "fit" and settings.ckpt_path == "last" and not file.is_file()
            settings.ckpt_path = None if begins else str(file)
        if checkpoint := settings.ckpt_path:
            read = read_checkpoint(checkpoint)
            lacks = [part for part in RESUMED if part not in read]
            if lacks:
                raise ValueError(f"{checkpoint} lacks {', '.join(lacks)}, and cannot be resumed: give the "
                                 "last.ckpt of a training")
            if command == "fit" and 0 <= settings.trainer.max_steps <= read["global_step"]:
                log_progress(f"{checkpoint} is of step {read['global_step']} already, and trainer.max_steps is "
                             f"{settings.trainer.max_steps}: nothing is left to learn", event="ended")


def main(args: list[str] | None = None) -> None:
    """Command line of training: fit, validate, export, inspect-prior. A bad input ends in one sentence and code 2."""
    given = sys.argv[1:] if args is None else args
    with progress_options(given), cli_errors(MisconfigurationException), quiet():
        if given[:1] == ["export"]:
            run_command(export_prior, given[1:], f"{Path(sys.argv[0]).name} export")
        elif given[:1] == ["inspect-prior"]:
            run_command(print_prior, given[1:], f"{Path(sys.argv[0]).name} inspect-prior", positional=True)
        else:
            check_command(given, COMMANDS, PriorCLI.subcommands(), "fit -c configs/prior/phantom.yaml")
            check_configured(given, ("--print_config",), "configs/prior/phantom.yaml")
            given = with_configurations(given, ("prior", "rivals"))
            PriorCLI(*STAGES[stage_of(given)], args=given, seed_everything_default=0,
                     save_config_kwargs={"overwrite": True}, auto_configure_optimizers=False,
                     trainer_defaults={"enable_progress_bar": False, "enable_model_summary": False,
                                       "reload_dataloaders_every_n_epochs": 1},
                     parser_kwargs={"exit_on_error": False, "allow_abbrev": False, "formatter_class": HelpFormatter,
                                    "description": (
                         "Train a prior of chest CT. Two more commands: `export --checkpoint <last.ckpt> --out "
                         "<prior.safetensors>` writes what a training learnt as a prior for reconstruction, and "
                         "`inspect-prior <path>` says what a file or folder is.")})
