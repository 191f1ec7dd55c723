"""Findings put into a CT: the phantoms' painters, led by the CT's own lungs."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy

from phydict.datasets.phantoms.canvas import Canvas, Texture
from phydict.datasets.phantoms.findings import Finding
from phydict.datasets.phantoms.lungs import focal_findings, pleural_space
from phydict.datasets.phantoms.thorax import SIDES, Thorax
from phydict.grid import Grid

LEAST_ML = 300.0
"""A lung of less takes no findings."""


@dataclass(frozen=True, eq=False, kw_only=True)
class CTThorax(Thorax):
    """A thorax whose lungs are those of a CT; its lobes and ribs are the standard thorax's, fitted to their box.

    grid: the CT's voxels. depths: by side, signed distances (X, Y, Z) in mm from the lung's surface, negative inside.
    """

    grid: Grid
    depths: dict[str, np.ndarray]

    @classmethod
    def around(cls, lung: np.ndarray, grid: Grid, contrast: bool, findings: tuple[Finding, ...], seed: int) -> CTThorax:
        """Of the lungs' mask (X, Y, Z) on `grid`, which follows the world's axes; the mask must not be empty."""
        inside = lung > 0.5
        index = np.argwhere(inside)
        low, high = grid.affine[:3, 3] + (np.stack([index.min(0), index.max(0)]) + [[-0.5], [0.5]]) * grid.spacing
        offset, (width, depth, height) = (low + high) / 2, high - low
        x = grid.affine[0, 3] + np.arange(grid.shape[0])[:, None, None] * grid.spacing[0] - offset[0]
        depths = {}
        for side, sign in SIDES.items():
            lung = inside & (sign * x > 0)
            outer, inner = (scipy.ndimage.distance_transform_edt(m, grid.spacing) for m in (~lung, lung))
            depths[side] = (outer - inner - np.sign(outer - inner) * min(grid.spacing) / 2).astype(np.float32)
        standard = replace(Thorax.standard(), seed=seed, offset=tuple(offset), width=width / 2, depth=depth / 2,
                           height=height, kyphosis=0.0, contrast=contrast, findings=findings)
        return cls(**vars(standard), grid=grid, depths=depths)

    def lung(self, side: str, x, y, z):
        points = np.stack(np.broadcast_arrays(x, y, z), -1) + self.offset
        return scipy.ndimage.map_coordinates(self.depths[side], np.moveaxis(self.grid.index(points), -1, 0), order=1,
                                             mode="nearest")

    def lung_points(self, side: str) -> tuple[np.ndarray, float]:  # type: ignore[override]
        index = np.argwhere(self.depths[side] < -2)
        points = index @ self.grid.affine[:3, :3].T + self.grid.affine[:3, 3] - self.offset
        return points, float(len(index) * np.prod(self.grid.spacing))


def put_findings(hu: np.ndarray, masks: np.ndarray, grid: Grid, findings: tuple[Finding, ...], contrast: bool,
                 seed: int) -> tuple[np.ndarray, np.ndarray, tuple[Finding, ...]]:
    """HU (X, Y, Z), masks (3, X, Y, Z) of lung, airway and vessels, and the findings that were put in.

    Findings of a side whose lung has less than LEAST_ML are left out. Voxels change by their share of lung alone.
    contrast: whether the CT shows contrast agent, which findings then take up.
    """
    lung = masks[0]
    if not (lung > 0.5).any():
        return hu, masks, ()
    thorax = CTThorax.around(lung, grid, contrast, findings, seed)
    large = {side for side in SIDES if thorax.lung_points(side)[1] >= 1000 * LEAST_ML}
    findings = tuple(finding for finding in findings if finding.side in large)
    if not findings:
        return hu, masks, ()
    canvas = Canvas(replace(thorax, findings=findings), grid)
    inner = lung > 0.99
    before = np.where(inner, hu, np.median(hu[inner if inner.any() else lung > 0.5])).astype(np.float32)
    tissue = before.copy()
    focal_findings(canvas, tissue, Texture(seed, 0, 16.0)(*canvas.axes))
    pleural = pleural_space(canvas, tissue)
    masks = np.stack([lung * (1 - pleural), masks[1], masks[2] * (1 - pleural)])
    return hu + lung * (tissue - before), masks, findings
