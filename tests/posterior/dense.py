"""A measurement small enough to be a matrix, and the posterior of a Gaussian prior under it, in closed form."""

from __future__ import annotations

import torch
from laws import random_like
from torch import Tensor

from phydict.diffusion import CosineSchedule, Denoiser, GaussianDenoiser
from phydict.linalg.total_variation import UNIT
from phydict.posterior import Sampler

SHAPE = (1, 1, 2, 3)
N = 6
V = 0.04
"""The variance of the prior's components."""

X = random_like((1, *SHAPE), seed=10)
"""What samplers begin with."""

FINE = CosineSchedule(offset=1e-3, floor=1e-6)
"""A schedule whose ends are so close to pure state and pure noise that they do not show in the closed forms."""


class DenseMeasurement:
    """y = A x + background, on states (B, 1, 1, 2, 3); stands in for phydict.posterior.Measurement."""

    scales, model_variance, display = UNIT, 0.0, None

    def __init__(self, matrix: Tensor, y: Tensor, background: float = 0.0):
        self.matrix, self.y, self.background, self.calls = matrix, y[None], background, 0

    def project(self, x: Tensor) -> Tensor:
        return self.linear(x) + self.background

    def linear(self, d: Tensor) -> Tensor:
        self.calls += 1
        return d.flatten(1) @ self.matrix.to(d).T

    def adjoint(self, r: Tensor) -> Tensor:
        self.calls += 1
        return (r @ self.matrix.to(r)).view(len(r), *SHAPE)

    def mean_diagonal(self, weights: Tensor | float = 1.0) -> float:
        return float((weights * self.matrix.square().T).sum()) / N

    def norm(self) -> float:
        return float(torch.linalg.matrix_norm(self.matrix, 2))

    def refit(self, x: Tensor) -> None:
        """y holds nothing beside the state."""

    match_gain_offset = refit


def measurement(rows: int = 4, background: float = 0.05) -> DenseMeasurement:
    return DenseMeasurement(random_like((rows, N), seed=1), 0.2 * random_like((rows,), seed=2), background)


def denoiser(variance: float = V, schedule: CosineSchedule = FINE) -> GaussianDenoiser:
    """A Gaussian prior whose samples stay well inside [-1, 1], so that clamping never acts."""
    return GaussianDenoiser(0.1 * random_like((1, *SHAPE), seed=3), torch.tensor(variance).double(), schedule)


def sample(settings: Sampler, x: Tensor = X, data: DenseMeasurement | None = None, seed: int = 0,
           prior: Denoiser | None = None) -> Tensor:
    """What a sampler makes of noise x (B, 1, 1, 2, 3), of `measurement` and `denoiser` where no others are given."""
    return settings.sample(prior or denoiser(), data or measurement(), x, torch.Generator().manual_seed(seed))


class WithMask:
    """A Gaussian prior of a CT and a mask, each of the variance and zero mean, whose voxels are `alike` correlated."""

    schedule = FINE

    def __init__(self, variance: float, alike: float):
        self.alike, self.covariance = alike, variance * torch.tensor([[1, alike], [alike, 1]]).double()

    def denoise(self, x: Tensor, t: float) -> Tensor:
        a, s = (w.to(x) for w in self.schedule.scales(t))
        gain = a * self.covariance @ torch.linalg.inv(a**2 * self.covariance + s**2 * torch.eye(2).to(x))
        return torch.einsum("cd,bd...->bc...", gain, x)

    def spreads(self, m: DenseMeasurement, noise: float) -> tuple[float, float]:
        """The summed variances of the CT and of the mask, given m."""
        variance = float(self.covariance[0, 0])
        ct = float(condition(m, torch.zeros(SHAPE).double(), variance, noise)[1].trace())
        return ct, N * variance * (1 - self.alike**2) + self.alike**2 * ct


def condition(m: DenseMeasurement, mean: Tensor, variance: float, noise: float) -> tuple[Tensor, Tensor]:
    """Mean (N,) and covariance (N, N) of N(mean, variance I) given m, whose errors have standard deviation noise."""
    precision = m.matrix.T @ m.matrix / noise**2 + torch.eye(N).double() / variance
    shift = m.matrix.T @ (m.y[0] - m.background) / noise**2 + mean.flatten() / variance
    return torch.linalg.solve(precision, shift), torch.linalg.inv(precision)


def moments(samples: Tensor) -> tuple[Tensor, Tensor]:
    """Mean (N,) and covariance (N, N) of samples (B, 1, 1, 2, 3)."""
    return samples.flatten(1).mean(0), samples.flatten(1).T.cov()


def assert_moments(samples: Tensor, mean: Tensor, covariance: Tensor, apart: float, share: float) -> None:
    """Samples have the mean within `apart`, and the covariance within a `share` of its norm."""
    found, spread = moments(samples)
    torch.testing.assert_close(found, mean.flatten(), atol=apart, rtol=0)
    assert (spread - covariance).norm() < share * covariance.norm()


def propagate(sample) -> tuple[Tensor, Tensor]:
    """Mean (N,) and covariance (N, N) of sample(x), x ~ N(0, I), for an affine `sample` of each case of a batch: exact,
    with no draws."""
    starts = torch.cat([torch.zeros(1, N), torch.eye(N)]).double()
    *ends, both = sample(torch.cat([starts, (starts[1] - 2 * starts[2])[None]]).view(-1, *SHAPE)).flatten(1)
    ends = torch.stack(ends)
    linear = (ends[1:] - ends[0]).T
    torch.testing.assert_close(both, ends[0] + linear[:, 0] - 2 * linear[:, 1], atol=1e-8, rtol=0)
    return ends[0], linear @ linear.T
