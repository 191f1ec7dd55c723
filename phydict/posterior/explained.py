"""Running a method again where its X-rays hold more than a CT explains: hardening, scatter and metal."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from torch import Tensor

from phydict.posterior.hardening import with_hardening
from phydict.posterior.measurement import Measurement
from phydict.posterior.metal import Metal, with_metal
from phydict.posterior.scatter import with_scatter


def explained(measurement: Measurement, run: Callable[[Callable[[], None]], Tensor], on_step: Callable[[], None],
              metal: Metal | None, scatter: bool = True, hardening: bool = True) -> Tensor:
    """The states (B, C, X, Y, Z) that `run` finds once metal, scatter and beam hardening, as far as they are sought,
    are taken into account. Each of them may need a second run.

    run: takes what is called after each step: on_step in the first run, nothing in further ones.
    """
    def again() -> Tensor:
        return run(lambda: None)

    def without_metal(first: Callable[[], Tensor]) -> Tensor:
        straight = partial(with_hardening, measurement, first, again) if hardening else first
        return with_scatter(measurement, straight, again) if scatter else straight()

    return with_metal(measurement, metal, lambda: without_metal(lambda: run(on_step)), lambda: without_metal(again))
