"""How far a training is: a bar over its steps on a terminal, lines in a log file."""

from __future__ import annotations

import math
import sys
import time

import lightning
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from phydict.runtime.progress import duration


class TrainingProgress(lightning.Callback):
    """Tells the steps that are done and what they log.

    Args:
        interval: seconds between two lines where the output is no terminal
    """

    def __init__(self, interval: float = 60.0):
        self.interval, self.bar = interval, None

    def on_train_start(self, trainer, module) -> None:
        console, self.spoke, self.last_shown = Console(stderr=True), time.monotonic(), -1
        self.live = console.is_terminal and trainer.is_global_zero
        self.bar = Progress(TextColumn("training"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(),
                            TimeRemainingColumn(), TextColumn("{task.description}"), console=console,
                            disable=not self.live)
        steps = trainer.estimated_stepping_batches
        self.first, self.began = trainer.global_step, time.monotonic()
        self.total = steps if math.isfinite(steps) and steps > 0 else None
        self.task = self.bar.add_task("", total=self.total, completed=trainer.global_step)
        self.bar.start()

    def on_train_batch_end(self, trainer, module, outputs, batch, index) -> None:
        self.bar.update(self.task, completed=trainer.global_step, description=_logged(trainer))
        if time.monotonic() - self.spoke > self.interval:
            self._line(trainer)

    def on_validation_end(self, trainer, module) -> None:
        if trainer.state.fn == "fit" and not trainer.sanity_checking:
            self._line(trainer)

    def on_train_end(self, trainer, module) -> None:
        self._line(trainer)
        self.bar.stop()

    def on_exception(self, trainer, module, exception) -> None:
        if self.bar:
            self.bar.stop()

    def _line(self, trainer) -> None:
        """A line about the present step, once."""
        self.spoke = time.monotonic()
        if self.last_shown == trainer.global_step or self.live or not trainer.is_global_zero:
            return
        self.last_shown = trainer.global_step
        of, done = f" of {self.total}" if self.total else "", trainer.global_step - self.first
        if self.total and done > 0 and trainer.global_step < self.total:
            left = (time.monotonic() - self.began) / done * (self.total - trainer.global_step)
            of += f", about {duration(left)} to go"
        print(f"step {trainer.global_step}{of}: {_logged(trainer)}", file=sys.stderr, flush=True)


def _logged(trainer) -> str:
    return ", ".join(f"{name} {float(value):.4g}" for name, value in trainer.progress_bar_metrics.items())
