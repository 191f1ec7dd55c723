"""Cone-beam projection by plane sweep, for any pose on any device in plain torch, with its exact adjoint.

Joseph 1982, IEEE Trans Med Imaging 1:192 (doi:10.1109/TMI.1982.4307572): a ray's dominant axis is the one along which
it crosses most voxels; on every plane of voxel centres across that axis it takes one bilinear sample, weighted by the
ray's length from plane to plane. The rays of a view are split by their dominant axes, and those that pass the grid are
left out. Outside the grid mu is 0: the interpolant falls linearly from the outermost voxel centres to 0 one voxel
further out, so a row of n equal voxels integrates to n voxels.

Nothing of a sample is kept: the adjoint samples again. What is kept of the rays themselves obeys the memory budget;
views beyond it are laid out anew each time. On CUDA it adds with atomic operations, so that its last bits
may differ from run to run; on the CPU every result has one writer.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch

from phydict.grid import Grid
from phydict.xray.geometry import ConeBeam
from phydict.xray.projectors.tracer import ray_lengths, rays_in_voxels

WORKING_BYTES = 2**26
"""Temporaries beyond which a larger chunk gains nothing: a smaller memory budget lowers it, a larger one does not."""


class Sweep(NamedTuple):
    """Rays of one view that share the dominant axis `axis`, in the order of their pixels.

    pixels (R,): positions in the flattened view. middle, slope (R, 2): where a ray meets the axis' middle plane and
    what it moves from plane to plane, along the two other axes in the units of torch's grid_sample. length (R,): mm
    from plane to plane. first, last (R,): the planes between source and detector; None when all of them are.
    """

    axis: int
    pixels: torch.Tensor
    middle: torch.Tensor
    slope: torch.Tensor
    length: torch.Tensor
    first: torch.Tensor | None
    last: torch.Tensor | None

    def to(self, like: torch.Tensor) -> Sweep:
        """On the device of `like`, numbers in its precision."""
        return self._of(self.pixels.to(like.device), *[None if part is None else part.to(like) for part in self[2:]])

    @property
    def nbytes(self) -> int:
        return sum(part.nbytes for part in self[1:] if part is not None)

    def part(self, rays: slice) -> Sweep:
        return self._of(*[None if part is None else part[rays] for part in self[1:]])

    def _of(self, *parts: Any) -> Sweep:
        return Sweep(self.axis, *parts)

    def positions(self, planes: slice, size: int) -> torch.Tensor:
        """Where the rays meet the planes (P, 1, R, 2) of `size`, as grid_sample wants it."""
        index = torch.arange(planes.start, planes.stop).to(self.middle)[:, None]
        at = self.middle + (index - (size - 1) / 2)[..., None] * self.slope
        if self.first is not None and self.last is not None:
            at = at.masked_fill(((index < self.first) | (index > self.last))[..., None], 3.0)  # beyond the grid
        return at[:, None]


class Joseph:
    """The operator for one grid and beam: `forward` (B, X, Y, Z) -> (B, K, V, U) and its adjoint, float32 or float64.

    mu in 1/mm, on any device. memory: bytes that temporaries and the rays of all views together may take; at least one
    plane for one ray, and one view's rays, are held.
    """

    def __init__(self, grid: Grid, beam: ConeBeam, memory: int):
        self.grid, self.beam, self.memory = grid, beam, min(memory // 2, WORKING_BYTES)
        self.rays, self._left = rays_in_voxels(grid, beam), memory - self.memory
        self._tables: dict[tuple, list[Sweep]] = {}

    def forward(self, mu: torch.Tensor) -> torch.Tensor:
        xrays = mu.new_zeros(len(mu), self.beam.views, self.beam.shape[0] * self.beam.shape[1])
        filled = [_filled(mu, axis) for axis in range(3)]
        for k in range(self.beam.views):
            for sweep in self._on(mu, k):
                stack, planes = _stack(mu, sweep.axis), filled[sweep.axis]
                together = max(1, self._samples(mu) // max(1, planes.stop - planes.start))
                for rays in _slices(len(sweep.pixels), together):
                    part = sweep.part(rays)
                    values = torch.nn.functional.grid_sample(
                        stack[planes], part.positions(planes, len(stack)), align_corners=False)
                    xrays[:, k, part.pixels] = values[:, :, 0].sum(0) * part.length
        return xrays.view(len(mu), self.beam.views, *self.beam.shape)

    def adjoint(self, xrays: torch.Tensor) -> torch.Tensor:
        mu = xrays.new_zeros(len(xrays), *self.grid.shape)
        images = xrays.flatten(2)
        for k in range(self.beam.views):
            for sweep in self._on(xrays, k):
                stack = _stack(mu, sweep.axis)
                together = min(len(sweep.pixels), self._samples(xrays))
                plane = together * self._sample(xrays) + 2 * stack[0].nbytes
                for rays in _slices(len(sweep.pixels), together):
                    part = sweep.part(rays)
                    values = (images[:, k, part.pixels] * part.length)[None, :, None]
                    for planes in _slices(len(stack), max(1, self.memory // plane)):
                        stack[planes] += _scatter(values, part.positions(planes, len(stack)), stack[planes])
        return mu

    def _samples(self, like: torch.Tensor) -> int:
        """How many samples, of every case, fit the working memory."""
        return max(1, self.memory // self._sample(like))

    @staticmethod
    def _sample(like: torch.Tensor) -> int:
        """Bytes of a sample of every case: its position, the making of it, and the values."""
        return (6 + 2 * len(like)) * like.itemsize

    def _on(self, like: torch.Tensor, view: int) -> list[Sweep]:
        """A view's rays in the precision and on the device of `like`, made once as long as the memory lasts."""
        key = view, like.dtype, like.device
        if key in self._tables:
            return self._tables[key]
        sweeps = [sweep.to(like) for sweep in _sweeps(self.grid, self.beam, view, self.rays[view])]
        needed = sum(sweep.nbytes for sweep in sweeps)
        if needed <= self._left:
            self._tables[key], self._left = sweeps, self._left - needed
        return sweeps


def _stack(volumes: torch.Tensor, axis: int) -> torch.Tensor:
    """A view of volumes (B, X, Y, Z) as planes (N, B, H, W) across an axis."""
    return volumes.movedim(1 + axis, 0)


def _filled(mu: torch.Tensor, axis: int) -> slice:
    """The planes across an axis that hold anything, in any case."""
    filled = (_stack(mu, axis) != 0).flatten(1).any(1).nonzero()
    return slice(int(filled[0]), int(filled[-1]) + 1) if len(filled) else slice(0, 0)


def _slices(count: int, size: int) -> list[slice]:
    return [slice(first, min(first + size, count)) for first in range(0, count, size)]


def _scatter(values: torch.Tensor, positions: torch.Tensor, stack: torch.Tensor) -> torch.Tensor:
    """The transpose of grid_sample's bilinear sampling at positions (P, 1, R, 2), for values (1, B, 1, R)."""
    nothing = stack.new_zeros(()).expand(stack.shape)
    return torch.ops.aten.grid_sampler_2d_backward(
        values.expand(len(positions), -1, -1, -1), nothing, positions, 0, 0, False, [True, False])[0]


def _sweeps(grid: Grid, beam: ConeBeam, view: int, rays: np.ndarray) -> list[Sweep]:
    """A view's rays by dominant axis."""
    source, first, column, row = rays
    ray = (first + np.arange(beam.shape[1])[:, None] * column + np.arange(beam.shape[0])[:, None, None] * row
           - source).reshape(-1, 3)
    length = ray_lengths(beam.select([view])).reshape(-1)
    dominant = abs(ray).argmax(1)
    return [sweep for axis in range(3)
            if len((sweep := _sweep(grid, source, ray, length, np.flatnonzero(dominant == axis), axis)).pixels)]


def _sweep(grid: Grid, source: np.ndarray, rays: np.ndarray, lengths: np.ndarray, pixels: np.ndarray,
           axis: int) -> Sweep:
    """Those of the rays' `pixels` that pass the grid, swept along their dominant axis."""
    across = [a for a in (2, 1, 0) if a != axis]  # grid_sample counts from the last axis
    size, sizes = grid.shape[axis], np.array(grid.shape)[across]
    pace = rays[pixels, axis]
    slope = rays[pixels][:, across] / pace[:, None]
    start = source[across] - source[axis] * slope  # where the ray meets plane 0

    # The planes on which the interpolant can be non-zero along both other axes.
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = np.stack([(-1 - start) / slope, (sizes - start) / slope])
    inside = (start > -1) & (start < sizes)
    still = abs(slope) < 1e-12
    near = np.where(still, np.where(inside, -np.inf, np.inf), ends.min(0)).max(1).clip(min=0)
    far = np.where(still, np.where(inside, np.inf, -np.inf), ends.max(0)).min(1).clip(max=size - 1)
    hit = near <= far
    pixels, pace, slope, start = pixels[hit], pace[hit], slope[hit], start[hit]

    begin, end = source[axis], source[axis] + pace  # the planes of source and pixel
    first, last = np.minimum(begin, end), np.maximum(begin, end)
    whole = bool(((first <= near[hit]) & (last >= far[hit])).all())
    middle = (2 * (start + (size - 1) / 2 * slope) + 1) / sizes - 1  # index -> grid_sample without aligned corners
    tensors = [torch.as_tensor(part) for part in (pixels, middle, 2 * slope / sizes, lengths[pixels] / abs(pace))]
    return Sweep(axis, *tensors, *((None, None) if whole else map(torch.as_tensor, (first, last))))
