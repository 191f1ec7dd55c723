"""Processes of their own for tests, forked from one that has imported what the command lines need."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory

FORKS = multiprocessing.get_context("forkserver")
FORKS.set_forkserver_preload(["phydict.cli.train", "phydict.cli.infer",
                              "monai.networks.nets", "transformers.models.bert.modeling_bert"])  # imported at first use

INFER, TRAIN = (f"from phydict.cli.{name} import main; main()" for name in ("infer", "train"))
"""Code that runs a command line with the arguments of its process."""


def _run(code: str, arguments: list[str], folder: Path) -> None:
    for number, name in ((1, "out"), (2, "err")):
        os.dup2(os.open(folder / name, os.O_WRONLY | os.O_CREAT | os.O_APPEND), number)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})  # which the one forked from may have been begun without
    sys.argv = ["-c", *arguments]
    exec(compile(code, "<test>", "exec"), {"__name__": "__main__"})


class Python:
    """A process that runs `code` with these arguments."""

    def __init__(self, code: str, *arguments: object):
        self.kept = TemporaryDirectory()  # removed with this object
        self.folder = Path(self.kept.name)
        self.process = FORKS.Process(target=_run, args=(code, list(map(str, arguments)), self.folder))
        self.process.start()

    def wait(self, seconds: float = 300.0) -> int:
        """Its exit status when it has ended, the negative number of the signal that ended it."""
        self.process.join(seconds)
        if self.process.exitcode is None:
            self.process.kill()
            raise TimeoutError(self.err)
        return self.process.exitcode

    def wait_for(self, happened, seconds: float = 60.0) -> None:
        """Returns once `happened()` is true, or the process has ended, or time is up."""
        end = time.monotonic() + seconds
        while not happened() and self.process.exitcode is None and time.monotonic() < end:
            time.sleep(0.05)

    @property
    def out(self) -> str:
        return self._read("out")

    @property
    def err(self) -> str:
        return self._read("err")

    def _read(self, name: str) -> str:
        file = self.folder / name
        return file.read_text() if file.exists() else ""
