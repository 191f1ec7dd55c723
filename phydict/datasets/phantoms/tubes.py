"""Bundles of thin tubes (vessels, bronchi, bones) and their exact partial volume on any voxel grid.

A tube is filled with weighted points, each standing for a small volume; a voxel's share is the volume of the points
that fall into it. That keeps the volume of a vessel however thin it is against the voxels.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

GOLDEN_ANGLE = np.pi * (3 - np.sqrt(5))

MURRAY = 2.5
"""The power m of Murray's law: r^m of a tube is the sum of those that it forks into."""


@dataclass(frozen=True)
class Tubes:
    """N straight tubes in mm: start, end (N, 3); half-axis at both ends and the second half-axis over the first (N,).

    The first half-axis lies as near to the superior direction as the tube allows (to the right for a steep tube).
    `hu` is the value of the wall, `core_hu` of the inner fraction `core` of the cross-section.
    """

    start: np.ndarray
    end: np.ndarray
    start_radius: np.ndarray
    end_radius: np.ndarray
    flat: np.ndarray
    hu: np.ndarray
    core_hu: np.ndarray
    core: np.ndarray

    @classmethod
    def of(cls, start, end, start_radius, end_radius=None, flat=1.0, hu=0.0, core_hu=None, core=0.0) -> Tubes:
        """Tubes from arrays or single numbers."""
        start, end = np.atleast_2d(start).astype(float), np.atleast_2d(end).astype(float)
        values = (start_radius, start_radius if end_radius is None else end_radius, flat, hu,
                  hu if core_hu is None else core_hu, core)
        return cls(start, end, *(np.broadcast_to(np.asarray(v, float), len(start)) for v in values))

    @classmethod
    def chain(cls, points, radius, flat=1.0, hu=0.0, core_hu=None, core=0.0) -> Tubes:
        """One curved tube through `points` (M, 3); `radius` is a number or one per point."""
        points = np.asarray(points, float)
        radius = np.broadcast_to(np.asarray(radius, float), len(points))
        return cls.of(points[:-1], points[1:], radius[:-1], radius[1:], flat, hu, core_hu, core)

    @classmethod
    def join(cls, bundles: list[Tubes]) -> Tubes:
        """All tubes of several bundles."""
        return cls(*(np.concatenate([getattr(b, f.name) for b in bundles]) for f in fields(cls)))

    def points(self, pitch: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Points (P, 3) about `pitch` mm apart that fill the tubes, the mm^3 each stands for and its HU."""
        line = self.end - self.start
        length = np.linalg.norm(line, axis=1)
        axis = line / np.maximum(length, 1e-9)[:, None]
        steep = np.abs(axis[:, 2:]) > 0.75
        up = np.where(steep, [1.0, 0, 0], [0, 0, 1.0])
        up = up - (up * axis).sum(1, keepdims=True) * axis
        up /= np.linalg.norm(up, axis=1, keepdims=True)
        across = np.cross(axis, up)
        slices = np.maximum(np.ceil(length / pitch), 1).astype(int)
        tube = np.repeat(np.arange(len(slices)), slices)
        order = np.arange(len(tube)) - np.repeat(np.cumsum(slices) - slices, slices)
        place = (order + 0.5) / slices[tube]
        radius = self.start_radius[tube] * (1 - place) + self.end_radius[tube] * place
        area = np.pi * radius**2 * self.flat[tube]
        dots = np.maximum(np.round(area / pitch**2), 1).astype(int)
        ring = np.repeat(np.arange(len(tube)), dots)
        dot = np.arange(len(ring)) - np.repeat(np.cumsum(dots) - dots, dots)
        reach = radius[ring] * np.sqrt((dot + 0.5) / dots[ring]) * (dots[ring] > 1)
        angle = GOLDEN_ANGLE * dot + 2.2 * ring
        t = tube[ring]
        spread = (reach * np.cos(angle))[:, None] * up[t] + (reach * np.sin(angle) * self.flat[t])[:, None] * across[t]
        inner = np.clip(self.core[t] * dots[ring] - dot, 0, 1)
        hu = self.hu[t] + inner * (self.core_hu[t] - self.hu[t])
        volume = (area * length[tube] / slices[tube] / dots)[ring]
        return self.start[t] + place[ring][:, None] * line[t] + spread, volume, hu


def tree(root, targets: np.ndarray, leaf_radius: float, hu: float, pull: float = 0.4) -> Tubes:
    """A tree that forks from `root` (3,) until it reaches every target (N, 3); N is a power of two.

    Each fork halves the targets along their widest direction; the radius follows Murray's law.
    """
    count = len(targets)
    if count < 1 or count & (count - 1):
        raise ValueError(f"a tree needs a power of two of targets, but {count} were given")
    nodes, groups, bundles = np.asarray(root, float)[None], np.asarray(targets)[None], []
    while groups.shape[1] > 1:
        half = groups.shape[1] // 2
        widest = np.ptp(groups, axis=1).argmax(1)
        order = np.take_along_axis(groups, widest[:, None, None], 2)[..., 0].argsort(1)
        groups = np.take_along_axis(groups, order[..., None], 1).reshape(-1, half, 3)
        parents = np.repeat(nodes, 2, axis=0)
        nodes = parents + (1.0 if half == 1 else pull) * (groups.mean(1) - parents)
        radius = leaf_radius * half ** (1 / MURRAY)
        bundles.append(Tubes.of(parents, nodes, radius * 1.08, radius * 0.92, hu=hu))
    return Tubes.join(bundles)
