"""Intervals by the bootstrap over patients: known distributions, patients kept whole, differences paired."""

from __future__ import annotations

import math

import numpy as np
import pytest

from phydict.evaluation.bootstrap import Estimate, difference, draws, estimate


def test_the_interval_of_normal_values_is_that_of_their_mean():
    values = np.random.default_rng(3).normal(20, 2, 400)
    got = estimate({f"p{i}": v for i, v in enumerate(values)})
    half = 1.96 * values.std() / 20
    assert got.mean == pytest.approx(values.mean())
    assert got.low == pytest.approx(got.mean - half, abs=0.1 * half)
    assert got.high == pytest.approx(got.mean + half, abs=0.1 * half)


def test_the_interval_covers_the_expectation_in_about_95_of_100_samples():
    random = np.random.default_rng(0)
    covered = 0
    for _ in range(400):
        got = estimate({f"p{i}": v for i, v in enumerate(random.exponential(1.0, 60))})
        covered += got.low <= 1 <= got.high
    assert 0.90 < covered / 400 < 0.97


def test_of_two_patients_the_ends_are_their_values():
    got = estimate({"a": 1.0, "b": 3.0})
    assert got == (2.0, 1.0, 3.0) and f"{got:.1f}" == "2.0 [1.0, 3.0]"


def test_a_patient_is_drawn_with_all_of_its_cases():
    values = {"train_1_a_1": 1.0, "train_1_a_2": 1.0, "train_1_b_1": 1.0, "train_2_a_1": 5.0}
    got = estimate(values)
    assert got == (2.0, 1.0, 5.0)
    apart = estimate({f"p{i}": v for i, v in enumerate(values.values())})
    assert apart.high < 5


def test_one_patient_and_infinite_values_have_no_interval():
    for values in ({"train_1_a_1": 1.0, "train_1_b_1": 3.0}, {"a": math.inf, "b": 1.0}):
        got = estimate(values)
        assert math.isnan(got.low) and math.isnan(got.high) and "[" not in f"{got:.2f}"


def test_a_difference_is_paired_and_of_common_cases_alone():
    spread = {f"p{i}": 10.0 * i for i in range(8)}
    better = {case: value + 1 for case, value in spread.items()} | {"another": -1e3}
    assert difference(better, spread) == Estimate(1.0, 1.0, 1.0)
    assert estimate(spread).high - estimate(spread).low > 10
    assert difference(better, {}) is None


def test_every_draw_has_as_many_patients_as_there_are():
    counts = draws(7)
    assert (counts.sum(1) == 7).all() and counts.mean(0) == pytest.approx(np.ones(7), abs=0.05)
