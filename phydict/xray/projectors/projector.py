"""The linear map from attenuation to X-rays, its exact adjoint, and autograd through both."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch

from phydict.grid import Grid
from phydict.linalg.power_iteration import operator_norm
from phydict.runtime.profiling import stage
from phydict.runtime.warning import warn
from phydict.xray.binning import binning
from phydict.xray.geometry import VECTOR_KEYS, ConeBeam
from phydict.xray.projectors.axes import InOtherOrder, axis_upwards, put_last
from phydict.xray.projectors.continued import Continued, reach_beyond

if TYPE_CHECKING:  # they bring a compiler, so that each is imported where it is first needed
    from phydict.xray.projectors.eq4 import Eq4
    from phydict.xray.projectors.joseph import Joseph
    from phydict.xray.projectors.own import OwnOperator
    from phydict.xray.projectors.separable import Separable
    from phydict.xray.projectors.siddon import Siddon
    from phydict.xray.projectors.system_matrix import SystemMatrix

METHODS = ("auto", "separable", "siddon", "eq4", "joseph", "matrix")

MEMORY = 2**29
"""Bytes that a projector may hold beside volume and X-rays by default."""

CACHE_SIZE = 2
"""Operators, with all that they computed from their geometry, that are kept for the next projector of the same one."""


class Projector:
    """A: attenuation mu (B, 1, X, Y, Z) in 1/mm on `grid` -> line integrals (B, K, V, U) along the rays of `beam`.

    `A(mu)` and the exact adjoint `A.T(xrays)` are differentiable (to any order) in float32 and float64; geometry is
    computed once, in float64, and shared by projectors of the same grid and beam. mu is 0 outside the grid, or, where
    the beam says that it is continued, above and below it what it is in the last slice. Any axis of the grid may be
    the one that runs upwards.
    method:
        "separable": trilinear volumes, upright detectors, any device; the fast one (phydict.xray.projectors.separable);
        "siddon": piecewise-constant voxels exactly, any pose, computed on the CPU (phydict.xray.projectors.siddon);
        "eq4": the paper's Eq. 4 to the letter, any pose, computed on the CPU (phydict.xray.projectors.eq4);
        "joseph": plane sweep with bilinear samples, any pose and device (phydict.xray.projectors.joseph);
        "matrix": what siddon computes, as a stored matrix, any pose and device (phydict.xray.projectors.system_matrix);
        "auto": separable for upright detectors; else the matrix if it fits, else siddon on the CPU and joseph on other
            devices. `A.method` is the one that runs and `A.reason` says why;
        a class of one's own: an object that it makes of a grid and a beam, with `A(mu)` and `A.T(xrays)`, computes what
            this projector gives (phydict.xray.projectors.own). A volume that is continued is given to it as a taller
            one.
    memory: bytes that the stored matrix, or the plane sweep's temporaries and rays, may take. The other methods hold
        little: the separable one, on other devices than the CPU, the sparse factors of every view (some 15 MB each at
        256^3 voxels, 448^2 pixels and float32), which the budget does not count.
    device: where A will be used, for "auto" to choose by; None for the CPU.
    full_detector: that every pixel is wanted, so that no warning is due where the detector is finer than the grid.
    Raises ValueError when a source or detector lies inside the volume, the method does not suit the beam, or the
    matrix does not fit the memory.
    """

    def __init__(self, grid: Grid, beam: ConeBeam, method: str | type = "auto", memory: int = MEMORY,
                 device: torch.device | str | None = None, full_detector: bool = False):
        if not (isinstance(grid, Grid) and isinstance(beam, ConeBeam)):
            raise ValueError("a Projector is made of a Grid and a ConeBeam, in this order, but "
                             f"{type(grid).__name__} and {type(beam).__name__} were given")
        if not isinstance(method, type) and method not in METHODS:
            raise ValueError(f"there is no projector method {method!r}; choose one of {', '.join(METHODS)}, or give a "
                             "class of your own")
        if not memory > 0:
            raise ValueError(f"memory is a budget in bytes > 0, but {memory} was given")
        beam.check(grid)
        if not full_detector and (factor := binning(grid, beam)) > 1:
            warn(f"the detector's pixels are finer than this grid can resolve: beam.binned({factor}) and "
                 f"phydict.xray.binned(xrays, {factor}) measure the same in less time; full_detector=True "
                 "keeps every pixel without this warning")
        self.grid, self.beam, self.device = grid, beam, torch.device(device or "cpu")
        self._engine = _engine(grid, beam, method, int(memory), self.device.type)
        self.method, self.reason = self._engine.method, self._engine.reason

    def __call__(self, mu: torch.Tensor) -> torch.Tensor:
        """Line integrals (B, K, V, U) of mu (B, 1, X, Y, Z)."""
        _check(mu, (1, *self.grid.shape), "mu")
        return _Linear.apply(mu[:, 0], self._engine.operator, False)

    def T(self, xrays: torch.Tensor) -> torch.Tensor:
        """The exact adjoint: xrays (B, K, V, U) -> (B, 1, X, Y, Z), with <A mu, y> = <mu, A.T y>."""
        _check(xrays, (self.beam.views, *self.beam.shape), "xrays")
        return _Linear.apply(xrays, self._engine.operator, True)[:, None]

    def norm(self) -> float:
        """The largest singular value of A (computed once)."""
        if self._engine.norm is None:
            self._engine.norm = operator_norm(self, self.T, torch.ones(
                1, 1, *self.grid.shape, dtype=torch.float32))
        return self._engine.norm


@dataclass
class _Engine:
    """What projectors of the same grid and beam share: the operator, why it was chosen, and its norm once known."""

    operator: Eq4 | Joseph | Separable | Siddon | SystemMatrix | OwnOperator | Continued | InOtherOrder
    method: str | type
    reason: str
    norm: float | None = None


_engines: OrderedDict[tuple, _Engine] = OrderedDict()


def _engine(grid: Grid, beam: ConeBeam, method: str | type, memory: int, device: str) -> _Engine:
    """The engine for a geometry, from among those last used if it is there."""
    key = (method, memory, device, grid.shape, grid.affine.tobytes(), beam.shape, bool(beam.continued),
           *(getattr(beam, name).tobytes() for name in VECTOR_KEYS[:4]))
    engine = _engines.pop(key, None)  # taken at once, since other threads make and forget theirs
    if engine is None:
        axis = axis_upwards(grid, beam)
        upright = put_last(grid, axis)
        slices = reach_beyond(beam, upright) if beam.continued else 0
        tall = upright.grown(0, 0, slices)
        chosen, reason = _choose(tall, beam, memory, device) if method == "auto" else (method, "it was requested")
        operator = _operator(tall, beam, chosen, memory)
        operator = Continued(operator, slices) if slices else operator
        engine = _Engine(operator if axis == 2 else InOtherOrder(operator, axis), chosen, reason)
    _engines[key] = engine
    while len(_engines) > CACHE_SIZE:
        _engines.popitem(last=False)
    return engine


def _choose(grid: Grid, beam: ConeBeam, memory: int, device: str) -> tuple[str, str]:
    """The method for a geometry, a memory budget and a device, and a sentence that says why."""
    if beam.is_upright(grid):
        return "separable", "the detectors stand upright on the grid, where the separable projector is the fastest"
    from phydict.xray.projectors.system_matrix import SystemMatrix

    needed = SystemMatrix.bytes_for(grid, beam, torch.float64)
    if needed <= memory:
        return "matrix", (f"the detectors are tilted, and the system matrix takes at most {needed:,} bytes of the "
                          f"budget of {memory:,}")
    chosen, why = ("siddon", "ray tracing is compiled for the CPU") if device == "cpu" else (
        "joseph", f"the plane sweep runs on {device}")
    return chosen, (f"the detectors are tilted, the system matrix would take {needed:,} bytes of a budget of "
                    f"{memory:,}, and {why}")


def _operator(grid: Grid, beam: ConeBeam, method: str | type, memory: int):
    if isinstance(method, type):
        from phydict.xray.projectors.own import OwnOperator

        return OwnOperator(method, grid, beam)
    from phydict.xray.projectors.eq4 import Eq4
    from phydict.xray.projectors.joseph import Joseph
    from phydict.xray.projectors.separable import Separable
    from phydict.xray.projectors.siddon import Siddon
    from phydict.xray.projectors.system_matrix import SystemMatrix

    if method in ("joseph", "matrix"):
        return {"joseph": Joseph, "matrix": SystemMatrix}[method](grid, beam, memory)
    return {"separable": Separable, "siddon": Siddon, "eq4": Eq4}[method](grid, beam)


class _Linear(torch.autograd.Function):
    """y = A x or A' x; the gradient of the one is the other, so nothing is stored."""

    @staticmethod
    def forward(ctx, x, operator, transposed):
        ctx.operator, ctx.transposed = operator, transposed
        with stage("projector"), torch.autocast(x.device.type, enabled=False):  # which would round sparse products
            return operator.adjoint(x) if transposed else operator.forward(x)

    @staticmethod
    def backward(ctx, gradient):
        return _Linear.apply(gradient, ctx.operator, not ctx.transposed), None, None


def _check(x: torch.Tensor, shape: tuple[int, ...], name: str) -> None:
    if not isinstance(x, torch.Tensor):
        raise ValueError(f"{name} must be a tensor, but a {type(x).__name__} was given; convert it by torch.as_tensor")
    if tuple(x.shape[1:]) != shape or x.ndim != len(shape) + 1:
        raise ValueError(f"{name} must be (batch, {', '.join(map(str, shape))}), but shape {tuple(x.shape)} was given")
    if x.dtype not in (torch.float32, torch.float64):
        raise ValueError(f"{name} must be float32 or float64, but {x.dtype} was given; convert it with .float()")
