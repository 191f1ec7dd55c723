"""A patient's CT carried into another shape: tissue and masks by a map, the table rigidly, a flat end of the scan."""

from __future__ import annotations

import numpy as np
import scipy
import torch
from torch import Tensor

from phydict.datasets.case import Case, lacking
from phydict.datasets.cts.acquisition import without_table
from phydict.datasets.population.registration import scanned
from phydict.datasets.population.velocity import flow, places, resize, sample
from phydict.grid import Grid
from phydict.units import AIR, HUWindow

BACK_MM = 60.0
"""mm to either side of the middle in which the back's place is measured."""

LEAST_SCANNED = 0.9
"""Share of a slice's middle that must come from slices that were scanned, or the scan ends before it."""


def fine_flow(velocity: Tensor, voxels) -> Tensor:
    """The flow of a velocity (3, x, y, z) on voxels half as wide as its own, no finer than the image's `voxels`."""
    return flow(resize(velocity, [min(2 * n, m) for n, m in zip(velocity.shape[1:], voxels)]))


def sources(shape: Tensor, patient: Tensor, voxels) -> Tensor:
    """Where a new anatomy takes its values in the patient's CT: exp(patient) after exp(-shape), (3, *voxels).

    shape: velocity (3, x, y, z) of the new shape, from the template; patient: `fine_flow` of the patient's. The result
    is in half-widths of the box.
    """
    start = places(patient.shape[1:])
    back = start + fine_flow(-shape, voxels)
    return places(voxels) + resize(back + sample(patient, back) - start, voxels)


def carry(case: Case, points: Tensor, grid: Grid, window: HUWindow, lungs: float = 0.0) -> Case:
    """The Case whose voxels take volume and masks at `points` (3, X, Y, Z) of this one, air beyond it.

    lungs: logarithm of the factor by which they are inflated; their tissue keeps its mass. The table keeps its form and
    follows the back. Slices of which too much was not scanned are air.
    """
    hu = window.to_hu(case["volume"])
    body = without_table(hu, grid)
    table = torch.where(body == hu, AIR, hu)
    masks = sample(case["masks"], points, "zeros")
    moved = AIR + torch.from_numpy(_cubic((body - AIR)[0].numpy(), points))[None]
    aerated = (masks[0] - masks[2]).clamp(min=0)
    moved = AIR + (moved - AIR) * torch.exp(-lungs * aerated)
    shift = _back(moved[0], grid) - _back(body[0], grid)
    moved = torch.maximum(moved, _shifted(table, shift, grid))
    in_scan = _scanned_slices(hu, points, grid)
    moved = torch.where(in_scan, moved, AIR)
    return lacking(case, "affine", "centred_on") | {
        "volume": window.to_range(moved), "masks": masks.clamp(0, 1) * in_scan}


def _cubic(image: np.ndarray, points: Tensor) -> np.ndarray:
    """An image (X, Y, Z) at `points` (3, ...) by cubic splines, which keep its grain; 0 beyond it."""
    index = [(points[a].numpy() + 1) * n / 2 - 0.5 for a, n in enumerate(image.shape)]
    return scipy.ndimage.map_coordinates(image, index, order=3, mode="grid-constant").astype(np.float32)


def _back(hu: Tensor, grid: Grid) -> float:
    """The place along y, in voxels, of the back: the median over the slices and columns of the middle."""
    reach = max(1, round(BACK_MM / grid.spacing[0]))
    middle = hu.shape[0] // 2
    tissue = hu[middle - reach:middle + reach] > -500
    filled = tissue.any(1)
    return float(tissue.int().argmax(1)[filled].float().median()) if filled.any() else 0.0


def _shifted(table: Tensor, voxels: float, grid: Grid) -> Tensor:
    points = places(grid.shape)
    points[1] -= 2 * voxels / grid.shape[1]
    return AIR + sample(table - AIR, points, "zeros")


def _scanned_slices(hu: Tensor, points: Tensor, grid: Grid) -> Tensor:
    """Which slices (1, 1, Z) of the new CT come from slices that were scanned, judged by the middle of each."""
    from_scan = sample(scanned(hu).expand_as(hu).contiguous(), points, "zeros")[0]
    quarter = [slice(n // 4, n - n // 4) for n in grid.shape[:2]]
    return (from_scan[tuple(quarter)] > 0.5).float().mean((0, 1)).gt(LEAST_SCANNED)[None, None]
