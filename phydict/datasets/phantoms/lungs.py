"""What the lungs of a procedural thorax are painted with: tissue, vessels, findings, pleural space and airways.

All but the airways are painted into a volume of lung tissue, which `build` then cuts out with the lungs' shape, so that
a finding meets the pleura without a seam.
"""

from __future__ import annotations

import numpy as np

from phydict.datasets.phantoms.canvas import Canvas, Texture
from phydict.datasets.phantoms.findings import PLEURAL, Finding
from phydict.datasets.phantoms.thorax import SIDES, Thorax
from phydict.datasets.phantoms.tubes import Tubes, tree
from phydict.units import AIR


def lung_tissue(canvas: Canvas, texture: np.ndarray) -> np.ndarray:
    """HU of aerated lung everywhere: gravity gradient, grain, fissures, emphysema with its bullae."""
    t, (x, y, z) = canvas.thorax, canvas.axes
    fine = Texture(t.seed, 1, 7.0)(x, y, z)
    dense = np.clip(fine + texture - 1, 0, 3) ** 2
    tissue = t.parenchyma - t.gravity * (y / t.depth) + 18 * fine + 16 * texture + 14 * dense
    for finding in t.findings:
        if finding.kind == "pneumothorax":
            tissue = tissue + (SIDES[finding.side] * x > 0) * finding.size * 160
    for side, s in SIDES.items():
        oblique = t.lobe(side, "lower", x, y, z)
        fissures = canvas.sheet(oblique, 0.8)
        if side == "right":
            shelf = canvas.sheet(z - t.horizontal_fissure, 0.6)
            fissures = np.maximum(fissures, shelf * (oblique > 0))
        canvas.paint(fissures * (s * x > 0), -500.0, into=tissue)
    for finding in t.findings:
        if finding.kind == "emphysema":
            upper = np.clip(0.45 + 1.1 * (t.level(z) - 0.35), 0.3, 1.0)
            holes = np.clip(0.55 + 0.55 * Texture(t.seed, 2, 18.0)(x, y, z), 0, 1.3)
            canvas.paint(np.clip(finding.size * upper * holes, 0, 1), -965.0, into=tissue)
            rng = np.random.default_rng([finding.seed, 5])
            for side in SIDES:
                points, _ = t.lung_points(side)
                points = points[points[:, 2] > 0.1 * t.height]
                for centre in points[rng.integers(len(points), size=round(14 * finding.size))]:
                    box, bulla = canvas.blob(centre, rng.uniform(4, 6 + 16 * finding.size))
                    canvas.paint(bulla, -985.0, box, tissue)
    return np.asarray(tissue, np.float32)


def vessels(canvas: Canvas, tissue: np.ndarray) -> np.ndarray:
    """Paint arteries and veins from both hila into the lung tissue; returns their share."""
    t = canvas.thorax
    bundles = []
    for side, s in SIDES.items():
        points, _ = t.lung_points(side)
        count = 512 if len(points) >= 1024 else 128
        artery = np.array([s * 44, -14 - 5 * (s < 0), t.carina - 30 + 8 * (s < 0)])
        vein = np.array([s * 36, -14, t.carina - 52])
        bundles.append(tree(artery, points[:count], 0.62, t.blood[0]))
        bundles.append(tree(vein, points[count:2 * count], 0.58, t.blood[1]))
    share, value = canvas.fill(Tubes.join(bundles))
    canvas.paint(share, value, into=tissue)
    return share


def focal_findings(canvas: Canvas, tissue: np.ndarray, texture: np.ndarray) -> None:
    """Paint nodules, masses, consolidations, ground glass and atelectases into the lung tissue."""
    t, (x, y, z) = canvas.thorax, canvas.axes
    for finding in t.findings:
        rng = np.random.default_rng([finding.seed, 5])
        if finding.kind in ("nodule", "mass"):
            radius = finding.size / 2
            centre = _focus(t, finding, rng, radius + 3)
            box, (bx, by, bz) = canvas.box(centre - 1.3 * radius, centre + 1.3 * radius)
            lumps = Texture(finding.seed, 6, max(finding.size * 0.45, 6.0))(bx, by, bz)
            distance = np.sqrt((bx - centre[0]) ** 2 + (by - centre[1]) ** 2 + (bz - centre[2]) ** 2) - radius
            share = canvas.soft(distance + 0.07 * radius * np.clip(lumps, -2, 2)) * (SIDES[finding.side] * bx > 0)
            canvas.paint(share, 38 + (25 if t.contrast else 0) + 6 * texture[box], box, tissue)
        if finding.kind == "atelectasis":
            level = np.quantile(_lowness(*_lobe_points(t, finding).T), finding.size)
            share = np.clip(0.5 - (_lowness(x, y, z) - level) / (canvas.edge + 4), 0, 1)
            share = share * canvas.soft(t.lobe(finding.side, finding.lobe, x, y, z)) * (SIDES[finding.side] * x > 0)
            canvas.paint(0.95 * share, 35 + (35 if t.contrast else 0), into=tissue)
        if finding.kind in ("consolidation", "opacity"):
            ragged = Texture(finding.seed, 6, 22.0)
            centre = _focus(t, finding, rng, 15.0)

            def spread(x, y, z):
                return np.sqrt((x - centre[0]) ** 2 + (y - centre[1]) ** 2 + (z - centre[2]) ** 2) + 7 * ragged(x, y, z)

            level = np.quantile(spread(*_lobe_points(t, finding).T), finding.size) if finding.size < 0.98 else 1e3
            share = np.clip(0.5 - (spread(x, y, z) - level) / (canvas.edge + 8), 0, 1) * (SIDES[finding.side] * x > 0)
            share = share * canvas.soft(t.lobe(finding.side, finding.lobe, x, y, z))
            airless = np.clip(0.93 - 0.06 * texture, 0.75, 1)
            airless = airless if finding.kind == "consolidation" else 0.38 * airless
            canvas.paint(share * airless, 32 + (30 if t.contrast else 0), into=tissue)


def _lowness(x, y, z):
    """A height that rises forwards and upwards: dependent lung, which collapses first, lies low."""
    return 0.6 * y + z + 0 * x


def _lobe_points(t: Thorax, finding: Finding) -> np.ndarray:
    points, _ = t.lung_points(finding.side)
    inside = points[t.lobe(finding.side, finding.lobe, *points.T) < -2]
    return inside if len(inside) else points


def _focus(t: Thorax, finding: Finding, rng: np.random.Generator, depth: float) -> np.ndarray:
    """A point (3,) of the lobe, off the hilum, `depth` mm from the lobe's border or as deep as the lobe allows."""
    points = _lobe_points(t, finding)
    inside = -np.maximum(t.lung(finding.side, *points.T), t.lobe(finding.side, finding.lobe, *points.T))
    deep = points[inside >= min(depth, np.quantile(inside, 0.97))]
    lateral = deep[np.abs(deep[:, 0]) > 0.45 * t.width]
    deep = lateral if len(lateral) else deep
    return deep[rng.integers(len(deep))]


def pleural_space(canvas: Canvas, tissue: np.ndarray) -> np.ndarray:
    """Paint pleural fluid with a rim of compressed lung, and free pleural air; returns their share."""
    t, taken = canvas.thorax, np.zeros_like(tissue)
    for finding in t.findings:
        if finding.kind in PLEURAL:
            side = SIDES[finding.side] * canvas.axes[0] > 0
            depth = _pleural_depth(t, finding, *canvas.axes)
            if finding.kind == "effusion":
                rim = 4 + 18 * finding.size
                canvas.paint(side * np.clip(0.5 - (depth - rim) / (canvas.edge + 8), 0, 1) * 0.85, -40.0, into=tissue)
            share = side * canvas.soft(depth)
            canvas.paint(share, 10.0 if finding.kind == "effusion" else AIR, into=tissue)
            taken = np.maximum(taken, share)
    return taken


def _pleural_depth(t: Thorax, finding: Finding, x, y, z):
    """Distance above a fluid level (or below free air) that fills the finding's fraction of the cavity."""
    sign = 1.0 if finding.kind == "effusion" else -1.0
    tilt, cling = (0.5, 16.0) if finding.kind == "effusion" else (0.3, 22.0)

    def height(x, y, z):
        return (sign * (y + tilt * z) - cling * np.exp(np.minimum(t.cage(x, y, z), 0) / 12)) / np.hypot(1, tilt)

    points, _ = t.lung_points(finding.side)
    return height(x, y, z) - np.quantile(height(*points.T), finding.size)


def airways(canvas: Canvas, pleural: np.ndarray) -> np.ndarray:
    """Trachea, main bronchi and the bronchial tree with their walls; returns the share of air."""
    t, c = canvas.thorax, canvas.thorax.carina
    depth = float(t.spine_y(c)) + 0.8 * t.spine + 24
    top = 0.5 * t.height + 120
    windpipe = [[0, depth + 6, top], [1, depth + 6, 0.5 * t.height], [2, depth, c]]
    main = {"right": [[2, depth, c], [19, depth - 2, c - 15], [40, depth - 5, c - 28]],
            "left": [[2, depth, c], [-20, depth - 3, c - 15], [-43, depth - 6, c - 33]]}
    bundles = []
    for side in SIDES:
        points, _ = t.lung_points(side)
        bundles.append(tree(main[side][-1], points[-64:], 0.55, AIR, 0.45))
    branches = Tubes.join(bundles)
    walls = Tubes.of(branches.start, branches.end, branches.start_radius * 1.15 + 0.4, branches.end_radius * 1.15 + 0.4)
    share, _ = canvas.fill(walls)
    canvas.paint(share * (1 - pleural) * 0.9, 20.0)
    pipes = [(windpipe, t.trachea)] + [(path, t.trachea * np.array([0.8, 0.7, 0.58])) for path in main.values()]
    for path, radius in pipes:
        box, wall = canvas.pipe(path, radius, 1.3)
        canvas.paint(wall, 30.0, box)
    air, _ = canvas.fill(branches)
    air *= 1 - pleural
    for path, radius in pipes:
        box, lumen = canvas.pipe(path, radius)
        air[box] = np.maximum(air[box], lumen)
    canvas.paint(air, AIR)
    return air
