"""The command line of reconstruction: pairs with infer.py."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from pathlib import Path

from lightning.pytorch.utilities.exceptions import MisconfigurationException

from phydict.ablation import main as ablate
from phydict.cli.help import describe_commands, method_help, predict_help
from phydict.cli.page import main as page
from phydict.cli.progress_cli import ProgressCLI
from phydict.datasets.radiographs.radiographs import load_xrays
from phydict.inference.data import ReconstructionData
from phydict.inference.dry_run import dry_run
from phydict.inference.scoring import METRICS, CLIPSettings, FIDSettings, Scoring
from phydict.inference.settings import WITHOUT_STAGE
from phydict.inference.task import ReconstructionTask
from phydict.methods import METHODS
from phydict.runtime.configurations import (
    CONFIGURATION,
    inline_configuration,
    is_yaml,
    read_configuration,
    split_configurations,
    valued,
)
from phydict.runtime.console import (
    check_apart,
    check_command,
    cli_errors,
    ended_by_sigterm,
    noted,
    quiet,
    sentence,
)
from phydict.runtime.help import HelpFormatter
from phydict.runtime.progress_log import log_problem, progress_options
from phydict.runtime.shipped import configuration

COMMANDS = {"predict": "X-rays -> volumes", "test": "CTs -> X-rays -> volumes and scores",
            "ablate": "methods compared on the same X-rays", "page": "results -> a page for the browser"}


class InferenceCLI(ProgressCLI):
    """predict and test only; no logs, no checkpoints, gradients allowed inside the steps."""

    def setup_parser(self, *args) -> None:
        super().setup_parser(*args)
        describe_commands(self.parser, COMMANDS)

    @staticmethod
    def subcommands() -> dict[str, set[str]]:
        unused = {"model", "dataloaders", "datamodule", "ckpt_path", "weights_only"}
        return {"predict": unused | {"return_predictions"}, "test": unused | {"verbose"}}

    def _prepare_subcommand_parser(self, klass: type, subcommand: str, **kwargs):
        parser = super()._prepare_subcommand_parser(klass, subcommand, **kwargs)
        parser.add_argument("--profile", action="store_true",
                            help="print the seconds and the peak memory of every stage of each case")
        if subcommand == "predict":
            parser.add_argument("--calibrate", action="store_true",
                                help="find first what the geometry file states as uncertain: poses, gains and offsets")
            parser.add_argument("--dry_run", action="store_true",
                                help="draw the geometry of every case and reconstruct nothing")
        if subcommand == "test":
            parser.add_argument("--metrics", type=list[str], default=["volume"],
                                help=f"what is measured, of {', '.join(METRICS)}; volume always is")
            parser.add_class_arguments(FIDSettings, "fid")
            parser.add_class_arguments(CLIPSettings, "clip")
        predict_help(parser, subcommand, COMMANDS[subcommand])
        return parser

    def parse_arguments(self, parser, args) -> None:
        args = with_methods(args)
        if "-h" in args or "--help" in args:
            for subparser in self._subcommand_parsers.values():
                method_help(subparser, args)
        super().parse_arguments(parser, args)
        given = [value for name, value in zip(args, [*args[1:], ""]) if name == "--model.prior"]
        given += [arg.partition("=")[2] for arg in args if arg.startswith("--model.prior=")]
        settings = self.config.get(str(self.config.get("subcommand")), self.config)
        chosen = settings.get("model.prior")
        if given and Path(given[-1]).is_file() and chosen is None:  # its content was read, as a null
            raise ValueError(f"the prior {given[-1]} is empty: give the .safetensors file that training wrote")
        guided = any(arg.partition("=")[0] == "--model.super_resolution.guided" for arg in args)
        if guided and not settings.get("model.super_resolution.file"):  # a configuration says so of any stage
            raise ValueError(WITHOUT_STAGE.format("guided"))

    @property
    def dry_run(self) -> bool:
        """Whether the geometry is drawn and nothing reconstructed."""
        return self.flag("dry_run")

    def predict(self, model: ReconstructionTask, datamodule: ReconstructionData) -> None:
        """Reconstruct X-rays, or draw their geometry."""
        if self.dry_run:
            check_apart(model.pages, "model.out", datamodule.inputs("predict"))
            self._draw(datamodule.xray_cases(), model, datamodule.geometry_file)
            return
        model.profile, model.calibrate = self.flag("profile"), self.flag("calibrate")
        with _resumable(model):
            self.trainer.predict(model, datamodule=datamodule, return_predictions=False)

    @staticmethod
    def _draw(folders: dict[str, Path], model: ReconstructionTask, geometry: Path | None) -> None:
        """The page of every case, id -> folder. Raises ValueError, naming them, where some cannot be drawn."""
        bad = []
        for name, folder in folders.items():
            try:
                with noted([], name):
                    case = load_xrays(folder, geometry) | {"id": name}
                    print(*dry_run(model.pages / f"{name}.png", case, model.voxels.made, model.voxels.result,
                                   model.is_chest(case)), sep="\n")
            except (ValueError, OSError) as error:
                if len(folders) == 1:
                    raise
                bad.append(name)
                log_problem("error", f"{name}: {sentence(error)}")
        print(f"pages in {model.pages}")
        if bad:
            raise ValueError(f"{len(bad)} of {len(folders)} cases cannot be reconstructed ({', '.join(bad)}): see the "
                             "messages above")

    def test(self, model: ReconstructionTask, datamodule: ReconstructionData) -> None:
        """Simulate the X-rays of CTs, reconstruct and score them."""
        model.profile = self.flag("profile")
        model.measure(Scoring(self._get(self.config, "metrics"), self._get(self.config_init, "fid"),
                              self._get(self.config_init, "clip")))
        with _resumable(model):
            self.trainer.test(model, datamodule=datamodule, verbose=False)


@contextmanager
def _resumable(model: ReconstructionTask) -> Iterator[None]:
    """The progress of a run and what it ends with; where it is stopped, shows what is finished and says how it is
    resumed."""
    try:
        with ended_by_sigterm(), model.progress:
            yield
    except BaseException as stop:
        if isinstance(stop, KeyboardInterrupt | SystemExit):
            model.show_finished()
        stop.add_note(model.results.to_resume)
        raise
    try:
        with ended_by_sigterm():
            model.summarise()
    except (KeyboardInterrupt, SystemExit) as stop:
        stop.add_note(model.results.to_resume)
        raise


def with_methods(args: list[str]) -> list[str]:
    """Arguments with a method's name and settings in the place of its name, in `--model.method` and in configurations.

    `--model.name` calls it otherwise, and more arguments change the settings. `--model.grid` with a number is the box's
    `voxels`, which other settings of the box leave alone. Raises ValueError for names of no method and of no
    configuration, and for settings without a method.
    """
    args = split_configurations(args)
    given = [arg.partition("=")[0] for arg in args]
    if any(option.startswith("--model.cube") for option in given):
        raise ValueError("model.cube is a setting of train.py: give model.grid")
    chosen = any(option in ("--model", "--model.method", "--model.method.class_path") for option in given)
    out, read = [], (*CONFIGURATION, "--model.method", "--model.grid")
    for option, value in valued(args, read):
        if option not in read:
            out.append(option)
            continue
        value = value or ""
        if option in CONFIGURATION:
            option, (value, gives_method) = "--config", _configuration(value)
            chosen = chosen or gives_method
        elif option == "--model.method" and _is_name(value):
            named = _named(value)
            if "--model.name" in given:
                del named["name"]
            option, value = "--config", json.dumps({"model": named})
        elif option == "--model.grid" and value.isdecimal():
            option = "--model.grid.voxels"
        out.append(f"{option}={value}")
    alone = [] if chosen else [option for option in given if option.startswith("--model.method.")
                               and option != "--model.method.help"]
    if alone:
        raise ValueError(f"{alone[0]} is a setting of a method, but none was given: add --model.method with one of "
                         f"{', '.join(METHODS)}")
    return out


def _configuration(given: str) -> tuple[str, bool]:
    """A configuration, its file or what it holds where it names a method or gives a number of voxels, and whether it
    gives a method at all."""
    if is_yaml(given):
        file, settings = given, inline_configuration(given)
    else:
        try:
            file = str(configuration(given, ("reconstruct", "simulate")))
        except ValueError:
            if (name := given.removeprefix("configs/reconstruct/").removesuffix(".yaml")) not in METHODS:
                raise
            return json.dumps({"model": _named(name)}), True
        settings = read_configuration(file)
    model = settings.get("model", {})
    own: dict = {}
    if _is_name(model.get("method")):
        own = _named(model["method"])
    if type(model.get("grid")) is int:
        own["grid"] = {"voxels": model["grid"]}
    if not own:
        return file, "method" in model
    written = own | model | {key: own[key] for key in own if key != "name"}  # a name in the file stays
    return json.dumps(settings | {"model": written}), "method" in model


def _is_name(method: object) -> bool:
    """Whether a method is given by a name, instead of a class or its settings."""
    return isinstance(method, str) and not method.startswith("{") and "." not in method and method not in {
        type(known).__name__ for known in METHODS.values()}


def _named(name: str) -> dict:
    """What a named method is as model.name and model.method. Raises ValueError where there is none of that name."""
    if name not in METHODS:
        raise ValueError(f"there is no method '{name}': give model.method one of {', '.join(METHODS)}, or a class "
                         "such as phydict.posterior.DDS")
    return {"name": name, "method": _written(METHODS[name])}


def _written(settings) -> dict:
    """Nested settings as a configuration writes them."""
    kind, values = type(settings), {field.name: getattr(settings, field.name) for field in fields(settings)}
    return {"class_path": f"{kind.__module__}.{kind.__qualname__}", "init_args": {
        name: _written(value) if is_dataclass(value) else value for name, value in values.items()}}


def main(args: list[str] | None = None) -> None:
    """Command line of inference: predict, test, ablate, page. A bad input ends in one sentence and exit code 2."""
    args = sys.argv[1:] if args is None else args
    if args[:1] == ["ablate"]:
        return ablate(args[1:])
    if args[:1] == ["page"]:
        return page(args[1:])
    with progress_options(args), cli_errors(MisconfigurationException), quiet():
        check_command(args, COMMANDS, InferenceCLI.subcommands(), "predict --data.xrays data/example/xrays")
        InferenceCLI(
            ReconstructionTask, ReconstructionData, args=args, seed_everything_default=0, save_config_callback=None,
            auto_configure_optimizers=False,
            parser_kwargs={"exit_on_error": False, "allow_abbrev": False, "formatter_class": HelpFormatter,
                           "description": (
                "Reconstruct chest CTs from X-rays. Two more subcommands: ablate compares methods, page makes the "
                "page of results anew (ablate --help, page --help).")},
            trainer_defaults={"inference_mode": False, "logger": False, "enable_progress_bar": False,
                              "enable_checkpointing": False, "enable_model_summary": False, "accelerator": "auto",
                              "devices": 1})
