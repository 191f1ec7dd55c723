"""Boxes of voxels over and inside one another: what they share, volumes on other voxels, and finer and finer voxels."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from phydict.grid import Grid, centred
from phydict.runtime.warning import warn
from phydict.xray.binning import binned, binning
from phydict.xray.geometry import ConeBeam
from phydict.xray.projectors.projector import METHODS, Projector

ALONG = 1e-4
"""Sine of the angle below which axes of two grids run along each other."""

SLACK = 1e-3
"""A share of a voxel by which a box may stand out of another one that covers it."""


def binned_to(grid: Grid, xrays: Tensor, beam: ConeBeam, full_detector: bool, method: str | type = "auto",
              held_by: Grid | None = None) -> tuple[Tensor, Projector]:
    """X-rays (K, V, U), binned to what the voxels, or those of `held_by`, can hold unless every pixel is wanted, and
    the projector that goes with them on their device; `method` as Projector's."""
    factor = 1 if full_detector else binning(held_by or grid, beam)
    return binned(xrays, factor), Projector(grid, beam.binned(factor), method, device=xrays.device, full_detector=True)


def projector_method(projector: Projector) -> str | type:
    """The method by which X-rays are projected on other voxels than a projector's own; an object that is no `Projector`
    gives its place to one there, and a warning says so."""
    method = getattr(projector, "method", None)
    if isinstance(method, type) or method in METHODS:
        return method
    warn(f"{type(projector).__name__} projects its own voxels alone: on others phydict's projector takes its place; "
         "its class, as `projector` of phydict.reconstruct or --model.projector, projects all")
    return "auto"


def along(grid: Grid, other: Grid) -> bool:
    """Whether the voxels of both grids are stacked in the same directions."""
    axes, others = (g.affine[:3, :3] / g.spacing for g in (grid, other))
    return bool(abs(axes - others).max() < ALONG)


def check_axes(grid: Grid, other: Grid) -> None:
    """Raises ValueError unless the voxels of both grids are stacked in the same directions."""
    if not along(grid, other):
        raise ValueError("a volume is refined on voxels whose axes run along its own, but the given affine "
                         f"{np.round(other.affine[:3, :3], 3).tolist()} is turned against "
                         f"{np.round(grid.affine[:3, :3], 3).tolist()}: give a box along the same axes")


def covers(grid: Grid, box: Grid) -> bool:
    """Whether the box of `grid` holds that of another grid along the same axes."""
    return not any(lacking(grid, box))


def lacking(grid: Grid, box: Grid) -> list[float]:
    """How many voxels a grid lacks along each axis, at the end where it lacks more, to hold a box along the same
    axes."""
    low, high = _faces(grid, box)
    return [max(0.0, -0.5 - SLACK - first, last - n + 0.5 - SLACK) for n, first, last in zip(grid.shape, low, high)]


def interpolated(volume: Tensor, grid: Grid, onto: Grid, fill: float) -> Tensor:
    """Volumes (..., X, Y, Z) on `grid`, trilinearly on the voxels of another grid along the same axes; `fill` lies
    outside its box."""
    check_axes(grid, onto)
    first, step, weights = grid.index(onto.affine[:3, 3]), np.divide(onto.spacing, grid.spacing), []
    for axis, n in enumerate(grid.shape):
        places = torch.as_tensor(first[axis] + step[axis] * np.arange(onto.shape[axis]))
        inside = (places >= -0.5 - SLACK) & (places <= n - 0.5 + SLACK)
        distance = (places.clamp(0, n - 1)[:, None] - torch.arange(n)).abs()
        weights.append((1 - distance).clamp(min=0) * inside[:, None])
    return _weighted(volume - fill, weights) + fill


def averaged(volume: Tensor, grid: Grid, onto: Grid) -> Tensor:
    """Volumes (..., X, Y, Z) on `grid`, averaged over the voxels of another grid along the same axes, of which each
    shares a part with its box; what is beyond that does not count."""
    if grid.same_as(onto):
        return volume
    check_axes(grid, onto)
    first, step, weights = grid.index(onto.affine[:3, 3]), np.divide(onto.spacing, grid.spacing), []
    for axis, n in enumerate(grid.shape):
        centres, places = first[axis] + step[axis] * np.arange(onto.shape[axis])[:, None], np.arange(n)
        shared = (np.minimum(centres + step[axis] / 2, places + 0.5)
                  - np.maximum(centres - step[axis] / 2, places - 0.5)).clip(0)
        weights.append(torch.as_tensor(shared / shared.sum(1, keepdims=True)))
    return _weighted(volume, weights)


def _weighted(volume: Tensor, weights: Sequence[Tensor]) -> Tensor:
    """Volumes (..., X, Y, Z) whose voxels are, axis by axis, sums of those given, by weights (new, given)."""
    for axis, of_axis in enumerate(weights, -3):
        volume = torch.tensordot(of_axis.to(volume), volume.movedim(axis, 0), 1).movedim(0, axis)
    return volume.contiguous()


def no_finer(grid: Grid, than: Grid) -> bool:
    """Whether a grid's voxels are at least as long along each axis as those of the grid `than`, of the same axes, and
    each lies at least half in the box of `than`."""
    beyond = np.multiply(lacking(than, grid), than.spacing) / grid.spacing
    return bool((np.divide(grid.spacing, than.spacing) > 1 - SLACK).all() and (beyond < 0.5).all())


def outside_projection(mu: Tensor, grid: Grid, projector: Projector, continued: bool = False) -> Tensor:
    """Line integrals (K, V, U), along the projector's rays, of what of mu (X, Y, Z) in 1/mm on `grid` lies outside the
    projector's own box, and, where it is continued, above and below `grid`."""
    beam = replace(projector.beam, continued=continued)
    whole = Projector(grid, beam, projector_method(projector), device=mu.device, full_detector=True)(mu[None, None])
    return (whole - projector(interpolated(mu, grid, projector.grid, 0.0)[None, None]))[0]


def refinements(start: Grid, target: Grid) -> list[Grid]:
    """Grids over the target's box that lead from `start` to the target, each of voxels about half as long as those
    before.

    Along each axis none has longer voxels than `start`, unless the target has. Empty where the target is `start`.
    """
    check_axes(start, target)
    if start.same_as(target):
        return []
    halvings = max(1, round(math.log2(max(np.divide(start.spacing, target.spacing)))))
    most = [math.ceil(side - SLACK) for side in np.multiply(target.shape, target.spacing) / start.spacing]
    shapes = [[min(n, max(math.ceil(n / 2**k), m)) for n, m in zip(target.shape, most)]
              for k in range(halvings - 1, 0, -1)]
    return [in_other_voxels(target, shape) for shape in shapes if shape != [*target.shape]] + [target]


def in_other_voxels(grid: Grid, shape: Sequence[int]) -> Grid:
    """The same box in other voxels."""
    x, y, z = shape
    axes = grid.affine[:3, :3] * np.divide(grid.shape, shape)
    return Grid((x, y, z), affine=centred(axes, (x, y, z), grid.centre))


def divided(grid: Grid, factor: int) -> Grid:
    """The same box, factor^3 voxels in the place of each."""
    return in_other_voxels(grid, [factor * n for n in grid.shape])


def halved(grid: Grid) -> Grid:
    """The same box in half as many voxels along each side."""
    return in_other_voxels(grid, [max(1, n // 2) for n in grid.shape])


def part(grid: Grid, box: Sequence[slice]) -> Grid:
    """The voxels of a grid in a box of indices."""
    affine = grid.affine.copy()
    affine[:3, 3] += affine[:3, :3] @ [side.start for side in box]
    x, y, z = (side.stop - side.start for side in box)
    return Grid((x, y, z), affine=affine)


def _faces(grid: Grid, box: Grid) -> tuple[np.ndarray, np.ndarray]:
    """The first and last faces (3,) of a box, as the grid's indices."""
    first, last = (box.affine[:3, :3] @ ends + box.affine[:3, 3]
                   for ends in (np.full(3, -0.5), np.asarray(box.shape) - 0.5))
    return grid.index(first), grid.index(last)
