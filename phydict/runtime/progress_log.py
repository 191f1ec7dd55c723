"""Whether a long run tells of its progress in words, in JSON for machines, or not at all."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from contextvars import ContextVar

from jsonargparse import ArgumentParser
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Column

from phydict.runtime.parser_message import naming_unknown_options
from phydict.runtime.strict_json import strict_json

WORDS, JSON, SILENCE = "words", "json", "silence"

BESIDE_NAME = 60
"""Columns of a terminal for what stands beside the name of a bar."""

_MANNER: ContextVar[str] = ContextVar("manner", default=WORDS)


@contextmanager
def progress_as(quiet: bool, json_lines: bool) -> Iterator[None]:
    """Runs inside tell nothing of their progress (quiet, which goes first), or a JSON object on each line."""
    before = _MANNER.set(SILENCE if quiet else JSON if json_lines else WORDS)
    try:
        yield
    finally:
        _MANNER.reset(before)


def progress_options(args: Sequence[str]) -> AbstractContextManager[None]:
    """`progress_as` as the options of a whole command line have it, errors in that line included."""
    return progress_as("--quiet" in args, "--json_lines" in args)


def add_progress_options(parser: ArgumentParser) -> None:
    """The options of a command line that `progress_as` takes."""
    parser.add_argument("--quiet", action="store_true", help="tell no progress, only results, warnings and errors")
    parser.add_argument("--json_lines", action="store_true", help="tell the progress as a JSON object on each line")


def log_progress(text: str, /, **event: object) -> None:
    """A line on standard error: the text or, as `progress_as` has it, the event as JSON, or nothing."""
    if _MANNER.get() != SILENCE:
        log_always(text, **event)


def log_always(text: str, /, **event: object) -> None:
    """As `log_progress`, but never silenced."""
    if sys.stderr is None:  # closed before the start: `print` would write to standard output
        return
    print(strict_json(event) if _MANNER.get() == JSON else text, file=sys.stderr, flush=True)


def log_problem(kind: str, text: str) -> None:
    """A warning or an error on standard error: as JSON where progress is, and never silenced."""
    log_always(f"{kind}: {text}", event=kind, text=text)


def bars_on(console: Console, *columns: ProgressColumn) -> Progress:
    """Bars with their count, the time so far and the time to go, that show on a terminal alone, and in words alone. A
    name that is too long for the line is cut."""
    name = Column(no_wrap=True, overflow="ellipsis", max_width=max(console.width - BESIDE_NAME, 8))
    return Progress(TextColumn("{task.description}", markup=False, table_column=name), BarColumn(16),
                    MofNCompleteColumn(), TimeElapsedColumn(), TextColumn("so far,"), TimeRemainingColumn(),
                    TextColumn("to go"), *columns, console=console,
                    disable=not console.is_terminal or _MANNER.get() != WORDS)


def run_command(function: Callable[..., object], args: Sequence[str] | None, program: str | None = None,
                positional: bool = False) -> None:
    """Runs a function with the options of a command line as its arguments, telling its progress as further ones say;
    program: its name in the help."""
    description = " ".join((function.__doc__ or "").partition("\n\n")[0].split())
    parser = ArgumentParser(prog=program, description=description, exit_on_error=False, allow_abbrev=False)
    parser.add_function_arguments(function, as_positional=positional, as_group=False)
    add_progress_options(parser)
    with naming_unknown_options(parser):
        given = parser.instantiate(parser.parse_args(args)).as_dict()
    with progress_as(given.pop("quiet"), given.pop("json_lines")):
        function(**given)
