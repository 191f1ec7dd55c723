"""The likelihood step: from the prior's clean estimate towards the X-rays.

Both steps minimise (or descend) a data term plus a term that keeps z near the denoiser's estimate x0; ProximalCG may
add total variation.
They act on the CT channel; the other channels of the state pass through.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from phydict.linalg.conjugate_gradients import conjugate_gradients, may_follow, most_kept
from phydict.linalg.total_variation import TVQuadraticMajorizer
from phydict.posterior.likelihood.reward import Reward
from phydict.posterior.measurement import Measurement
from phydict.runtime.ranges import LEAST, MOST, check_fields

LONG = 12
"""Iterations of one restart beyond which residuals are kept orthogonal."""

MOST_SMOOTHING = 10.0
"""Most by which model error raises the weight of total variation."""


class LikelihoodStep(ABC):
    """z = step(measurement, x0, x0_std): x0 and z (B, 1, X, Y, Z); x0_std is the standard deviation of x0's error.

    batches: whether the states of a batch do not influence each other. kept: how many volumes it keeps beside the few
    that any step needs.
    """

    batches = True
    kept = 0

    @abstractmethod
    def __call__(self, measurement: Measurement, x0: Tensor, x0_std: float) -> Tensor: ...


@dataclass(frozen=True)
class ProximalCG(LikelihoodStep):
    """Towards argmin over z in [-1, 1] of |P(z) - y|^2 / noise^2 + |z - x0|^2 / x0_std^2 + 2 tv_weight TV(z), by
    conjugate gradients.

    Starts at x0. Each restart frees the voxels that are inside the range or pulled back into it, runs conjugate
    gradients on them and clips: air stays air, which is worth more than many iterations without the bounds. With a
    Gaussian prior, no total variation, bounds that do not act and enough iterations this is exactly E[x_0 | x_t, y];
    few iterations regularise, since what the views see best is corrected first. TV(z) sums sqrt(slope^2 + tv_eps^2)
    over the voxels, the differences along coarser axes scaled down to the finest spacing.

    Each restart replaces TV by the quadratic that touches it there (Vogel & Oman 1996, doi:10.1137/0917016), so the
    last step wants several, and conjugate gradients are preconditioned by the diagonal of that quadratic, which differs
    by orders between flat parts and edges.
    The `model_variance` of a measurement is added to noise^2.

    Hestenes & Stiefel 1952, doi:10.6028/jres.049.044; with bounds, More & Toraldo 1991, doi:10.1137/0801008; as data
    consistency in diffusion sampling, Chung et al. 2024, arXiv:2303.05754.

    Args:
        iterations: of conjugate gradients per restart, at most; 0: z is x0, clipped. More than LONG keep a volume each
        restarts: how often conjugate gradients begin again; 0: z is x0, clipped
        noise: standard deviation of the line integrals' error (noise and model); 0: they are exact, beside which
            nothing else has a weight
        tolerance: a restart ends once its residual has shrunk by this factor, in [0, 1]
        refit_scatter: whether each restart refits the scatter of a measurement in which it is sought
        weighted_least_squares: whether the variance of each pixel's own noise is added to noise^2, so that pixels which
            few photons reach count less (Thibault et al. 2007, doi:10.1118/1.2789499)
        tv_weight: weight of the total variation TV, 0 for none
        tv_eps: differences between neighbours, in the prior's range, below which TV is smooth
        precondition_data: whether the preconditioner of total variation holds the mean diagonal of the X-rays' term as
            well, with which fewer iterations come as near to the minimum; without total variation it changes nothing
        discrepancy: whether what a result misses of the X-rays beyond their noise, as in wrong poses, counts as noise
            (Morozov 1966): once more from x0, with tv_weight times the squared normalised residual, at most
            MOST_SMOOTHING
    """

    iterations: int = 5
    restarts: int = 2
    noise: float = 0.02
    tolerance: float = 1e-6
    refit_scatter: bool = False
    weighted_least_squares: bool = False
    tv_weight: float = 0.0
    tv_eps: float = 0.01
    precondition_data: bool = False
    discrepancy: bool = False

    def __post_init__(self):
        check_fields(self, "ProximalCG", iterations=(0, math.inf), restarts=(0, math.inf), noise=(0, MOST),
                     tolerance=(0, 1), tv_weight=(0, MOST), tv_eps=(LEAST, MOST))
        if not self.noise and (self.tv_weight or self.weighted_least_squares):
            raise ValueError("ProximalCG weighs total variation and the pixels' own noise by its noise, but a noise of "
                             "0 was given: give one above 0, or leave out tv_weight and weighted_least_squares")

    @property
    def batches(self) -> bool:  # type: ignore[override]
        """Not with a noise, of pixels or of the model, that is one for all states."""
        return not (self.weighted_least_squares or self.discrepancy)

    @property
    def kept(self) -> int:  # type: ignore[override]
        return most_kept(self.iterations) if self.iterations > LONG else 0

    def __call__(self, measurement: Measurement, x0: Tensor, x0_std: float) -> Tensor:
        weight = (self.noise / x0_std) ** 2
        z = x0.clamp(-1, 1)
        variance = measurement.model_variance + (measurement.noise_variance if self.weighted_least_squares else 0.0)
        if not self.noise and isinstance(variance, Tensor):
            raise ValueError("ProximalCG weighs what no volume explains by its noise, but a noise of 0 was given: give "
                             "one above 0")
        weights = 1 / (1 + variance / self.noise**2) if isinstance(variance, Tensor) else 1.0
        tv_scale = self.noise**2 * self.tv_weight
        diagonal = weight + (measurement.mean_diagonal(weights) if self.precondition_data and tv_scale else 0.0)
        for _ in range(self.restarts):
            reprojection = measurement.project(z)
            if self.refit_scatter:
                measurement.subtract_scatter(reprojection)
            negative_gradient = measurement.adjoint(weights * (measurement.y - reprojection)) + weight * (x0 - z)
            tv = TVQuadraticMajorizer(z, self.tv_eps, measurement.scales) if tv_scale else None
            if tv:
                negative_gradient = negative_gradient - tv_scale * tv.gradient(z)

            def normal(d, tv=tv):
                fitted = measurement.adjoint(weights * measurement.linear(d)).add_(d, alpha=weight)
                return fitted.add_(tv.gradient(d), alpha=tv_scale) if tv else fitted

            free = may_follow(z, negative_gradient, -1, 1)
            scale = 1 / (diagonal + tv_scale * tv.diagonal()) if tv else torch.ones_like(z)
            z = (z + conjugate_gradients(normal, negative_gradient * free, self.iterations, self.tolerance,
                                         scale * free, reorthogonalise=self.iterations > LONG)).clamp(-1, 1)
        if not (self.discrepancy and tv_scale):
            return z
        excess = float(measurement.normalised_residual(z, modelled=True).max()) ** 2
        if excess <= 1:
            return z
        smoother = replace(self, tv_weight=self.tv_weight * min(excess, MOST_SMOOTHING), discrepancy=False)
        return smoother(measurement, x0, x0_std)


@dataclass(frozen=True)
class GradientSteps(LikelihoodStep):
    """The paper's step: a few Adam steps on J(Y, z) + |z - x0|^2 / rho, started at x0.

    The text gives two gradient steps of 0.1 and rho = 1; Adam is what the authors' release uses, with a fresh state
    at every time. x0_std is not used.

    Args:
        steps: how many, 1 or more
        learning_rate: length of a step, above 0
        rho: the larger, the less the prior's estimate weighs; above 0
        reward: what the X-rays are compared by
        adam: Adam; else plain gradient descent, which diverges unless learning_rate (1 / rho + |A|^2 / K) < 1, with |A|
            the operator's norm and K the number of views
        prior_mean: the mean over voxels of |z - x0|^2 instead of the sum, as in the release
    """

    steps: int = 2
    learning_rate: float = 0.1
    rho: float = 1.0
    reward: Reward = field(default_factory=Reward)
    adam: bool = True
    prior_mean: bool = False

    def __post_init__(self):
        check_fields(self, "GradientSteps", steps=(1, math.inf), learning_rate=(LEAST, MOST), rho=(LEAST, MOST))

    @property
    def batches(self) -> bool:  # type: ignore[override]
        """Not with dropout, which is drawn for all states at once."""
        return not self.reward.dropout

    def __call__(self, measurement: Measurement, x0: Tensor, x0_std: float) -> Tensor:
        with torch.enable_grad():
            z = x0.detach().clone().requires_grad_(True)
            optimiser = (torch.optim.Adam if self.adam else torch.optim.SGD)([z], self.learning_rate)
            for _ in range(self.steps):
                optimiser.zero_grad()
                apart = (z - x0).square().flatten(1)
                apart = apart.mean(1) if self.prior_mean else apart.sum(1)
                loss = (apart / self.rho - self.reward(measurement, z)).sum()
                loss.backward()
                measurement.calls += len(z)  # autograd's use of the adjoint
                optimiser.step()
        return z.detach()
