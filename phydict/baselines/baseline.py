"""What the methods without a prior share: X-rays in, density relative to water in between, HU out."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable

import torch
from torch import Tensor

from phydict.guard import UNGUIDED_VIEWS, Guard, check_line_integral_scale
from phydict.reconstruction import Reconstruction, Reconstructor
from phydict.runtime.profiling import Stopwatch
from phydict.units import HUWindow, mu_to_hu
from phydict.xray import Projector
from phydict.xray.calibration import match_views
from phydict.xray.checks import prepared_xrays


class CountingProjector:
    """A projector, with `calls`: how often it or its adjoint ran over all views; `y`, the X-rays in mm of water, and
    `last_projection`, what it last made of a density."""

    def __init__(self, projector: Projector):
        self.grid, self.beam, self._projector, self.calls = projector.grid, projector.beam, projector, 0
        self.y: Tensor = None  # type: ignore[assignment]  # known once they are matched
        self.last_projection: Tensor | None = None

    def __call__(self, density: Tensor) -> Tensor:
        projected = self.linear(density)
        self.last_projection = projected.detach()
        return projected

    def linear(self, d: Tensor) -> Tensor:
        """The same of directions and test volumes, which are no estimates."""
        self.calls += 1
        return self._projector(d)

    def T(self, xrays: Tensor) -> Tensor:
        self.calls += 1
        return self._projector.T(xrays)


class Baseline(Reconstructor):
    """A method without a prior: a subclass says how to solve A density = y.

    Works on densities relative to water, so that HU do not depend on what water attenuates in the X-rays. Display
    values need a scale to start from: they are first matched to a water ellipse of a typical chest.
    Subclasses are frozen dataclasses, @dataclass(frozen=True), with the fields mu_water (1/mm) and name beside their
    own.
    local: whether a voxel's value depends on the X-rays alone, and not on which other voxels there are.
    """

    local = False

    name: str

    @abstractmethod
    def solve(self, A: CountingProjector, y: Tensor, on_step: Callable[[], None]) -> Tensor:
        """Density relative to water (1, 1, X, Y, Z), of any type, of line integrals y (1, K, V, U) in mm of water."""

    def expected(self, A: CountingProjector) -> Tensor:
        """Density relative to water (1, 1, X, Y, Z) that gives display values their scale."""
        return typical_chest(A)

    @torch.no_grad()
    def reconstruct(self, xrays: Tensor, projector: Projector, report: str = "", display: bool = False,
                    seed: int = 0, on_step: Callable[[], None] = lambda: None,
                    outside: Tensor | None = None) -> Reconstruction:
        """As a Reconstructor; outside: line integrals (K, V, U) of what lies outside the voxels, from a reconstruction
        of the same X-rays, which said what is doubtful in them."""
        watch, A = Stopwatch(), CountingProjector(projector)
        xrays = prepared_xrays(xrays, A.beam, display, told=outside is not None)
        with watch.stage("prepare"):
            y = xrays[None] / self.mu_water
            if display:
                y = match_views(xrays[None], A(self.expected(A).to(xrays)))
        beyond = torch.zeros_like(y) if outside is None else outside[None] / self.mu_water
        with watch.stage("sample"):
            A.y, guard = y if self.local else y - beyond, Guard(A, on_step, self.steps(), sees_xrays=True)
            density = self.solve(A, A.y, guard)
            if not isinstance(density, Tensor) or density.shape != (1, 1, *A.grid.shape):
                came = tuple(density.shape) if isinstance(density, Tensor) else type(density).__name__
                raise ValueError(f"solve of the method {type(self).__name__} must return a density relative to water, "
                                 f"a tensor of shape {(1, 1, *A.grid.shape)}, but {came} came back")
            density = density.to(y)  # of a network that computes in bfloat16
        with watch.stage("score"):
            fit = guard.score(density, self.mu_water * (A(density) + beyond), self.mu_water * y)
            volume = mu_to_hu(density[0, 0], 1.0).cpu()
            if outside is None and not display and A.beam.views >= UNGUIDED_VIEWS:
                check_line_integral_scale(volume, fit["misfit"])
        return Reconstruction(
            volume=volume, grid=A.grid, method=self.name, seed=seed,
            **fit, seconds=watch.seconds, projector_calls=A.calls,
            precision=str(y.dtype).removeprefix("torch."))


def empty(A: CountingProjector, y: Tensor) -> Tensor:
    """A volume of zeros (1, 1, X, Y, Z), of the type and on the device of y."""
    return torch.zeros(1, 1, *A.grid.shape).to(y)


def bounds(window: HUWindow | None) -> tuple[float, float]:
    """The densities relative to water at both ends of an HU window; without one, minus and plus infinity."""
    return (-math.inf, math.inf) if window is None else (window.to_mu(-1, 1.0), window.to_mu(1, 1.0))


def clip(density: Tensor, window: HUWindow | None) -> Tensor:
    """Density relative to water, held inside an HU window; None lets every value pass."""
    return density.clamp(*bounds(window))


def typical_chest(projector: Projector | CountingProjector) -> Tensor:
    """Density relative to water (1, 1, X, Y, Z) of an upright elliptic cylinder, 320 x 220 mm, with two lungs."""
    grid = projector.grid
    index = torch.stack(torch.meshgrid(*[torch.arange(n) for n in grid.shape], indexing="ij"), -1).double()
    affine = torch.tensor(grid.affine)
    x, y, _ = (index @ affine[:3, :3].T + affine[:3, 3] - torch.tensor(grid.centre)).unbind(-1)
    body = (x / 160) ** 2 + (y / 110) ** 2 < 1
    lungs = ((x.abs() - 75) / 55) ** 2 + (y / 80) ** 2 < 1
    return (body.float() - 0.75 * (body & lungs).float())[None, None]
