"""DDIM and renoising move a state along the path that its clean state and noise span."""

import pytest
import torch
from laws import random_like

from phydict.diffusion import CosineSchedule, ddim, renoise

SCHEDULE = CosineSchedule()
X0, NOISE = random_like((2, 1, 3, 4, 5), seed=1), random_like((2, 1, 3, 4, 5), seed=2)


@pytest.mark.parametrize("t", [0.0, 0.3, 1.0])
def test_a_move_to_the_same_time_is_the_identity_whatever_the_estimate(t):
    torch.testing.assert_close(ddim(SCHEDULE, X0, NOISE, t, t), NOISE)


@pytest.mark.parametrize("t, s", [(1.0, 0.7), (0.5, 0.2), (0.2, 0.0), (0.2, 0.6)])
def test_with_the_true_clean_state_ddim_stays_on_its_path(t, s):
    x = renoise(SCHEDULE, X0, t, NOISE)
    signal, noise = SCHEDULE.scales(s)
    torch.testing.assert_close(ddim(SCHEDULE, X0, x, t, s), signal * X0 + noise * NOISE)
    torch.testing.assert_close(ddim(SCHEDULE, X0, x, t, s), renoise(SCHEDULE, X0, s, NOISE))


def test_two_moves_with_one_estimate_are_one_move():
    direct = ddim(SCHEDULE, X0, NOISE, 0.9, 0.1)
    torch.testing.assert_close(ddim(SCHEDULE, X0, ddim(SCHEDULE, X0, NOISE, 0.9, 0.4), 0.4, 0.1), direct)


def test_the_moves_keep_the_states_precision():
    for dtype in (torch.float32, torch.float64):
        x0, noise = X0.to(dtype), NOISE.to(dtype)
        assert ddim(SCHEDULE, x0, noise, 0.5, 0.2).dtype == renoise(SCHEDULE, x0, 0.5, noise).dtype == dtype


@pytest.mark.parametrize("t", [0.1, 0.5, 0.9])
def test_renoising_has_the_schedules_mean_and_variance(t):
    n, x0 = 200_000, 0.6
    x = renoise(SCHEDULE, torch.full((n,), x0, dtype=torch.float64), t, random_like((n,), seed=3))
    signal, noise = (float(w) for w in SCHEDULE.scales(t))
    assert float(x.mean()) == pytest.approx(signal * x0, abs=4 * noise / n**0.5)
    assert float(x.var()) == pytest.approx(noise**2, rel=4 * (2 / n) ** 0.5)
