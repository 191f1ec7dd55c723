"""How far a run over cases is: bars on a terminal, lines in a log file."""

from __future__ import annotations

import sys
import time

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn


class CaseProgress:
    """Cases and the steps of the present case; a context manager that gives the terminal back however a run ends.

    interval: seconds between two lines about one case where the output is no terminal.
    """

    def __init__(self, interval: float = 60.0):
        console = Console(stderr=True)
        self.live, self.interval = console.is_terminal, interval
        self.bars = Progress(TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(),
                             TimeRemainingColumn(), console=console, disable=not self.live)

    def __enter__(self) -> CaseProgress:
        self.bars.start()
        return self

    def __exit__(self, *_) -> None:
        self.bars.stop()

    def begin(self, name: str, cases: int, steps: int = 0, verb: str = "reconstruct") -> None:
        """A run over `cases` cases of `steps` steps each; 0 where steps are not followed."""
        self.cases = self.bars.add_task(name, total=cases)
        self.steps = self.bars.add_task("", total=steps, visible=steps > 0)
        self._line(f"{name}: {cases} {'case' if cases == 1 else 'cases'} to {verb}")

    def case(self, name: str) -> None:
        """The next case begins."""
        self.bars.reset(self.steps, description=name)
        self.name, self.step, self.spoke = name, 0, time.monotonic()

    def advance(self) -> None:
        """One step of the case is done."""
        self.bars.advance(self.steps)
        self.step += 1
        if time.monotonic() - self.spoke > self.interval:
            self.spoke = time.monotonic()
            self._line(f"{self.name}: step {self.step}")

    def finished(self, summary: str) -> None:
        """The case is written."""
        self.bars.advance(self.cases)
        self._line(f"{self.name}: {summary}")

    def _line(self, text: str) -> None:
        if not self.live:
            print(text, file=sys.stderr, flush=True)
