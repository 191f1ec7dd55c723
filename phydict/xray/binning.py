"""The benchmarks' orbit, detectors finer than a grid can use, and the binning that makes them fit."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from phydict.grid import Grid
from phydict.xray.geometry import ConeBeam, in_blocks
from phydict.xray.orbits import PIXEL, PIXELS, SOURCE_TO_DETECTOR, SOURCE_TO_ISOCENTRE

LEFT_OUT = 0.01
"""The most of a detector's rows or columns that binning leaves out: of many real detectors sizes have no divisor."""


def benchmark_orbit(grid: Grid, views: int, arc_degrees: float = 360.0) -> ConeBeam:
    """The benchmarks' orbit where the grid has 384 mm, in proportion for others, view k at arc k / views."""
    scale = grid.extent[0] / 384
    return ConeBeam.orbit(views, SOURCE_TO_DETECTOR * scale, SOURCE_TO_ISOCENTRE * scale, (PIXELS, PIXELS),
                          PIXEL * scale, arc_degrees=arc_degrees)


def binning(grid: Grid, beam: ConeBeam) -> int:
    """The largest whole factor by which the detector may be binned while its pixels, seen at the grid's centre, stay
    below 0.7 voxels and at most LEFT_OUT of its rows and of its columns fill no block; finer pixels cost time and carry
    nothing that the grid can hold."""
    limit = 0.7 * min(grid.spacing) / float(pixel_sides(grid, beam).max())
    factors = [f for f in range(1, max(int(limit), 1) + 1) if all(n % f <= LEFT_OUT * n for n in beam.shape)]
    return factors[-1]


def pixel_sides(grid: Grid, beam: ConeBeam) -> np.ndarray:
    """Row height and column width (K, 2) in mm of each view's pixels, seen at the grid's centre."""
    to_detector = beam.detectors - beam.sources
    depth = ((grid.centre - beam.sources) * to_detector).sum(1) / (to_detector**2).sum(1)
    return beam.pixel * depth[:, None]


def binned(xrays: Tensor, factor: int) -> Tensor:
    """X-rays (K, V, U) averaged over blocks of `factor`^2 pixels, as those of `ConeBeam.binned`."""
    rows, columns = (in_blocks(n, factor) for n in xrays.shape[1:])
    return torch.nn.functional.avg_pool2d(xrays[None, :, rows, columns], factor)[0] if factor > 1 else xrays
