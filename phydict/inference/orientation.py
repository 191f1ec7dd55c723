"""Whether X-rays and geometry agree on where up and right are: X-rays beside those of a standard thorax."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from phydict.datasets import Thorax, build
from phydict.grid import Grid
from phydict.units import hu_to_mu
from phydict.xray import ConeBeam, Projector
from phydict.xray.binning import binned, binning
from phydict.xray.boxes import in_other_voxels

FLIPS = {"as it is": (1, 1), "flip_rows": (-1, 1), "flip_columns": (1, -1), "flip_rows and flip_columns": (-1, -1)}
CLEAR, LEAST = {"flip_rows": 0.06, "flip_columns": 0.03, "flip_rows and flip_columns": 0.06}, 0.6
"""By how much a flip must agree better with the standard thorax, and how well at least, before it is worth a word."""

MIRRORED = 0.003
"""By how much the frontal views' mean agreement must be better with the patient mirrored. Of nine chest CTs in the
right geometry it was up to 0.024 worse, but for one, 0.001 better."""

SIDE = 32
"""Voxels along each side of the volume that `orientation_doubts` compares with."""


def standard_thorax(grid: Grid) -> np.ndarray:
    """HU (X, Y, Z) of the standard thorax in the middle of a grid, built once for all cases on its voxels."""
    return _built(grid.shape, tuple(grid.affine.flatten()))


@lru_cache(2)
def _built(shape: tuple[int, int, int], affine: tuple[float, ...]) -> np.ndarray:
    return build(Thorax.standard(), Grid(shape, affine=np.reshape(affine, (4, 4))))[0]


def thorax_views(grid: Grid, beam: ConeBeam) -> np.ndarray:
    """X-rays (K, V, U) of the standard thorax."""
    mu = hu_to_mu(torch.from_numpy(standard_thorax(grid)))
    return Projector(grid, beam)(mu[None, None])[0].numpy()


def in_other_sense(beam: ConeBeam, grid: Grid) -> ConeBeam:
    """The beam whose angles run the other way: sources and detectors mirrored left to right about the grid's centre."""
    across = np.array([-1.0, 1.0, 1.0])
    shift = (1 - across) * grid.centre
    return replace(beam, sources=beam.sources * across + shift, detectors=beam.detectors * across + shift,
                   u=-beam.u * across, v=beam.v * across)


def correlation(a: np.ndarray, b: np.ndarray) -> float:
    """Pearson's, in [-1, 1], of two images of one shape; 0 where one is constant."""
    a, b = a - a.mean(), b - b.mean()
    return float((a * b).sum() / max(np.sqrt((a * a).sum() * (b * b).sum()), 1e-12))


def better_flip(xray: np.ndarray, thorax: np.ndarray) -> tuple[str, float]:
    """The flip of a view (V, U) that clearly agrees better with the standard thorax's, and how well; "as it is" where
    none does."""
    scores = {name: correlation(xray[::rows, ::columns], thorax) for name, (rows, columns) in FLIPS.items()}
    clear = [name for name, more in CLEAR.items() if scores[name] > max(scores["as it is"] + more, LEAST)]
    best = max(clear, key=scores.__getitem__, default="as it is")
    return best, scores[best]


def orientation_doubts(xrays: Tensor, beam: ConeBeam, grid: Grid) -> list[str]:
    """Sentences on X-rays (K, V, U) of a chest that agree clearly better with a standard thorax in the middle of the
    grid where they are flipped, the angles run in the other sense, or the patient is mirrored."""
    grid = in_other_voxels(grid, (SIDE,) * 3)
    factor = binning(grid, beam)
    beam, images = beam.binned(factor), binned(xrays.float().cpu(), factor).numpy()
    thorax, opposite = thorax_views(grid, beam), thorax_views(grid, in_other_sense(beam, grid))
    flips = [better_flip(*pair)[0] for pair in zip(images, thorax)]
    views = {flip: ", ".join(str(k) for k, other in enumerate(flips) if other == flip) for flip in FLIPS}
    doubts = [f"view {views[flip]} agrees better with a standard thorax when {how}: row 0 is superior, change {flip}"
              for flip, how in (("flip_rows", "upside down"), ("flip_rows and flip_columns", "turned by 180 degrees"))
              if views[flip]]

    def agreements(others: np.ndarray, flip: str) -> np.ndarray:
        rows, columns = FLIPS[flip]
        return np.array([correlation(image[::rows, ::columns], other) for image, other in zip(images, others)])

    stated, mirrored = agreements(thorax, "as it is"), agreements(opposite, "flip_columns")
    if views["flip_columns"]:
        flipped, turned = agreements(thorax, "flip_columns").mean(), agreements(opposite, "as it is").mean()
        columns = f"change flip_columns (mean agreement of all views {flipped:.3f})"
        sense = (f"negate the angles, which seem to run in the other sense ({turned:.3f}), or put a single view's "
                 "source on the other side, for a left lateral (LL) view the patient's right, 270 degrees of an orbit")
        first, second = (columns, sense) if flipped > turned + MIRRORED else (sense, columns)
        doubts.append(f"view {views['flip_columns']} agrees better with a standard thorax when mirrored (as stated "
                      f"{stated.mean():.3f}): {first}; or else {second}; the wrong one of the two mirrors the patient")
    frontal = np.abs(beam.normals[:, 1]) > np.abs(beam.normals[:, 0])
    if doubts or not frontal.any():
        return doubts
    seen, other = stated[frontal].mean(), mirrored[frontal].mean()
    if other > MIRRORED + max(seen, agreements(thorax, "flip_rows")[frontal].mean()) and other > LEAST:
        doubts.append(f"the patient looks mirrored, with the heart on the right (agreement with a standard thorax "
                      f"{seen:.3f}, mirrored {other:.3f}): check flip_columns and the sense of the angles together")
    return doubts
