"""Counting noise: the Poisson law at every rate, from each pixel's own random number."""

import pytest
import torch

from phydict.xray.noise import EXACT_BELOW, poisson


def draw(rate: torch.Tensor, seed: int = 0) -> torch.Tensor:
    return poisson(rate, torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("rate", [0.02, 0.7, 5.0, EXACT_BELOW - 1, EXACT_BELOW + 1, 1e3, 1e7])
def test_mean_variance_and_skewness_are_poissons(rate):
    n = 200_000
    counts = draw(torch.full((n,), rate, dtype=torch.float64))
    assert (counts == counts.round()).all() and float(counts.min()) >= 0
    deviation = counts - rate
    assert float(deviation.mean()) == pytest.approx(0, abs=5 * (rate / n)**0.5)
    assert float(deviation.square().mean()) == pytest.approx(rate, rel=0.02 + 5 / (rate * n)**0.5)
    skewness = float(deviation.pow(3).mean()) / rate**1.5
    assert skewness == pytest.approx(rate**-0.5, rel=0.1, abs=0.03)


@pytest.mark.parametrize("rate", [0.5, 20.0, EXACT_BELOW - 1e-6, EXACT_BELOW])
def test_frequencies_are_poissons_probabilities(rate):
    n = 400_000
    counts = draw(torch.full((n,), rate, dtype=torch.float64))
    k = torch.arange(0, int(rate + 8 * rate**0.5) + 2, dtype=torch.float64)
    expected = n * torch.exp(k * torch.tensor(rate).double().log() - rate - torch.lgamma(k + 1))
    found = torch.stack([(counts == c).sum() for c in k]).double()
    often = expected > 10
    chi = ((found - expected)**2 / expected)[often].sum() / often.sum()
    assert float(chi) < 2


def test_no_light_counts_nothing_and_light_in_one_pixel_moves_no_other():
    assert not draw(torch.zeros(100)).any()
    rate = torch.full((1000,), 30.0, dtype=torch.float64)
    changed = rate.clone()
    changed[10] = 5000.0
    before, after = draw(rate), draw(changed)
    after[10] = before[10]
    assert torch.equal(before, after)


def test_more_light_never_counts_less():
    rates = torch.linspace(0, 3 * EXACT_BELOW, 2000, dtype=torch.float64)
    for seed in range(3):
        uniform = torch.stack([draw(r.view(1), seed)[0] for r in rates[::20]])
        assert (uniform.diff() >= -1).all()
