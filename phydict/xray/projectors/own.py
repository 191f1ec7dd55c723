"""A projector of a user's own, as the operator that a `Projector` runs."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from phydict.grid import Grid
from phydict.runtime.own_code import imported, own_code, words
from phydict.runtime.reading import naming
from phydict.runtime.warning import warn
from phydict.units import MU_WATER
from phydict.xray.geometry import ConeBeam
from phydict.xray.projectors.projector import MEMORY, METHODS

ADJOINT = 1e-3
"""By how much <A x, y> and <x, A'y> may differ, of |A x| |y|, for positive random x and y and for a random x of both
signs and y = A x: phydict's own projectors leave 1e-7 in float32."""

BODY = ((0.14, 0.08), (-0.11, 0.1), (0.08, 0.06))
"""Of a test body, along each axis: how far it lies from the middle of the voxels, and its standard deviation, as shares
of their number; the latter is LEAST_STD voxels or more."""

LEAST_STD, SUMS, ALIKE = 1.25, 0.1, 0.9
"""By how much, as a share, sums of a test body's views may differ from those of phydict's projector, and how alike each
of them must be at least, as a cosine. From 6^3 to 128^3 voxels phydict's own projectors differ by 0.06 at most and are
0.97 alike, those of a detector that blurs by a pixel are 0.94; with an axis flipped the worst view is 0.82 alike from
6^3 voxels and 0.41 or less from 12^3."""


class OwnOperator:
    """What an object of a class of one's own, made of a grid and a beam, computes: `A(mu)` and its adjoint `A.T(y)`.

    Both take and give tensors as `Projector` does, of any floating type and device, which are converted back. Raises
    ValueError, naming the class, where an object cannot be made or gives anything else. Warns where T is not A's
    adjoint, so that methods that iterate may diverge, and where A projects a test body by other units or elsewhere than
    phydict's projector does.
    """

    def __init__(self, kind: type, grid: Grid, beam: ConeBeam):
        self.kind, self.volume, self.xrays = kind, (1, *grid.shape), (beam.views, *beam.shape)
        try:
            self.projector: Any = kind(grid, beam)
        except Exception as error:  # of whatever kind: another's code runs
            raise ValueError(f"the projector {kind.__name__} cannot be made of a grid and a beam ({words(error)})"
                             ) from error
        if not callable(self.projector) or not callable(getattr(self.projector, "T", None)):
            raise ValueError(f"the projector {kind.__name__} needs __call__(mu) and T(xrays): see "
                             "phydict.xray.Projector")
        self._check_adjoint()
        self._check_body(grid, beam)

    def forward(self, mu: Tensor) -> Tensor:
        return self._checked(self.projector(mu[:, None]), mu, self.xrays, "A(mu)")

    def adjoint(self, xrays: Tensor) -> Tensor:
        return self._checked(self.projector.T(xrays), xrays, self.volume, "A.T(xrays)")[:, 0]

    def _checked(self, result: Any, given: Tensor, shape: tuple[int, ...], of: str) -> Tensor:
        if not isinstance(result, Tensor) or tuple(result.shape) != (len(given), *shape):
            found = tuple(result.shape) if isinstance(result, Tensor) else type(result).__name__
            raise ValueError(f"{of} of the projector {self.kind.__name__} must be a tensor of shape "
                             f"{(len(given), *shape)}, but gave {found}")
        return result.to(given)

    def _check_adjoint(self) -> None:
        generator = torch.Generator().manual_seed(0)
        x, y = (torch.rand(1, *shape, generator=generator) for shape in (self.volume[1:], self.xrays))
        projected, back = self.forward(x), self.adjoint(y)
        if not (projected.isfinite().all() and back.isfinite().all()):
            raise ValueError(f"the projector {self.kind.__name__} gives numbers that are not finite, of a volume and "
                             "X-rays of numbers from 0 to 1")
        signed = torch.randn(x.shape, generator=generator)  # no mean hides what is mirrored
        seen = self.forward(signed)
        for volume, views, xrays, volumes in ((x, projected, y, back), (signed, seen, seen, self.adjoint(seen))):
            forth, here = (float((a.double() * b).sum()) for a, b in ((views, xrays), (volume, volumes)))
            if abs(forth - here) > ADJOINT * float(views.double().norm() * xrays.double().norm()):
                warn(f"T of the projector {self.kind.__name__} is not the adjoint of A: <A x, y> is {forth:.6g} and "
                     f"<x, T y> {here:.6g} for random numbers, so that iterations may diverge")
                return

    def _check_body(self, grid: Grid, beam: ConeBeam) -> None:
        from phydict.xray.projectors.joseph import Joseph  # and with them a compiler
        from phydict.xray.projectors.separable import Separable

        body, peak = _body(grid)
        operator = Separable(grid, beam) if beam.is_upright(grid) else Joseph(grid, beam, MEMORY)
        ours, theirs = operator.forward(body)[0].double(), self.forward(body)[0].double()
        views = (ours.amax((1, 2)) > peak / 2).nonzero()[:, 0]  # that show more than an end of the body
        if not len(views):
            return
        ours, theirs = ours[views], theirs[views]
        size = float(theirs.sum() / ours.sum())
        sizes = (ours.square().sum((1, 2)) * theirs.square().sum((1, 2))).sqrt()
        alike = ((ours * theirs).sum((1, 2)) / sizes).nan_to_num(0.0)
        worst = int(alike.argmin())
        if abs(size - 1) > SUMS:
            warn(f"A of the projector {self.kind.__name__} is {size:.2g} of what phydict's projector gives for a test "
                 "body: attenuation is in 1/mm, and lengths are in mm")
        elif alike[worst] < ALIKE:
            warn(f"A of the projector {self.kind.__name__} shows a test body elsewhere than phydict's projector does, "
                 f"most in view {int(views[worst])} (counted from 0): check that no axis is flipped or takes another's "
                 "place, and the order of views, rows and columns")


def _body(grid: Grid) -> tuple[Tensor, float]:
    """A smooth ellipsoid of water that lies beside the middle of a grid (1, X, Y, Z), in 1/mm, and the least line
    integral through its middle."""
    stds = [max(std * n, LEAST_STD) for (_, std), n in zip(BODY, grid.shape)]
    x, y, z = (torch.exp(-0.5 * ((torch.arange(n) - (n - 1) / 2 - shift * n) / std) ** 2)
               for (shift, _), n, std in zip(BODY, grid.shape, stds))
    thickness = math.sqrt(2 * math.pi) * min(std * step for std, step in zip(stds, grid.spacing))
    return MU_WATER * (x[:, None, None] * y[:, None] * z)[None], MU_WATER * thickness


def projector_kind(given: str | type, setting: str = "projector") -> str | type:
    """The `method` of a Projector that is given by its name, by the path of a class of one's own, such as
    my_module.MyProjector, or as that class. Raises ValueError, naming the `setting`, where it is none."""
    if isinstance(given, type) or given in METHODS:
        return given
    if not isinstance(given, str):
        raise ValueError("a projector is given by its name, such as 'auto', or as a class that is made of a grid and a "
                         f"beam, but an object of {type(given).__name__} was given: give its class, or give it to "
                         "reconstructor(...).reconstruct(xrays, projector)")
    module, _, name = given.rpartition(".")
    if not (module and name):
        raise ValueError(f"there is no projector {given!r}: {setting} is one of {', '.join(METHODS)}, or the path of a "
                         "class of your own, such as my_module.MyProjector")
    with naming(f"the projector {given} cannot be imported"):
        kind = imported(given)
    if not isinstance(kind, type):
        raise ValueError(f"the projector {given} is no class: give one that is made of a grid and a beam")
    return kind


def projector_settings(kind: str | type) -> str | dict:
    """What says, as plain JSON values, which `projector_kind` it is."""
    return kind if isinstance(kind, str) else {"class": f"{kind.__module__}.{kind.__qualname__}"} | own_code(kind)
