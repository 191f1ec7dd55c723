"""The noise schedule keeps variance, never reaches its ends, and its steps form one chain down to time 0."""

import pytest
import torch

from phydict.diffusion import CosineSchedule

pytestmark = pytest.mark.smoke

SCHEDULES = [CosineSchedule(), CosineSchedule(offset=0.02, floor=1e-3)]


@pytest.mark.parametrize("schedule", SCHEDULES)
def test_the_signal_falls_with_time_and_stays_inside_the_clamp(schedule):
    alpha_bar = schedule.alpha_bar(torch.linspace(0, 1, 1001, dtype=torch.float64))
    assert (alpha_bar.diff() <= 0).all()
    assert (alpha_bar.diff()[50:-50] < 0).all()
    assert alpha_bar.min() == schedule.floor and alpha_bar.max() <= 1 - schedule.floor
    assert schedule.alpha_bar(0.0) > 0.99


@pytest.mark.parametrize("schedule", SCHEDULES)
def test_the_squares_of_the_scales_sum_to_one(schedule):
    t = torch.linspace(0, 1, 101, dtype=torch.float64)
    signal, noise = schedule.scales(t)
    torch.testing.assert_close(signal**2 + noise**2, torch.ones_like(t))
    torch.testing.assert_close(schedule.sigma(t), noise / signal)
    assert (signal > 0).all() and (noise > 0).all() and schedule.sigma(t).isfinite().all()


def test_a_number_is_taken_in_double_precision_and_a_tensor_in_its_own():
    schedule = CosineSchedule()
    assert schedule.alpha_bar(0.3).dtype == torch.float64
    assert schedule.alpha_bar(torch.tensor([0.3, 0.4])).dtype == torch.float32
    assert float(schedule.alpha_bar(torch.tensor(0.3))) == pytest.approx(float(schedule.alpha_bar(0.3)), rel=1e-5)


def test_the_schedule_is_the_papers_cosine_between_the_clamps():
    expected = torch.cos(torch.tensor((0.5 + 0.008) / 1.008 * torch.pi / 2, dtype=torch.float64)) ** 2
    torch.testing.assert_close(CosineSchedule().alpha_bar(0.5), expected)


@pytest.mark.parametrize("n", [1, 2, 7, 50])
@pytest.mark.parametrize("start", [1.0, 0.7, 0.05])
def test_steps_are_one_chain_from_start_to_zero(n, start):
    pairs = list(CosineSchedule().steps(n, start))
    assert len(pairs) == n and pairs[0][0] == start and pairs[-1][1] == 0
    assert all(t > s for t, s in pairs)
    assert [s for _, s in pairs[:-1]] == pytest.approx([t for t, _ in pairs[1:]], abs=1e-15)
    assert [t - s for t, s in pairs] == pytest.approx([start / n] * n)


@pytest.mark.parametrize("n, start, message", [
    (0, 1.0, "at least one step"), (-3, 1.0, "at least one step"), (5, 0.0, "in \\(0, 1\\]"), (5, 1.1, "in \\(0, 1\\]"),
    (5, float("nan"), "in \\(0, 1\\]")])
def test_impossible_steps_are_refused(n, start, message):
    with pytest.raises(ValueError, match=message):
        list(CosineSchedule().steps(n, start))
