"""Where findings lie, by what a report says of them: kind, side, lobe and size, over a few thoraces."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from phydict.datasets.phantoms.findings import FOCAL, GRADES, KINDS, LOBES, MIDLINE, PLEURAL, Finding
from phydict.datasets.phantoms.thorax import SIDES, Thorax, ellipsoid

ANATOMIES = 3
DIAMETERS = {"nodule": (8.0, 15.0, 25.0), "mass": (38.0, 50.0, 62.0)}
"""mm of the examples of kinds without grades."""


def examples() -> tuple[Finding, ...]:
    """One finding of each kind, place and grade that a report can tell apart."""
    return tuple(
        Finding(kind, side, lobe, size)
        for kind in KINDS for side in MIDLINE.get(kind, ("right", "left"))
        for lobe in (LOBES[side] if kind in FOCAL else ("",))
        for size in DIAMETERS.get(kind) or [sum(band) / 2 for band in GRADES[kind].values()])


@lru_cache(maxsize=4)
def extents(cells: int, side: float) -> np.ndarray:
    """Shares of cells^3 cells of a cube of `side` mm that each of the `examples` fills, (N, cells, cells, cells) in
    [0, 1]: in the mean of a few thoraces, and in units of the largest share of its kind."""
    thoraces = [Thorax.standard(), *(Thorax.draw(seed) for seed in range(1, ANATOMIES))]
    maps = np.stack([sum(_extent(thorax, finding, cells, side) for thorax in thoraces) for finding in examples()])
    kinds = np.array([KINDS.index(finding.kind) for finding in examples()])
    for kind in range(len(KINDS)):
        maps[kinds == kind] /= maps[kinds == kind].max()
    maps.setflags(write=False)
    return maps


def _extent(thorax: Thorax, finding: Finding, cells: int, side: float) -> np.ndarray:
    points, weights = _points(thorax, finding)
    world = points + thorax.offset
    world[:, 1] += thorax.bend(points[:, 2])
    edges = [np.linspace(-side / 2, side / 2, cells + 1)] * 3
    return np.histogramdd(world, edges, weights=weights)[0].astype(np.float32)


def _points(t: Thorax, finding: Finding) -> tuple[np.ndarray, np.ndarray]:
    """Points (N, 3) of the body that the finding may take, and how much of each it takes, in mm^3."""
    kind = finding.kind
    if kind in MIDLINE and kind != "emphysema":
        return _around_the_heart(t, finding)
    sides = SIDES if kind == "emphysema" else [finding.side]
    points = np.concatenate([t.lung_points(s)[0] for s in sides])
    volume = sum(t.lung_points(s)[1] for s in sides) / len(points)
    if kind in FOCAL:
        points = points[t.lobe(finding.side, finding.lobe, *points.T) < 0]
    _, y, z = points.T
    share = np.ones(len(points))
    if kind in PLEURAL:
        height = y + 0.5 * z if kind == "effusion" else -y - 0.3 * z
        share = (height <= np.quantile(height, finding.size)).astype(float)
    elif kind == "atelectasis":
        height = 0.6 * y + z
        share = (height <= np.quantile(height, finding.size)).astype(float)
    elif kind == "emphysema":
        share = finding.size * np.clip(0.45 + 1.1 * (t.level(z) - 0.35), 0.3, 1.0)
    elif kind in ("consolidation", "opacity"):
        share *= finding.size
    else:  # nodule, mass
        share *= finding.size / len(points)
    return points, volume * share


def _around_the_heart(t: Thorax, finding: Finding) -> tuple[np.ndarray, np.ndarray]:
    grown = finding.kind == "cardiomegaly"
    centre, axes, half = t.heart_ellipsoid(finding.size if grown else t.heart)
    half = half if grown else half + finding.size
    reach = np.sqrt(((axes * half[:, None]) ** 2).sum(0))
    points = centre + reach * np.random.default_rng(0).uniform(-1, 1, (9000, 3))
    inner = t.heart_ellipsoid(t.heart)
    x, y, z = points.T
    inside = (ellipsoid(x, y, z, centre, axes, half) < 0) & (ellipsoid(x, y, z, *inner) > 0)
    return points, inside * (8 * reach.prod() / len(points))
