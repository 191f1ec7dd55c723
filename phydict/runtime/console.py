"""What both command lines share: bad input ends in one clear sentence, and the console shows only what matters."""

from __future__ import annotations

import errno
import logging
import os
import re
import reprlib
import select
import signal
import sys
import tempfile
import threading
import warnings
from argparse import ArgumentError
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import cast

from phydict.runtime.memory import enough_memory
from phydict.runtime.parser_message import plain
from phydict.runtime.progress_log import log_always, log_problem, log_progress
from phydict.runtime.reading import one_line
from phydict.runtime.warning import Remark

NOISE = (".*does not have many workers", "Consider setting `persistent_workers", ".*LeafSpec.*is deprecated",
         ".*is smaller than the logging interval",
         "Total length of `DataLoader` across ranks is zero", "Checkpoint directory .* exists and is not empty",
         "It is recommended to use `self.log", "Using `DistributedSampler` with the dataloaders",
         ".*args parameter is intended to run from within Python", "predict returned None",
         ".*all_gather is deprecated, use",
         "You're resuming from a checkpoint that ended before the epoch ended",
         "You're using the WeightAveraging callback with a model that overrides the configure_model",
         "You're using the WeightAveraging callback, but loading a checkpoint outside the 'fit' stage",
         "The dirpath has changed from",
         r"Found \d+ module\(s\) in eval mode at the start of training")
"""Warnings that tell a user of the command lines nothing to act on."""

AGAIN = "run the same command again"
"""How notes begin that help after a signal or where a disk was full, and not after a fault of code."""

TRACEBACK = "PHYDICT_TRACEBACK"
"""The environment variable that, where it is set, lets every error show its trace."""


@contextmanager
def cli_errors(*also: type[Exception]) -> Iterator[None]:
    """Prints bad arguments, ValueError, OSError, FloatingPointError and `also` as one sentence and exits with code 2;
    the environment variable PHYDICT_TRACEBACK=1 shows the trace instead. A run that a signal stopped says how to resume
    and exits with code 130 (SIGINT) or 143 (SIGTERM): as the note of what was raised has it, or by the same command.
    Where whoever reads standard output, such as head, has read enough, it exits with code 1 and says nothing. Faults of
    code pass, without the notes that begin with AGAIN."""
    try:
        with _raised_again(), enough_memory():
            yield
            if sys.stdout is not None:  # closed before the start, as some daemons have it
                sys.stdout.flush()
    except (KeyboardInterrupt, SystemExit) as stop:  # Lightning exits with 1 on SIGINT and without a code on SIGTERM
        interrupted = isinstance(stop, KeyboardInterrupt) or isinstance(stop.__context__, KeyboardInterrupt)
        if not interrupted and isinstance(stop, SystemExit) and stop.code is not None:
            raise
        text = f"stopped by a signal; to resume, {_advice(stop)}"
        log_always(text, event="stopped", text=text)
        raise SystemExit(130 if interrupted else 143) from None
    except (ValueError, OSError, FloatingPointError, ArgumentError, *also) as error:  # type: ignore[misc]
        if os.environ.get(TRACEBACK):
            raise
        if isinstance(error, BrokenPipeError) and _nobody_reads():
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # for what is flushed at the end
            raise SystemExit(1) from None
        full = isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT)
        advice = f": free some space; to resume, {_advice(error)}" if full else ""
        log_problem("error", f"{sentence(error)}{advice}")
        raise SystemExit(2) from None
    except RuntimeError as error:
        if os.environ.get(TRACEBACK) or not re.search("Connection (closed|reset) by peer", str(error)):
            _leave_out_again(error)
            raise
        text = "stopped, because another process of this run ended; its message says why"
        log_always(text, event="stopped", text=text)
        raise SystemExit(2) from None
    except Exception as error:
        _leave_out_again(error)
        raise


@contextmanager
def _raised_again() -> Iterator[None]:
    """A signal whose exception is dropped inside, as where it strikes in a callback of numba's compiler, is sent again
    a little later."""
    def again(dropped: sys.UnraisableHookArgs) -> None:
        signals = {KeyboardInterrupt: signal.SIGINT, SystemExit: signal.SIGTERM}
        if dropped.exc_type not in signals:
            return before(dropped)
        later = threading.Timer(0.1, _send_to_main_thread, (signals[dropped.exc_type],))
        later.daemon = True
        later.start()

    before, sys.unraisablehook = sys.unraisablehook, again
    try:
        yield
    finally:
        sys.unraisablehook = before


def _send_to_main_thread(number: int) -> None:
    if sys.platform == "win32":
        signal.raise_signal(number)
    else:  # which ends a wait of the system's as well
        signal.pthread_kill(cast(int, threading.main_thread().ident), number)


@contextmanager
def ended_by_sigterm() -> Iterator[None]:
    """SIGTERM, as a cluster's scheduler sends it, ends what runs inside as Ctrl-C does: by an exception, a SystemExit
    that `cli_errors` knows, in place of at once."""
    def end(*_: object) -> None:
        raise SystemExit

    before = signal.signal(signal.SIGTERM, end)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _nobody_reads() -> bool:
    """Whether whoever read standard output has closed it; Windows does not say, and it is taken for so."""
    if sys.platform == "win32":
        return True
    poll = select.poll()
    poll.register(sys.stdout.fileno(), 0)
    return bool(poll.poll(0))


def _advice(stop: BaseException) -> str:
    return getattr(stop, "__notes__", [AGAIN])[-1]


def _leave_out_again(error: Exception) -> None:
    if notes := getattr(error, "__notes__", None):
        notes[:] = [note for note in notes if not note.startswith(AGAIN)]


def check_command(args: Sequence[str], commands: Mapping[str, str], anywhere: Collection[str], example: str) -> None:
    """Raises ValueError, in one sentence that names `commands`, name -> what it does, and an example, where no argument
    is one of those that may stand `anywhere`, and none asks for help."""
    if not any(arg in anywhere or arg in ("-h", "--help") or arg.startswith("--print_config") for arg in args):
        listed = ", ".join(f"{name} ({what})" for name, what in commands.items())
        raise ValueError(f"the first word says what to do, but {repr(args[0]) if args else 'none'} was given: use one "
                         f"of {listed}; such as: {example}")


def check_writable(path: Path, option: str, file: bool = False) -> None:
    """Raises ValueError, in one sentence, unless a folder (or a file) can be written at `path`, which need not exist
    yet; `option` is what the user should change."""
    there = path.absolute()
    try:
        if "\0" in str(path):
            raise ValueError
        if file and there.is_dir():
            raise IsADirectoryError(None, "is a folder, but a file is to be written")
        there = there.parent if file else there
        while not there.exists():
            if there.is_symlink():
                raise FileNotFoundError(None, f"leads nowhere, since {there} is a broken link")
            there = there.parent
    except (OSError, ValueError) as error:
        wrong = error.strerror if isinstance(error, OSError) else "is no name of a file"
        shown = path if len(str(path)) < 256 and str(path).isprintable() else reprlib.repr(str(path))
        raise ValueError(f"{shown} {wrong}: give another {option}") from error
    try:
        with tempfile.TemporaryFile(dir=there):
            pass
    except OSError as error:
        reason = "is a file" if there.is_file() else f"cannot be written to ({error.strerror})"
        raise ValueError(f"{path} cannot be written because {there} {reason}: give another {option}") from error


def check_processes(processes: int) -> None:
    """Raises ValueError where a run asks for more processes than this machine can have at work, at least 8."""
    cores = os.cpu_count() or 1
    if processes > max(8, cores):
        raise ValueError(f"trainer.devices asks for {processes:,} processes, but this machine has {cores} cores: give "
                         "fewer")


def check_apart(output: Path, option: str, inputs: Iterable[Path]) -> None:
    """Raises ValueError, in one sentence, where `output` is one of the inputs, lies inside one or holds one, wherever
    links lead; `option` is what the user should change."""
    there = Path(os.path.realpath(output))
    for given in inputs:
        here = Path(os.path.realpath(given))
        if there.is_relative_to(here) or here.is_relative_to(there):
            how = "is" if there == here else "lies inside" if there.is_relative_to(here) else "holds"
            raise ValueError(f"the output {output} {how} the input {given}: give another {option}")


def sentence(error: Exception) -> str:
    """An error's message on one line, without what loader processes and the argument parser wrap around it."""
    text = str(error).strip()
    if text.startswith("Caught "):  # a loader process sends its whole trace; the last line holds the message
        text = text.splitlines()[-1].partition(": ")[2]
    return one_line(plain(text) or text)


@contextmanager
def quiet() -> Iterator[None]:
    """Lightning's hints and the warnings of NOISE are silent inside, and other warnings take one line, a Remark once.
    """
    remarks = set()

    def show(message: Warning | str, category: type[Warning], *_) -> None:
        text = " ".join(str(message).split())
        if category is not Remark:
            log_problem("warning", text)
        elif text not in remarks:
            remarks.add(text)
            log_progress(text, event="note", text=text)

    loggers = [logging.getLogger(name) for name in ("lightning.pytorch", "lightning.fabric")]
    levels = [logger.level for logger in loggers]
    with warnings.catch_warnings():
        warnings.showwarning = show  # type: ignore[assignment]
        if any(action == "ignore" and message is module is None and issubclass(UserWarning, category)
               for action, message, category, module, _ in warnings.filters):
            warnings.showwarning = lambda *_: None  # type: ignore[assignment]
            warnings.filterwarnings("default", category=UserWarning)  # records of cases hold them all the same
        for message in NOISE:
            warnings.filterwarnings("ignore", message)
        for logger in loggers:
            logger.setLevel(logging.WARNING)
        if hasattr(sys.stdout, "reconfigure"):
            sys.stdout.reconfigure(errors="backslashreplace")  # paths need not be text that the console knows
        try:
            yield
        finally:
            for logger, level in zip(loggers, levels):
                logger.setLevel(level)


@contextmanager
def noted(texts: list[str], name: str) -> Iterator[None]:
    """Adds to `texts`, each once, what the UserWarnings given inside say, and shows them with the name of the case."""
    with warnings.catch_warnings():
        show = warnings.showwarning

        def keep(message: Warning | str, category: type[Warning], *where) -> None:
            text = " ".join(str(message).split())
            if category is UserWarning and text not in texts:
                texts.append(text)
            show(message if name in text or category is Remark else f"{name}: {text}", category, *where)

        warnings.showwarning = keep  # type: ignore[assignment]
        yield
