"""A projector of a user's own, as the operator that a `Projector` runs."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from phydict.grid import Grid
from phydict.runtime.own_code import imported, own_code
from phydict.runtime.warning import warn
from phydict.xray.geometry import ConeBeam
from phydict.xray.projectors.projector import METHODS

ADJOINT = 1e-3
"""By how much <A x, y> and <x, A'y> may differ, of |A x| |y|, for random x and y: what float32 leaves."""


class OwnOperator:
    """What an object of a class of one's own, made of a grid and a beam, computes: `A(mu)` and its adjoint `A.T(y)`.

    Both take and give tensors as `Projector` does, of any floating type and device, which are converted back. Raises
    ValueError, naming the class, where an object cannot be made or gives anything else, and warns where T is not A's
    adjoint: methods that iterate may then diverge.
    """

    def __init__(self, kind: type, grid: Grid, beam: ConeBeam):
        self.kind, self.volume, self.xrays = kind, (1, *grid.shape), (beam.views, *beam.shape)
        try:
            self.projector: Any = kind(grid, beam)
        except Exception as error:  # of whatever kind: another's code runs
            raise ValueError(f"the projector {kind.__name__} cannot be made of a grid and a beam ({_words(error)})"
                             ) from error
        if not callable(self.projector) or not callable(getattr(self.projector, "T", None)):
            raise ValueError(f"the projector {kind.__name__} needs __call__(mu) and T(xrays): see "
                             "phydict.xray.Projector")
        self._check_adjoint()

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
        x = torch.rand(1, *self.volume[1:], generator=generator)
        y = torch.rand(1, *self.xrays, generator=generator)
        projected, back = self.forward(x), self.adjoint(y)
        if not (projected.isfinite().all() and back.isfinite().all()):
            raise ValueError(f"the projector {self.kind.__name__} gives numbers that are not finite, of a volume and "
                             "X-rays of numbers from 0 to 1")
        forth, here = (float((a.double() * b).sum()) for a, b in ((projected, y), (x, back)))
        if abs(forth - here) > ADJOINT * float(projected.double().norm() * y.double().norm()):
            warn(f"T of the projector {self.kind.__name__} is not the adjoint of A: <A x, y> is {forth:.6g} and "
                 f"<x, T y> {here:.6g} for random x and y, so that iterations may diverge")


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
    try:
        kind = imported(given)
    except (Exception, SystemExit) as error:  # of whatever kind: another's code runs
        raise ValueError(f"the projector {given} cannot be imported ({_words(error)}): its module must be importable"
                         ) from error
    if not isinstance(kind, type):
        raise ValueError(f"the projector {given} is no class: give one that is made of a grid and a beam")
    return kind


def projector_settings(kind: str | type) -> str | dict:
    """What says, as plain JSON values, which `projector_kind` it is."""
    return kind if isinstance(kind, str) else {"class": f"{kind.__module__}.{kind.__qualname__}"} | own_code(kind)


def _words(error: BaseException) -> str:
    return " ".join(f"{type(error).__name__}: {error}".split())
