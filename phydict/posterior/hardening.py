"""Reconstructing again with line integrals straightened, where they bend as those of a tube do."""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor

from phydict.posterior.measurement import Measurement
from phydict.xray.calibration import bend

BENT = 8e-5
"""Bend that line integrals show against those of what was made of them, from which on a tube's are supposed where their
residual is large as well: on the CTs that it was chosen on, ideal ones show 0.8e-4 at most, counted ones and those of
wrong poses none, and polychromatic ones from four views on 0.8e-4 to 13e-4."""

RESIDUAL, LEFT = 1.1, 0.95
"""The residual of bent line integrals, in units of their noise, from which on they are straightened (on the same CTs
ideal ones have 0.93 at most), and what must be left of it: 0.30 to 0.86 of polychromatic ones is."""


def with_hardening(measurement: Measurement, first: Callable[[], Tensor], again: Callable[[], Tensor]) -> Tensor:
    """The states (1, C, X, Y, Z) of `first`; where line integrals bend against theirs as a tube's do, those of `again`,
    run with straight ones, if their residual is smaller."""
    z = first()
    if measurement.hardened or not measurement.can_estimate_scatter:
        return z
    reprojection = measurement.project(z[:, :1])
    residual = float(measurement.normalised_error(reprojection).max())
    if residual <= RESIDUAL or bend(measurement.y[0], reprojection.mean(0), measurement.mu_water) <= BENT:
        return z
    plain = measurement.fitted
    measurement.straighten()
    straight = again()
    if float(measurement.normalised_residual(straight[:, :1]).max()) < LEFT * residual:
        return straight
    measurement.fitted = plain
    return z
