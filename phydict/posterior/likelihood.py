"""The likelihood step: from the prior's clean estimate towards the X-rays.

Both steps minimise (or descend) a data term plus a term that keeps z near the denoiser's estimate x0.
They act on the CT channel; the other channels of the state pass through.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field

import torch
from torch import Tensor

from phydict.posterior.measurement import Measurement
from phydict.posterior.reward import Reward


class LikelihoodStep(ABC):
    """z = step(measurement, x0, spread): x0 and z (B, 1, X, Y, Z); spread is the standard deviation of x0's error."""

    @abstractmethod
    def __call__(self, measurement: Measurement, x0: Tensor, spread: float) -> Tensor: ...


@dataclass(frozen=True)
class ProximalCG(LikelihoodStep):
    """argmin_z |P(z) - y|^2 / noise^2 + |z - x0|^2 / spread^2, by conjugate gradients started at x0.

    With a Gaussian prior and enough iterations this is exactly E[x_0 | x_t, y]. Few iterations regularise: the
    directions that the views see best are corrected first.

    iterations: at most this many; noise: standard deviation of the line integrals' error (noise and model);
    tolerance: stop once the normal equations' residual has shrunk by this factor. Hestenes & Stiefel 1952; as a
    data-consistency step Chung et al. 2024, arXiv:2303.05754.
    """

    iterations: int = 6
    noise: float = 0.02
    tolerance: float = 1e-6

    def __call__(self, measurement: Measurement, x0: Tensor, spread: float) -> Tensor:
        weight = (self.noise / spread) ** 2
        residual = measurement.adjoint(measurement.y - measurement.project(x0))
        direction, correction = residual.clone(), torch.zeros_like(x0)
        energy = residual.square().sum()
        stop = energy * self.tolerance**2
        for _ in range(self.iterations):
            if energy <= stop:
                break
            curved = measurement.adjoint(measurement.linear(direction)) + weight * direction
            step = energy / (direction * curved).sum()
            correction += step * direction
            residual -= step * curved
            previous, energy = energy, residual.square().sum()
            direction = residual + (energy / previous) * direction
        return x0 + correction


@dataclass(frozen=True)
class GradientSteps(LikelihoodStep):
    """The paper's step: a few Adam steps on J(Y, z) + |z - x0|^2 / rho, started at x0.

    The text gives two gradient steps of 0.1 and rho = 1; Adam is what the authors' release uses, with a fresh state
    at every time. The spread is not used.
    """

    steps: int = 2
    learning_rate: float = 0.1
    rho: float = 1.0
    reward: Reward = field(default_factory=Reward)

    def __call__(self, measurement: Measurement, x0: Tensor, spread: float) -> Tensor:
        with torch.enable_grad():
            z = x0.detach().clone().requires_grad_(True)
            adam = torch.optim.Adam([z], self.learning_rate)
            for _ in range(self.steps):
                adam.zero_grad()
                loss = (z - x0).square().sum() / self.rho - self.reward(measurement, z).sum()
                loss.backward()
                measurement.calls += 1  # autograd's use of the adjoint
                adam.step()
        return z.detach()
