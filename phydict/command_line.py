"""What both command lines share: bad input ends in one clear sentence, and the console shows only what matters."""

from __future__ import annotations

import logging
import os
import re
import sys
import warnings
from argparse import ArgumentError
from collections.abc import Iterator
from contextlib import contextmanager

NOISE = (".*does not have many workers", ".*LeafSpec.*is deprecated", ".*is smaller than the logging interval",
         "Total length of `DataLoader` across ranks is zero", "Checkpoint directory .* exists and is not empty",
         "It is recommended to use `self.log", "Using `DistributedSampler` with the dataloaders",
         ".*args parameter is intended to run from within Python", "predict returned None")
"""Warnings that tell a user of the command lines nothing to act on."""


@contextmanager
def one_sentence_errors() -> Iterator[None]:
    """Prints bad arguments, ValueError and OSError as one sentence and exits with code 2; the environment variable
    PHYDICT_TRACEBACK=1 shows the trace instead."""
    try:
        yield
    except (ValueError, OSError, ArgumentError) as error:
        if os.environ.get("PHYDICT_TRACEBACK"):
            raise
        print(f"error: {sentence(error)}", file=sys.stderr)
        raise SystemExit(2) from None
    except RuntimeError as error:
        if os.environ.get("PHYDICT_TRACEBACK") or not re.search("Connection (closed|reset) by peer", str(error)):
            raise
        print("stopped, because another process of this run ended; its message says why", file=sys.stderr)
        raise SystemExit(2) from None


def sentence(error: Exception) -> str:
    """An error's message on one line, without what loader processes and the argument parser wrap around it."""
    text = str(error).strip()
    if text.startswith("Caught "):  # a loader process sends its whole trace; the last line holds the message
        text = text.splitlines()[-1].partition(": ")[2]
    if "Does not validate against any of the Union" in text:
        reasons = re.split(r"\n\s*- ", text.partition("Given value type")[0])[1:]
        reasons = [reason for reason in reasons if "does not correspond to a subclass" not in reason] or reasons
        text = text.partition("Does not validate")[0] + "; ".join(reasons)
    return " ".join(text.split())


@contextmanager
def quiet() -> Iterator[None]:
    """Lightning's hints and the warnings of NOISE are silent inside, and other warnings take one line."""
    loggers = [logging.getLogger(name) for name in ("lightning.pytorch", "lightning.fabric")]
    levels = [logger.level for logger in loggers]
    with warnings.catch_warnings():
        warnings.showwarning = _show
        for message in NOISE:
            warnings.filterwarnings("ignore", message)
        for logger in loggers:
            logger.setLevel(logging.WARNING)
        try:
            yield
        finally:
            for logger, level in zip(loggers, levels):
                logger.setLevel(level)


def _show(message: Warning | str, *_) -> None:
    print(f"warning: {' '.join(str(message).split())}", file=sys.stderr)
