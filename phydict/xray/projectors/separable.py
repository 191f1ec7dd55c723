"""Fast cone-beam projection of trilinear volumes for upright detectors, with its exact adjoint.

A view's rays are sampled on planes parallel to its detector. On the plane at depth d a ray's in-plane position depends
on its detector column alone and its axial position on its detector row alone, so trilinear interpolation splits:

    A mu = step / cos * sum over d of (axial linear interpolation at d) o (in-plane bilinear gather at d) mu

The planes lie one voxel of the dominant axis apart (or a whole fraction of it, where rays would cross more than one
voxel from plane to plane): then every voxel meets its planes in the same phase and none is over- or underweighted.

Outside the grid mu is 0: the interpolant falls linearly from the outermost voxel centres to 0 one voxel further out,
so a row of n equal voxels integrates to n voxels, as for boxes.

On the CPU compiled loops do it (phydict.xray.projectors.separable_cpu), on other devices sparse products in torch
(phydict.xray.projectors.separable_sparse).
"""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import cached_property
from typing import Any, NamedTuple

import numba
import numpy as np
import torch
from torch.utils.data import get_worker_info

from phydict.grid import Grid
from phydict.xray.geometry import ConeBeam
from phydict.xray.projectors import separable_cpu
from phydict.xray.projectors.separable_sparse import SparseFactors

IMPORTED_IN = os.getpid()
"""The process that imported this; another one that holds it was forked."""


class Rays(NamedTuple):
    """Each view's rays: a pixel's ray starts at the source and adds its column's and its row's part.

    starts (K, 3): the source in voxel indices. columns (K, U, 3): in-plane voxel indices from the source to the
    column, and the square of their length in mm^2. rows (K, V, 2): axial voxel indices to the row, and mm.
    planes (K, 3): way to the first depth plane and from plane to plane, as fractions of the way to the detector, and
    the number of planes.
    """

    starts: np.ndarray
    columns: np.ndarray
    rows: np.ndarray
    planes: np.ndarray

    @staticmethod
    def of(grid: Grid, beam: ConeBeam) -> Rays:
        axis = grid.affine[:3, 2] / grid.spacing[2]
        to_index = np.linalg.inv(grid.affine[:3, :3])
        centre = beam.detectors - beam.sources
        column = centre[:, None] + _steps(beam.shape[1])[:, None] * beam.u[:, None]
        row = centre[:, None] + _steps(beam.shape[0])[:, None] * beam.v[:, None]
        in_plane, axial, height = column @ to_index[:2].T, row @ to_index[2], row @ axis

        # Planes: no ray may cross more than one voxel from one to the next.
        pace = np.maximum(abs(in_plane).max((1, 2)), abs(axial).max(1)) / beam.distances  # voxels per mm of depth
        voxel = abs(beam.normals @ grid.affine[:3, :2]).max(1)  # mm of depth per voxel along the dominant axis
        step = voxel / np.ceil(voxel * pace - 1e-6)
        corners = np.einsum("kna,ka->kn", grid.corners() - beam.sources[:, None], beam.normals)
        half = np.ceil((np.ptp(corners, 1) / 2 + max(grid.spacing[:2])) / step)
        first = (corners.min(1) + corners.max(1)) / 2 + (0.5 - half) * step
        behind = np.ceil((-first / step).clip(min=0))  # the volume reaches a voxel beyond its box, a ray to its ends
        first = first + behind * step
        count = np.minimum(2 * half - behind, np.floor((beam.distances - first) / step) + 1)

        squares = (column**2).sum(2) - (column @ axis)**2
        return Rays(grid.index(beam.sources), np.concatenate([in_plane, squares[..., None]], 2),
                    np.stack([axial, height], 2), np.stack([first / beam.distances, step / beam.distances, count], 1))


class Separable:
    """The operator for one grid and beam: `forward` (B, X, Y, Z) -> (B, K, V, U) and its adjoint, float32 or float64.

    mu in 1/mm, on any device; on the CPU on torch's number of threads, with results that do not depend on it.
    Raises ValueError for detectors that do not stand upright on the grid.
    """

    def __init__(self, grid: Grid, beam: ConeBeam):
        if not beam.is_upright(grid):
            raise ValueError("the projector separable needs detectors whose rows are stacked along the grid's third "
                             "axis, but this beam's are tilted; use the projector siddon, or auto")
        self.grid, self.beam, self.rays = grid, beam, Rays.of(grid, beam)

    def forward(self, mu: torch.Tensor) -> torch.Tensor:
        if mu.device.type != "cpu":
            return self.sparse.forward(mu)
        xrays = mu.new_empty(len(mu), self.beam.views, *self.beam.shape)
        _set_threads()
        _here(separable_cpu.project)(_array(mu), xrays.numpy(), *self.rays)
        return xrays

    def adjoint(self, xrays: torch.Tensor) -> torch.Tensor:
        if xrays.device.type != "cpu":
            return self.sparse.adjoint(xrays)
        mu = xrays.new_zeros(len(xrays), *self.grid.shape)
        _here(separable_cpu.backproject)(mu.numpy(), _array(xrays), _set_threads(), *self.rays)
        return mu

    @cached_property
    def sparse(self) -> SparseFactors:
        """The same operator as sparse products, made when first needed."""
        return SparseFactors(self.grid.shape, self.beam.shape, *self.rays)


def _steps(count: int) -> np.ndarray:
    return np.arange(count) - (count - 1) / 2


def _array(x: torch.Tensor) -> np.ndarray:
    return np.ascontiguousarray(x.detach().numpy())


def _here(loops: Any) -> Callable:
    """Compiled loops as this process can run them: one that is forked from one whose OpenMP may have threads, as those
    that load data are, would be ended by it, and has the outer loop run by Python, on one thread."""
    return loops.py_func if get_worker_info() or os.getpid() != IMPORTED_IN else loops


def _set_threads() -> int:
    """The number of threads that torch uses, set for numba, whose start sets OpenMP's, and so torch's, to all."""
    requested = torch.get_num_threads()
    threads = min(requested, numba.config.NUMBA_NUM_THREADS)  # type: ignore[attr-defined]
    numba.set_num_threads(threads)
    if torch.get_num_threads() != requested:
        torch.set_num_threads(requested)
    return threads
