"""The X-rays of one case as a linear problem in the prior's range.

mu = a x + b, so the projection of the CT channel is affine: P(x) = a A(x) + b A(1). Everything that does not depend
on x is computed once.
"""

from __future__ import annotations

from copy import copy
from typing import NamedTuple

import torch
from torch import Tensor

from phydict.linalg.total_variation import finest_to_own
from phydict.reconstruction import Reconstruction
from phydict.units import MU_WATER, HUWindow
from phydict.xray import Projector
from phydict.xray.calibration import match_views, subtract_scatter, without_hardening
from phydict.xray.carried import Carried
from phydict.xray.checks import prepared_xrays
from phydict.xray.noise_level import noise_level
from phydict.xray.residuals import shared_norms, worst_misfit

MAX_LINE_INTEGRAL = 30.0
"""Line integrals above which no photon comes through, so that they hold no scatter either; those below its negative
are of no signal that there is."""


class Fitted(NamedTuple):
    """What was found of X-rays beside the CT: fields of a Measurement.

    y, measured: line integrals without scatter or with gains matched, and with it.
    """

    y: Tensor
    measured: Tensor
    hardened: bool
    scatter_enabled: bool
    subgrid: Tensor | float
    model_variance: Tensor | float


class Measurement:
    """Line integrals y (1, K, V, U) and the affine operator P on CT volumes x (B, 1, X, Y, Z) in the prior's range.

    noise: standard deviation of the noise of y, as a share of its largest value or, as a tensor that expands to
    (K, V, U), of each pixel; None: estimated from y where it is needed. outside: line integrals (K, V, U) of what
    lies outside the voxels, which P adds. told: whether warnings about these X-rays were given before, and are not
    repeated.
    carried, beside: what is carried beside the CTs, such as metal, if anything, and its line integrals (K, V, U), which
    P adds. subgrid: line integrals (1, K, V, U) that P adds for what the voxels cannot resolve; 0 at first.
    model_variance: variance (K, 1, 1), beside the noise, of what no volume explains in a view's line integrals;
    ProximalCG counts it as noise; 0 at first.
    scales: per axis, the finest spacing of the voxels divided by their own.
    hardened: whether the line integrals were straightened as those of a tube.
    scatter_enabled: whether `subtract_scatter` subtracts scatter; calls: how many times A or its adjoint ran over all
    views, per volume of a batch; last_projection: what `project` last gave.
    """

    def __init__(self, projector: Projector, xrays: Tensor, window: HUWindow, display: bool = False,
                 mu_water: float = MU_WATER, noise: float | Tensor | None = None,
                 outside: Tensor | None = None, told: bool = False):
        xrays = prepared_xrays(xrays, projector.beam, display, told)
        self.noise, self.measured = noise, xrays[None]
        self.projector, self.display = projector, xrays[None] if display else None
        self.slope, self.offset = window.mu_affine(mu_water)
        self.background = self.offset * projector(torch.ones(1, 1, *projector.grid.shape).to(xrays))
        self.outside: Tensor | float = 0.0 if outside is None else outside
        self.subgrid: Tensor | float = 0.0
        self.model_variance: Tensor | float = 0.0
        self.beside: Tensor | float = 0.0
        self.carried: Carried | None = None
        self.window, self.mu_water = window, mu_water
        self.scales = finest_to_own(projector.grid.spacing)
        self.y = xrays[None]
        self._noise_of: tuple[Tensor | None, Tensor] = None, xrays  # the y that it was last estimated from, and it
        self.hardened = self.scatter_enabled = False
        self.calls = 1
        self.last_projection: Tensor | None = None

    def project(self, x: Tensor) -> Tensor:
        """P(x): line integrals (B, K, V, U) of the CT x."""
        self.calls += len(x)
        projected = self.slope * self.projector(x) + self.background + self.added
        self.last_projection = projected.detach()
        return projected

    def on(self, projector: Projector) -> Measurement:
        """The same X-rays, as they are now, as a problem on other voxels."""
        other = copy(self)
        other.background = self.offset * projector(torch.ones(1, 1, *projector.grid.shape).to(self.y))
        other.projector, other.scales = projector, finest_to_own(projector.grid.spacing)
        other.subgrid, other.calls = 0.0, 1
        return other

    def carry(self, carried: Carried | None) -> None:
        """From now on P adds what is carried beside the CTs."""
        self.carried = carried
        self.beside = 0.0 if carried is None else carried.projection(self.projector).to(self.y)

    def adopt(self, found: Reconstruction) -> None:
        """Holds of the X-rays what a reconstruction from them found beside the CT, on other voxels: what is carried,
        what counts as noise of a view, hardening, and whether there is scatter."""
        self.carry(found.carried)
        variance = found.model_variance
        self.model_variance = variance.to(self.y) if isinstance(variance, Tensor) else variance
        if found.hardened:
            self.straighten()
        self.reset_scatter(found.scatter > 0)

    @property
    def fitted(self) -> Fitted:
        """What was found of the X-rays beside the CT."""
        return Fitted(*(getattr(self, name) for name in Fitted._fields))

    @fitted.setter
    def fitted(self, found: Fitted) -> None:
        for name, value in found._asdict().items():
            setattr(self, name, value)

    @property
    def added(self) -> Tensor | float:
        """Line integrals that P adds to those of the voxels: of what lies outside or is carried, and of what the voxels
        cannot hold."""
        return self.outside + self.beside + self.subgrid

    def linear(self, d: Tensor) -> Tensor:
        """The linear part of P, for differences d of CTs."""
        self.calls += len(d)
        return self.slope * self.projector(d)

    def adjoint(self, r: Tensor) -> Tensor:
        """The exact adjoint of `linear`: (B, K, V, U) -> (B, 1, X, Y, Z)."""
        self.calls += len(r)
        return self.projector.T(self.slope * r)

    def mean_diagonal(self, weights: Tensor | float) -> float:
        """The mean of the diagonal of x -> adjoint(weights * linear(x)), by one volume of random signs (Hutchinson
        1990, doi:10.1080/03610919008812866)."""
        signs = torch.randint(2, (1, 1, *self.projector.grid.shape), generator=torch.Generator().manual_seed(0))
        signed = self.linear((2 * signs - 1).to(self.y))
        return float((weights * signed.square()).sum()) / signs.numel()

    def norm(self) -> float:
        """The largest singular value of `linear`."""
        return self.slope * self.projector.norm()

    @property
    def noise_variance(self) -> Tensor:
        """Variance (K, V, U) of the noise of each pixel of y."""
        if self.noise is None:
            if self._noise_of[0] is not self.y:
                self._noise_of = self.y, noise_level(self.y[0]).square()
            return self._noise_of[1]
        level = self.noise if isinstance(self.noise, Tensor) else self.noise * self.y.max()
        return level.square().expand(self.y.shape[1:])

    def normalised_residual(self, x: Tensor, modelled: bool = False) -> Tensor:
        """By how many times their noise the CTs x miss the X-rays, about 1 for the truth: (B, 1, 1, 1, 1).

        modelled: what `model_variance` says counts as noise.
        """
        return self.normalised_error(self.project(x), modelled)

    def normalised_error(self, projection: Tensor, modelled: bool = False) -> Tensor:
        """The normalised residual of CTs whose projections (B, K, V, U) are known."""
        residual = (projection - self.y).flatten(1).norm(dim=1)
        variance = self.noise_variance + (self.model_variance if modelled else 0.0)
        return (residual / variance.sum().clamp(min=1e-12).sqrt()).view(-1, 1, 1, 1, 1)

    def shared_misfit(self, x: Tensor) -> float:
        """The relative residual of the CTs x, the largest of a batch, without what is noise (`shared_norms`)."""
        return float(worst_misfit(self.project(x), self.y, shared_norms))

    def view_errors(self, projection: Tensor) -> Tensor:
        """Root mean square (K,) by which projections (1, K, V, U) miss the line integrals of each view, beyond what its
        noise does."""
        error = (projection - self.y)[0].square() - self.noise_variance
        return error.mean((1, 2)).clamp(min=0).sqrt()

    def match_gain_offset(self, x: Tensor) -> None:
        """Where the views are display values: refit their gain and offset to the projections of the CT x."""
        if self.display is not None:
            self.y = match_views(self.display, self.project(x))

    def refit(self, x: Tensor) -> None:
        """Refit what y holds beside the volume to the CT x: gains and offsets of display values, or scatter."""
        self.match_gain_offset(x)
        if self.scatter_enabled:
            self.subtract_scatter(self.project(x))

    def conclude(self, x: Tensor) -> Tensor:
        """P(x) of the result x, to which gains and offsets of display values are refit before, and scatter after."""
        self.match_gain_offset(x)
        reprojection = self.project(x)
        self.subtract_scatter(reprojection)
        return reprojection

    def straighten(self) -> None:
        """From now on the line integrals are those of a tube, straightened; once."""
        if not self.hardened:
            self.hardened, self.measured = True, without_hardening(self.measured, self.mu_water)
            self.y = self.measured

    @property
    def can_estimate_scatter(self) -> bool:
        """Whether the X-rays can hold scatter that `subtract_scatter` could find: not display values, whose offset has
        taken it, nor X-rays that no signal gives (MAX_LINE_INTEGRAL)."""
        return self.display is None and bool(self.measured.abs().max() < MAX_LINE_INTEGRAL)

    def reset_scatter(self, enabled: bool) -> None:
        """Forget what was subtracted, and from now on let `subtract_scatter` subtract scatter or not."""
        self.y, self.scatter_enabled = self.measured, enabled and self.can_estimate_scatter

    def subtract_scatter(self, reprojection: Tensor) -> None:
        """Where scatter is sought, subtract what the projections P(x) tell of."""
        if self.scatter_enabled:
            self.y = subtract_scatter(self.measured, reprojection)

    @property
    def scatter(self) -> float:
        """The mean share of the signal that is now subtracted as scatter."""
        return float(1 - torch.exp(self.measured - self.y).mean()) if self.scatter_enabled else 0.0
