"""What `fit --help`, `predict --help` and `test --help` show of Lightning's options, and of the method given."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from jsonargparse import ArgumentParser

from phydict.ablation.nested import parsed
from phydict.methods import DEFAULT_METHOD, METHODS
from phydict.posterior import Sampler
from phydict.reconstruction import Reconstructor
from phydict.runtime.configurations import CONFIGURATION, read_configuration
from phydict.runtime.help import arrange_help, show_settings
from phydict.runtime.yaml_file import parse_yaml

LIGHTNING = {name: "Lightning's options; more are accepted, as its documentation describes them" for name in (
    "trainer", "checkpoint", "best", "seed_everything", "weights_only")}

DEVICES = {
    "config": "A YAML file of settings, or the name of a shipped one.",
    "trainer.accelerator": "cpu, gpu or mps; auto takes what is there (default: auto)",
    "trainer.devices": "how many devices, or a list of their numbers (default: %(default)s)",
}

FIT = DEVICES | {
    "ckpt_path": "a checkpoint of the same training to resume from, such as <out>/last.ckpt",
    "trainer.num_nodes": "how many machines, each with as many devices (default: 1)",
    "trainer.strategy": "how devices share the work; configs/prior/ddp.yaml and fsdp.yaml set it (default: auto)",
    "trainer.max_steps": "steps after which training ends; -1: no bound (default: -1)",
    "trainer.max_epochs": "epochs after which training ends (default: none)",
    "trainer.max_time": "time after which training ends, as DD:HH:MM:SS (default: none)",
    "trainer.check_val_every_n_epoch": "epochs from one validation to the next (default: 1)",
    "trainer.limit_val_batches": "share or number of the held-out cases that validate (default: all)",
    "trainer.accumulate_grad_batches": "batches per step of the optimiser (default: 1)",
    "trainer.gradient_clip_val": "norm to which gradients are clipped (default: none)",
    "trainer.log_every_n_steps": "steps from one line of the log to the next (default: 50)",
}

PREDICT = DEVICES | {
    "model.method": f"one of {', '.join(METHODS)}, or the path of a Sampler's or Reconstructor's class "
                    f"(default: {DEFAULT_METHOD})",
}


def fit_help(parser: ArgumentParser, command: str, description: str) -> None:
    """The help of training: its settings, then what Lightning's Trainer is set to."""
    parser.description = f"{description[0].upper()}{description[1:]}."
    arrange_help(parser, f"train.py {command} -c CONFIG [options]", FIT, LIGHTNING)


def predict_help(parser: ArgumentParser, command: str, description: str) -> None:
    """The help of reconstruction: its settings, then the devices."""
    given = {"predict": "--data.xrays FOLDER", "test": "--data.cts FOLDER"}[command]
    parser.description = description + ". --model.method NAME --help shows the settings of a method."
    arrange_help(parser, f"infer.py {command} {given} [--model.method NAME] [options]", PREDICT, LIGHTNING)


def method_help(parser: ArgumentParser, args: Sequence[str]) -> None:
    """Puts the settings of the method that arguments of `with_methods` give, if any, before all others."""
    if method := _method_in(args):
        show_settings(parser, *method, "--model.method")


def describe_commands(parser: ArgumentParser, commands: Mapping[str, str]) -> None:
    """Says of each command what it does, in the help of all."""
    for action in parser._actions:
        for choice in getattr(action, "_choices_actions", ()):
            choice.help = commands[choice.dest]


def _method_in(args: Sequence[str]) -> tuple[str, object] | None:
    """The last method that is given, as its name, or its class's, and its settings."""
    for option, _, value in (arg.partition("=") for arg in reversed(args)):
        if option in ("--model.method", "--model.method.class_path"):
            return _method(parse_yaml(value, option), None)
        if option in CONFIGURATION:
            settings: Any = parse_yaml(value, option) if ":" in value else read_configuration(value)
            model = settings.get("model") or {}
            if "method" in model:
                return _method(model["method"], model.get("name"))
    return None


def _method(given: object, name: str | None) -> tuple[str, object]:
    settings = parsed(Sampler | Reconstructor, given, "model.method")
    return name or type(settings).__name__, settings
