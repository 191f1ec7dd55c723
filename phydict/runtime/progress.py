"""How far a run over cases is: bars on a terminal, lines in a log file, JSON for machines, or nothing."""

from __future__ import annotations

import time
from pathlib import Path

from rich.console import Console

from phydict.runtime.progress_log import bars_on, log_progress


class CaseProgress:
    """Cases and the steps of the present case; a context manager that gives the terminal back however a run ends.

    interval: seconds between two lines about one case where the output is no terminal.
    """

    def __init__(self, interval: float = 60.0):
        self.interval, self.bars, self.entered = interval, bars_on(Console(stderr=True)), False

    def __enter__(self) -> CaseProgress:
        self.bars, self.entered = bars_on(Console(stderr=True)), True
        return self

    def __exit__(self, *_) -> None:
        self.bars.stop()

    def begin(self, name: str, cases: int, steps: int = 0, verb: str = "reconstruct", out: str | Path = "",
              noun: str = "case") -> None:
        """A run over `cases` cases of `steps` steps each, 0 where steps are not followed, whose results go to `out`."""
        where = f", results in {out}" if str(out) else ""
        log_progress(f"{name}: {cases} {noun}{'' if cases == 1 else 's'} to {verb}{where}",
                     event="begin", name=name, cases=cases, steps=steps, out=str(out))
        if self.entered:
            self.bars.start()
        self.cases = self.bars.add_task(name, total=cases)
        self.steps = self.bars.add_task("", total=steps, visible=steps > 0)
        self.done, self.of, self.of_steps, self.began = 0, cases, steps, time.monotonic()

    def case(self, name: str) -> None:
        """The next case begins."""
        self.bars.reset(self.steps, description=name)
        self.name, self.step, self.spoke = name, 0, time.monotonic()

    def follow(self, steps: int) -> None:
        """The present case has so many steps of its own, none of which is done."""
        self.step, self.of_steps = 0, steps
        self.bars.reset(self.steps, total=steps, visible=steps > 0)

    def advance(self) -> None:
        """One step of the case is done."""
        self.bars.advance(self.steps)
        self.step += 1
        share = min(self.step / self.of_steps, 1.0) if self.of_steps else 0.0
        self.bars.update(self.cases, completed=self.done + share)
        if time.monotonic() - self.spoke > self.interval:
            self.spoke = time.monotonic()
            left = self._seconds_left(share) if share else None
            of = f" of {self.of_steps}{to_go(left)}" if left is not None else ""
            self._line(f"{self.name}: step {self.step}{of}", event="step", case=self.name, step=self.step,
                       steps=self.of_steps, seconds_to_go=left)

    def finished(self, summary: str) -> None:
        """The case is written."""
        self.done += 1
        self.bars.update(self.cases, completed=self.done)
        left = self._seconds_left()
        self._line(f"{self.name}: {summary} ({self.done} of {self.of}{to_go(left)})", event="case", case=self.name,
                   summary=summary, done=self.done, cases=self.of, seconds_to_go=left)

    def _seconds_left(self, share: float = 0.0) -> float:
        """As the cases done and this share of the present one have taken."""
        done = self.done + share
        return round((time.monotonic() - self.began) / done * max(self.of - done, 0), 1)

    def _line(self, text: str, **event: object) -> None:
        if self.bars.disable:
            log_progress(text, **event)


def to_go(seconds: float) -> str:
    """What a line says of the seconds that are left: nothing where there are none."""
    return f", about {duration(seconds)} to go" if seconds else ""


def duration(seconds: float) -> str:
    """Seconds in words of two units at most: "40 s", "12 min", "3 h 20 min"."""
    minutes = round(seconds / 60)
    if seconds < 99.5:
        return f"{seconds:.0f} s"
    return f"{minutes} min" if minutes < 100 else f"{minutes // 60} h {minutes % 60} min"
