"""How far a run over cases is: bars on a terminal, lines in a log file, JSON for machines, or nothing."""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn


class CaseProgress:
    """Cases and the steps of the present case; a context manager that gives the terminal back however a run ends.

    interval: seconds between two lines about one case where the output is no terminal. `tell` chooses otherwise.
    """

    def __init__(self, interval: float = 60.0):
        console = Console(stderr=True)
        self.live, self.interval, self.quiet, self.json = console.is_terminal, interval, False, False
        self.bars = Progress(TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(),
                             TimeRemainingColumn(), console=console, disable=not self.live)

    def __enter__(self) -> CaseProgress:
        self.bars.start()
        return self

    def __exit__(self, *_) -> None:
        self.bars.stop()

    def tell(self, quiet: bool, json_lines: bool) -> None:
        """Tells nothing, or, before it, a JSON object on each line; neither leaves it as it is."""
        self.quiet, self.json = quiet, json_lines
        if quiet or json_lines:
            self.live, self.bars.disable = False, True

    def begin(self, name: str, cases: int, steps: int = 0, verb: str = "reconstruct", out: str | Path = "") -> None:
        """A run over `cases` cases of `steps` steps each, 0 where steps are not followed, whose results go to `out`."""
        self.cases = self.bars.add_task(name, total=cases)
        self.steps = self.bars.add_task("", total=steps, visible=steps > 0)
        self.done, self.of, self.of_steps, self.began = 0, cases, steps, time.monotonic()
        where = f", results in {out}" if str(out) else ""
        self._line(f"{name}: {cases} {'case' if cases == 1 else 'cases'} to {verb}{where}",
                   event="begin", name=name, cases=cases, steps=steps, out=str(out))

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
            of = f" of {self.of_steps}" if self.of_steps else ""
            self._line(f"{self.name}: step {self.step}{of}", event="step", case=self.name, step=self.step,
                       steps=self.of_steps)

    def finished(self, summary: str) -> None:
        """The case is written."""
        self.bars.advance(self.cases)
        self.done += 1
        left = (time.monotonic() - self.began) / self.done * max(self.of - self.done, 0)
        to_go = f", about {duration(left)} to go" if self.done < self.of else ""
        self._line(f"{self.name}: {summary} ({self.done} of {self.of}{to_go})", event="case", case=self.name,
                   summary=summary, done=self.done, cases=self.of, seconds_to_go=round(left, 1))

    def _line(self, text: str, **event) -> None:
        if not self.live and not self.quiet:
            print(json.dumps(event) if self.json else text, file=sys.stderr, flush=True)


def duration(seconds: float) -> str:
    """Seconds in words of two units at most: "40 s", "12 min", "3 h 20 min"."""
    minutes = round(seconds / 60)
    if seconds < 99.5:
        return f"{seconds:.0f} s"
    return f"{minutes} min" if minutes < 100 else f"{minutes // 60} h {minutes % 60} min"
