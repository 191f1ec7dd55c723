"""Configurations on a command line: which are given, where they are, and what they hold."""

from __future__ import annotations

import os
import reprlib
from collections.abc import Collection, Iterable, Iterator, Sequence

from jsonargparse import set_loader

from phydict.runtime.shipped import configuration
from phydict.runtime.yaml_file import parse_yaml, read_yaml

CONFIGURATION = ("-c", "--config")
"""Options that name a configuration file, or hold settings themselves."""


def _bounded(text: str) -> object:
    """A value or a file of the command line's parser, read within `read_yaml`'s bounds; "a:" and "{a}" stay text."""
    value = parse_yaml(text, "the value")
    bare = text.strip()
    if isinstance(value, dict) and value and all(v is None for v in value.values()) and (
            bare == f"{next(iter(value))}:" or (bare.startswith("{") and ":" not in bare)):
        return text
    return value


set_loader("yaml", _bounded, (ValueError,))


def split_configurations(args: Iterable[str]) -> list[str]:
    """Arguments with a glued -cFILE as the two that it stands for."""
    return [part for arg in args for part in ([arg] if arg[:2] != "-c" or arg[2:3] in ("", "=") else ["-c", arg[2:]])]


def is_yaml(given: str) -> bool:
    """Whether a configuration is "key: value", YAML itself, and no file whose name has a colon."""
    return ":" in given and not os.path.isfile(given)


def valued(args: Iterable[str], options: Collection[str]) -> Iterator[tuple[str, str | None]]:
    """Each of `options` with its value, which follows "=" or is the next argument; None where nothing follows. Other
    arguments come with None."""
    rest = iter(args)
    for arg in rest:
        option, equals, value = arg.partition("=")
        yield (option, value if equals else next(rest, None)) if option in options else (arg, None)


def with_configurations(args: list[str], kinds: tuple[str, ...]) -> list[str]:
    """Arguments with every configuration (-c, --config) as --config=, shipped ones, which may be given by name, as
    their path. Raises ValueError, as `phydict.runtime.shipped.configuration` does, for files that are nowhere."""
    def place(given: str) -> str:
        return given if is_yaml(given) else str(configuration(given, kinds))

    found = valued(split_configurations(args), CONFIGURATION)
    return [option if value is None else f"--config={place(value)}" for option, value in found]


def check_configured(args: Sequence[str], options: Collection[str], example: str) -> None:
    """Raises ValueError where `args` hold none of the options that say what to run, and do not ask for help."""
    options = ("-c", "--config", "-h", "--help", *options)
    given = [arg.partition("=")[0] for arg in args]
    if not any(arg in options or arg.startswith("-c") or arg.endswith(".help") for arg in given):
        raise ValueError(f"no configuration file was given: add -c <file>, such as -c {example}")


def read_configurations(args: Sequence[str]) -> list[dict]:
    """What the configurations of a command line hold, in their order, without missing files, of which the command
    line's own parser speaks. Raises ValueError as `read_configuration` and `inline_configuration` do."""
    given = [value for _, value in valued(split_configurations(args), CONFIGURATION) if value is not None]
    return [inline_configuration(one) if is_yaml(one) else read_configuration(one) for one in given
            if is_yaml(one) or os.path.isfile(one)]


def inline_configuration(given: str) -> dict:
    """What a configuration holds that is given as YAML itself. Raises ValueError for what is no settings."""
    settings = parse_yaml(given, "config")
    if not isinstance(settings, dict) or not isinstance(settings.get("model", {}), dict):
        raise ValueError("config: a mapping of settings, such as `model: {...}`, was expected, but "
                         f"{reprlib.repr(settings)} was given")
    return settings


def read_configuration(file: str) -> dict:
    """What a configuration file holds, read as `read_yaml` reads, so that what it refuses never reaches the command
    line's own parser. Raises ValueError."""
    settings = read_yaml(file)
    if not isinstance(settings, dict):
        raise ValueError(f"{file} holds no settings: it is a mapping, such as `model: {{...}}`")
    for name in ("model", "data", "trainer"):
        if not isinstance(settings.get(name, {}), dict):
            raise ValueError(f"{file}: `{name}` is a mapping of settings, but {reprlib.repr(settings[name])} was given")
    _check_classes(settings, str(file), "")
    return settings


def _check_classes(settings: object, file: str, key: str) -> None:
    """Raises ValueError where a class in nested settings is not named by text, or its arguments are no mapping."""
    if isinstance(settings, dict):
        for name, kind, wanted in (("class_path", str, "the name of a class"), ("init_args", dict, "a mapping")):
            if name in settings and not isinstance(settings[name], kind):
                raise ValueError(f"{file}: `{key}{name}` is {wanted}, but {reprlib.repr(settings[name])} was given")
        for name, value in settings.items():
            _check_classes(value, file, f"{key}{name}.")
    for value in settings if isinstance(settings, list) else ():
        _check_classes(value, file, key)
