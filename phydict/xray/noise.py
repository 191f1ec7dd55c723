"""Random numbers of a measurement that depend on the seed alone: not on the device, hardly on rounding.

A pixel's count is the Poisson quantile of its own uniform number. A rate that differs in its last digit, as between
devices, then changes a count by at most one and leaves all other pixels alone; a rejection sampler would go astray.
"""

from __future__ import annotations

import torch

EXACT_BELOW = 64.0
"""Counts expected per pixel from which the quantile is approximated."""


def normal(like: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
    """Standard normal numbers (float64) of the shape and on the device of `like`, from a generator on the CPU."""
    return torch.randn(like.shape, generator=generator, dtype=torch.float64).to(like.device)


def poisson(rate: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
    """Poisson counts (float64) of the expected counts `rate` >= 0, on its device, from a generator on the CPU.

    Below EXACT_BELOW the exact quantile, by summing probabilities; above, its expansion
    rate + sqrt(rate) z + (z^2 - 1) / 6 (Fisher and Cornish 1960, Technometrics 2:209), rounded.
    """
    uniform = torch.rand(rate.shape, generator=generator, dtype=torch.float64).clamp(1e-16, 1 - 1e-16).to(rate.device)
    rate = rate.double()
    z = torch.special.ndtri(uniform)
    counts = (rate + rate.sqrt() * z + (z.square() - 1) / 6).round().clamp(min=0)
    few = rate < EXACT_BELOW
    counts[few] = _quantile(rate[few], uniform[few])
    return counts


def _quantile(rate: torch.Tensor, uniform: torch.Tensor) -> torch.Tensor:
    """The smallest count whose cumulative probability is not below `uniform`."""
    probability = torch.exp(-rate)
    below, counts = probability.clone(), torch.zeros_like(rate)
    for n in range(1, int(EXACT_BELOW + 12 * EXACT_BELOW**0.5)):
        counts += below < uniform
        probability = probability * rate / n
        below = below + probability
    return counts
