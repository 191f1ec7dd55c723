"""Intervals by the bootstrap over patients: patients are drawn with replacement, each with all of its cases.

Efron 1979, doi:10.1214/aos/1176344552; percentiles of REPLICATES draws. The draws are the same for every measure and
method, so that differences of methods are paired. With a few patients the interval is narrower than it should be: of
four, a draw knows 35 different sets at most.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from phydict.datasets.cts.ct_rate import patient_of

LEVEL, REPLICATES, SEED = 0.95, 10_000, 0


class Estimate(NamedTuple):
    """A mean and the ends of its interval, NaN where there is none; prints as mean [low, high]."""

    mean: float
    low: float = math.nan
    high: float = math.nan

    def __float__(self) -> float:
        return self.mean

    def __format__(self, spec: str) -> str:
        return format(self.mean, spec) + bounds(self.low, self.high, spec)


def bounds(low: float, high: float, spec: str) -> str:
    """The ends of an interval as " [low, high]"; nothing where they are NaN."""
    return "" if math.isnan(low + high) else f" [{format(low, spec)}, {format(high, spec)}]"


def patients(cases: Iterable[str]) -> int:
    """How many patients cases are of, by their ids (`patient_of`)."""
    return len(set(map(patient_of, cases)))


@lru_cache(maxsize=8)
def draws(patients: int, replicates: int = REPLICATES) -> np.ndarray:
    """How often each patient is drawn: (replicates, patients) counts, each row of sum `patients`."""
    return np.random.default_rng(SEED).multinomial(patients, np.full(patients, 1 / patients), replicates)


def percentiles(values: np.ndarray) -> tuple[float, float]:
    """The ends of the interval of LEVEL that bootstrapped `values` give, NaN where one of them is not finite."""
    if not np.isfinite(values).all():
        return math.nan, math.nan
    low, high = np.quantile(values, [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
    return float(low), float(high)


def estimate(values: Mapping[str, float]) -> Estimate:
    """The mean over cases, case id -> value, and its interval; without one for a single patient or infinite values."""
    names = list(dict.fromkeys(map(patient_of, values)))
    place = {name: i for i, name in enumerate(names)}
    sums, counts = np.zeros(len(names)), np.zeros(len(names))
    for case, value in values.items():
        sums[place[patient_of(case)]] += value
        counts[place[patient_of(case)]] += 1
    mean = float(np.mean(list(values.values())))
    if len(names) < 2 or not math.isfinite(mean):
        return Estimate(mean)
    drawn = draws(len(names))
    return Estimate(mean, *percentiles(drawn @ sums / (drawn @ counts)))


def difference(values: Mapping[str, float], others: Mapping[str, float]) -> Estimate | None:
    """The mean over the cases that both have of `values` less `others`, paired case by case; None without any."""
    common = [case for case in values if case in others]
    return estimate({case: values[case] - others[case] for case in common}) if common else None
