"""What the command lines of training and of reconstruction tell of their progress."""

from __future__ import annotations

from typing import Any

from lightning import Trainer
from lightning.pytorch.cli import LightningArgumentParser, LightningCLI
from lightning.pytorch.strategies.launchers import _MultiProcessingLauncher

from phydict.runtime.console import check_processes
from phydict.runtime.parser_message import naming_unknown_options
from phydict.runtime.progress_log import add_progress_options, progress_as
from phydict.runtime.reading import reading

NUMBER = int | float | None


def keep_whole(parser: LightningArgumentParser) -> None:
    """Has options that are a whole number or a share, such as trainer.limit_val_batches, read 1 as the whole number:
    `typing` may have cached Lightning's types in the other order, in which 1 is the share 1.0, all."""
    for action in parser._actions:
        if getattr(action, "_typehint", None) == NUMBER:
            action._typehint = NUMBER  # type: ignore[attr-defined]


class ProgressCLI(LightningCLI):
    """A LightningCLI whose subcommands take --quiet and --json_lines, and which builds the one that is given alone."""

    def __init__(self, model: type, data: type, *, args: list[str], **settings: Any):
        every = self.subcommands()
        if args[:1] and args[0] in every:
            self.subcommands = lambda: {args[0]: every[args[0]]}  # type: ignore[method-assign]
        super().__init__(model, data, args=args, **settings)

    def _prepare_subcommand_parser(self, klass: type, subcommand: str, **kwargs):
        parser = super()._prepare_subcommand_parser(klass, subcommand, **kwargs)
        keep_whole(parser)
        add_progress_options(parser)
        return parser

    def _add_instantiators(self) -> None:
        """None: Lightning's write the configuration once more, for hyperparameters in checkpoints, which have none."""

    def _parse_ckpt_path(self) -> None:
        """None: Lightning's reads the whole checkpoint for hyperparameters, which these have none of."""

    def parse_arguments(self, parser, args) -> None:
        subcommands = getattr(self, "_subcommand_parsers", {})  # none where nothing is run
        with naming_unknown_options(parser, *subcommands.values()):
            super().parse_arguments(parser, args)

    def instantiate_trainer(self, **kwargs) -> Trainer:
        with reading("the settings of trainer", "correct them"):
            made = super().instantiate_trainer(**kwargs)
        check_processes(made.num_devices)
        if isinstance(made.strategy.launcher, _MultiProcessingLauncher):
            raise ValueError(f"by trainer.strategy {self._get(self.config, 'trainer.strategy')} processes are copies "
                             "of this one, but each has to run the command anew: give ddp")
        return made

    def flag(self, name: str) -> bool:
        """An option that is on or off, in a configuration too."""
        value = self._get(self.config, name, False)
        if not isinstance(value, bool):
            raise ValueError(f"{name} is true or false, but {value!r} was given")
        return value

    def _run_subcommand(self, subcommand: str) -> None:
        with progress_as(self.flag("quiet"), self.flag("json_lines")):
            super()._run_subcommand(subcommand)
