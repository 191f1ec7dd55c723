"""A measurement in units in which its operator has norm 1, as the published samplers' constants assume."""

from __future__ import annotations

from torch import Tensor

from phydict.linalg.conjugate_gradients import conjugate_gradients
from phydict.posterior.measurement import Measurement
from phydict.runtime.ranges import LEAST, MOST, check_between


class NormalisedMeasurement:
    """`measurement` with line integrals, operator and noise divided by |A|, the operator's largest singular value.

    noise: standard deviation of the line integrals' errors, given in their own units and kept as `noise` in the new.
    Volumes keep their range. Raises ValueError where the noise is not between LEAST and MOST, or the operator sees
    nothing.
    """

    def __init__(self, measurement: Measurement, noise: float):
        check_noise(noise)
        self.measurement, self.scale = measurement, measurement.norm()
        if not self.scale > 0:
            raise ValueError("no ray of this geometry meets the volume, so that nothing can be reconstructed: "
                             "check the geometry's units and the volume's place")
        self.noise = noise / self.scale

    @property
    def y(self) -> Tensor:
        """Line integrals (1, K, V, U) / |A|."""
        return self.measurement.y / self.scale

    def project(self, x: Tensor) -> Tensor:
        """P(x) / |A|: (B, 1, X, Y, Z) -> (B, K, V, U)."""
        return self.measurement.project(x) / self.scale

    def linear(self, d: Tensor) -> Tensor:
        """The linear part of `project`, for differences of CTs; its norm is 1."""
        return self.measurement.linear(d) / self.scale

    def adjoint(self, r: Tensor) -> Tensor:
        """The exact adjoint of `linear`."""
        return self.measurement.adjoint(r) / self.scale


def check_noise(noise: float) -> None:
    """Raises ValueError unless the noise of the line integrals lies between LEAST and MOST."""
    check_between("the noise of the line integrals, the standard deviation of their error,", noise, LEAST, MOST)


def nearest_fit(measurement: NormalisedMeasurement, x: Tensor, weight: float, iterations: int,
                tolerance: float = 1e-6, y: Tensor | None = None) -> Tensor:
    """argmin over z of |P(z) - y|^2 + weight |z - x|^2 by conjugate gradients from x (B, 1, X, Y, Z).

    y: the measured line integrals unless others are given. weight 0: of all least-squares solutions the one nearest x.
    """
    residual = (measurement.y if y is None else y) - measurement.project(x)
    return x + conjugate_gradients(lambda d: measurement.adjoint(measurement.linear(d)) + weight * d,
                                   measurement.adjoint(residual), iterations, tolerance)
