"""Total variation beside the X-rays: ADMM passes whose dual variable lives as long as the sampling."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from phydict.linalg.conjugate_gradients import conjugate_gradients
from phydict.linalg.total_variation import differences, differences_adjoint
from phydict.posterior.normalised import NormalisedMeasurement
from phydict.runtime.ranges import LEAST, MOST, check_fields


@dataclass(frozen=True)
class ADMMTV:
    """Passes of ADMM towards argmin |P(x) - y|^2 / 2 + weight |D x|_1, D the differences along `axes`.

    Boyd et al. 2011, doi:10.1561/2200000016.

    Args:
        weight: the published lambda, 0.04 for few views and 0.4 for a limited arc, in units of an operator of norm 1
        rho: penalty of the split
        axes: of "xyz", published as "z" alone
    """

    weight: float = 0.04
    rho: float = 10.0
    axes: str = "z"

    def __post_init__(self):
        if not self.axes or set(self.axes) - set("xyz") or len(set(self.axes)) < len(self.axes):
            raise ValueError(f"the axes of total variation are of 'xyz', each once, but '{self.axes}' was given")
        check_fields(self, "ADMMTV", weight=(0, MOST), rho=(LEAST, MOST))

    def begin(self, x: Tensor) -> ADMMPasses:
        """The passes of one sampling; x (B, 1, X, Y, Z) gives sizes alone."""
        return ADMMPasses(self, x)


class ADMMPasses:
    """Calls x -> x, one pass each; the split and the dual variable are kept from call to call, zero at first."""

    def __init__(self, settings: ADMMTV, x: Tensor):
        self.settings, self.scales = settings, [float(axis in settings.axes) for axis in "xyz"]
        self.split = self.dual = x.new_zeros(3, *x.shape)

    def __call__(self, measurement: NormalisedMeasurement, x: Tensor, iterations: int) -> Tensor:
        """x after at most `iterations` of conjugate gradients from x, and one shrinkage."""
        rho, limit = self.settings.rho, self.settings.weight / self.settings.rho

        def normal(d: Tensor) -> Tensor:
            smooth = differences_adjoint(differences(d, self.scales), self.scales)
            return measurement.adjoint(measurement.linear(d)) + rho * smooth

        pull = differences_adjoint(self.split - self.dual - differences(x, self.scales), self.scales)
        right = measurement.adjoint(measurement.y - measurement.project(x)) + rho * pull
        x = x + conjugate_gradients(normal, right, iterations)
        moved = differences(x, self.scales) + self.dual
        self.dual = moved.clamp(-limit, limit)
        self.split = moved - self.dual
        return x
