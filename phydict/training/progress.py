"""How far a training is: a bar over its steps on a terminal, lines in a log file, JSON for machines, or nothing."""

from __future__ import annotations

import math
import time

import lightning
from rich.console import Console
from rich.progress import Progress, TextColumn

from phydict.runtime.progress import CaseProgress, to_go
from phydict.runtime.progress_log import bars_on, log_progress

BAR_METRICS = ("loss", "val/psnr")
"""Of what is logged, what the bar has room for."""


class TrainingProgress(lightning.Callback):
    """Tells the steps that are done and what they log, and the cases of a validation that takes long.

    Args:
        interval: seconds between two lines where the output is no terminal
    """

    def __init__(self, interval: float = 60.0):
        self.interval = interval
        self.bar: Progress = None  # type: ignore[assignment]  # from the start of training on
        self.cases: CaseProgress | None = None

    def on_train_start(self, trainer, module) -> None:
        steps = trainer.estimated_stepping_batches
        self.first, self.began = trainer.global_step, time.monotonic()
        self.spoke, self.last_shown = self.began, -1
        self.total = steps if math.isfinite(steps) and steps > 0 else None
        console = Console(stderr=True)
        self.bar = bars_on(console, TextColumn("{task.fields[logged]}"))
        self.bar.disable |= not trainer.is_global_zero
        of = f" of {self.total}" if self.total else ""
        self._log(trainer, f"training: step {self.first}{of}, results in {trainer.default_root_dir}", event="begin",
                  name="training", step=self.first, steps=self.total, out=trainer.default_root_dir)
        self.task = self.bar.add_task("training", total=self.total, completed=self.first, logged="")
        self.bar.start()

    def on_train_batch_end(self, trainer, module, outputs, batch, index) -> None:
        self.bar.update(self.task, completed=trainer.global_step, logged=_in_words(
            {name: value for name, value in _logged(trainer).items() if name in BAR_METRICS}))
        if time.monotonic() - self.spoke > self.interval:
            self._line(trainer)

    def on_validation_start(self, trainer, module) -> None:
        if trainer.state.fn == "validate" and trainer.is_global_zero:
            self.cases = CaseProgress().__enter__()
            self.cases.begin("validate", sum(trainer.num_val_batches), verb="measure")

    def on_validation_batch_end(self, trainer, module, outputs, batch, index, loader=0) -> None:
        if self.cases:
            self.cases.case(f"case {index + 1}")
            self.cases.finished("measured")
        elif self._fits(trainer) and self.bar.disable and time.monotonic() - self.spoke > self.interval:
            self.spoke, cases = time.monotonic(), sum(trainer.num_val_batches)
            self._log(trainer, f"validation: {index + 1} of {cases} cases", event="validation", done=index + 1,
                      cases=cases)

    def on_validation_end(self, trainer, module) -> None:
        if self._fits(trainer):
            self._line(trainer)
        self._close()

    def on_train_end(self, trainer, module) -> None:
        self._line(trainer)
        self.bar.stop()

    def on_exception(self, trainer, module, exception) -> None:
        if self.bar:
            self.bar.stop()
        self._close()

    def _close(self) -> None:
        if self.cases:
            self.cases.__exit__()
            self.cases = None

    def _line(self, trainer) -> None:
        """A line about the present step, once."""
        self.spoke, step = time.monotonic(), trainer.global_step
        if self.last_shown == step or not self.bar.disable:
            return
        self.last_shown = step
        of, done, left = f" of {self.total}" if self.total else "", step - self.first, None
        if self.total and done > 0:
            left = round((time.monotonic() - self.began) / done * max(self.total - step, 0), 1)
        logged = _logged(trainer)
        self._log(trainer, f"step {step}{of}{to_go(left or 0)}: {_in_words(logged)}", event="step", step=step,
                  steps=self.total, seconds_to_go=left, **logged)

    @staticmethod
    def _fits(trainer) -> bool:
        """Whether a training has begun."""
        return trainer.state.fn == "fit" and not trainer.sanity_checking

    @staticmethod
    def _log(trainer, text: str, **event) -> None:
        if trainer.is_global_zero:
            log_progress(text, **event)


def _logged(trainer) -> dict[str, float]:
    return {name: float(value) for name, value in trainer.progress_bar_metrics.items()}


def _in_words(logged: dict[str, float]) -> str:
    return ", ".join(f"{name} {value:.4g}" for name, value in logged.items())
