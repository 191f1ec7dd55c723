"""The parameters of a procedural thorax, and its large organs as signed distances in millimetres.

Lengths are mm in the thorax's own frame: x right, y anterior, z superior, origin at the centre of the lungs; `offset`
moves it into the world. Shape functions take arrays x, y, z that broadcast together and return a distance that is
negative inside; it is exact to first order at the surface, which is what partial-volume edges need.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
import scipy

from phydict.datasets.phantoms.findings import Finding, draw_findings
from phydict.datasets.prose import write_report
from phydict.datasets.surroundings.couches import Couch


class Curve:
    """A smooth curve through (places, values) that rises and falls where they do."""

    def __init__(self, places, values):
        self.places, self.values = places, values

    def __call__(self, at) -> np.ndarray:
        return self._interpolator(at)

    @cached_property
    def _interpolator(self):
        return scipy.interpolate.PchipInterpolator(self.places, self.values)


LEVELS = np.array([-0.8, 0.0, 0.2, 0.4, 0.6, 0.75, 0.86, 0.95, 1.0, 1.3])
CAGE_WIDTH = Curve(LEVELS, [0.95, 1.0, 1.0, 0.98, 0.93, 0.86, 0.76, 0.62, 0.53, 0.44])
CAGE_DEPTH = Curve(LEVELS, [0.97, 1.0, 1.0, 0.975, 0.91, 0.81, 0.74, 0.67, 0.61, 0.52])
MEDIASTINUM_LEVEL = Curve([-1, 0.0, 0.4, 0.6, 0.8, 1.0, 1.5], [0.8, 0.8, 0.85, 1.0, 0.95, 1.05, 1.1])
MEDIASTINUM_DEPTH = Curve([-2, -0.9, -0.45, -0.1, 0.35, 0.7, 1.0, 2], [21, 21, 27, 31, 27, 14, 7, 7])
SHOULDER = Curve([-0.8, 0.0, 0.5, 0.75, 0.9, 1.2], [-2.0, 0.0, 6.0, 10.0, 13.0, 13.0])
SIDES = {"right": 1.0, "left": -1.0}
ARMS = ((False, False), (False, False), (False, True), (True, False))
"""Raised arms (right, left) of those who do not raise both."""

LEAST_SCAN = 120.0
"""mm that a short scan shows at least."""


LUNG_POINTS = 9000
"""How many are drawn in the box around a lung; those inside the lung stand for it."""


@dataclass(frozen=True)
class Thorax:
    """Everything needed to build one phantom and to write its report; draw one with `Thorax.draw(seed)`.

    width, depth, height: half-width, half-depth and full height of the lung cavity in mm.
    wall, back, fat: mm of chest wall at the sides, extra muscle at the back, subcutaneous fat.
    kyphosis: mm by which the spine bends forwards from its hindmost level to the apices.
    dome: height in mm of the left diaphragm dome over the deepest recess; dome_step: how much higher the right one is.
    heart: cardiothoracic ratio without cardiomegaly. parenchyma, gravity: HU of aerated lung, its gradient to the back.
    blood: HU of (right heart and pulmonary arteries, left heart and aorta), cava: HU of the superior vena cava.
    noise: standard deviation in HU of voxels of 1.5 mm.
    marbling: how much fat lies between the muscles, muscle_hu: HU of muscle without it.
    scan: (low, high) world z in mm of the scanned range, field: diameter in mm of the reconstructed field of view,
    both -1000 HU outside. couch: what the patient lies on, None for nothing. arms: whether the (right, left) arm is
    raised; else it lies beside the body.
    """

    seed: int
    offset: tuple[float, float, float]
    width: float
    depth: float
    height: float
    wall: float
    back: float
    fat: float
    marbling: float
    muscle_hu: float
    dome: float
    dome_step: float
    heart: float
    heart_turn: float
    breast: float
    arm_width: float
    spine: float
    vertebra: float
    rib_slope: float
    kyphosis: float
    aorta: float
    trachea: float
    parenchyma: float
    gravity: float
    bone: float
    contrast: bool
    blood: tuple[float, float]
    cava: float
    liver_hu: float
    gas: float
    couch: Couch | None
    arms: tuple[bool, bool]
    round_field: bool
    field: float
    scan: tuple[float, float]
    noise: float
    findings: tuple[Finding, ...] = ()

    @classmethod
    def draw(cls, seed: int) -> Thorax:
        """A random thorax, the same for the same `seed` (an integer >= 0)."""
        if seed < 0:
            raise ValueError(f"a phantom's seed is an integer >= 0, but {seed} was given")
        rng = np.random.default_rng([seed, 1])
        uniform = rng.uniform
        size = uniform(0.93, 1.06)
        height = size * uniform(236, 282)
        offset = tuple(uniform(-15, 15, 3).tolist())
        contrast = bool(rng.random() < 0.6)
        blood = (uniform(110, 300), uniform(120, 260)) if contrast else (uniform(35, 50),) * 2
        apex, base = offset[2] + height / 2, offset[2] - height / 2
        whole = rng.random() < 0.08
        scan = (-400.0, 400.0) if whole else (base - uniform(8, 95), apex + uniform(5, 38))
        findings, pose = draw_findings(np.random.default_rng([seed, 2])), np.random.default_rng([seed, 11])
        if not findings and pose.random() < 0.35:
            ends = base + np.sort(pose.uniform(0, 1, 2)) * (height - LEAST_SCAN)
            low, high = [(float(ends[0]), scan[1]), (scan[0], float(ends[1]) + LEAST_SCAN)][int(pose.integers(2))]
            scan = (low, high)
        stout = pose.uniform(44, 120) if pose.random() < 0.06 else None
        return cls(
            seed=seed, offset=offset, width=size * uniform(126, 146), depth=size * uniform(88, 105), height=height,
            wall=uniform(9, 17), back=uniform(6, 13), fat=stout or float(np.clip(rng.gamma(5.0, 4.2), 6, 44)),
            marbling=uniform(0.45, 1.25), muscle_hu=uniform(36, 62) + (8 if contrast else 0),
            dome=uniform(42, 66), dome_step=uniform(4, 20), heart=uniform(0.42, 0.49), heart_turn=uniform(0.45, 0.8),
            breast=uniform(0.6, 1.3) if rng.random() < 0.4 else 0.0, arm_width=uniform(36, 46),
            spine=uniform(16.5, 20.0), vertebra=size * uniform(21, 25), rib_slope=uniform(0.95, 1.45),
            kyphosis=uniform(8, 28), aorta=uniform(11.5, 16.0), trachea=uniform(5.8, 8.2),
            parenchyma=uniform(-905, -812), gravity=uniform(15, 45), bone=uniform(150, 280), contrast=contrast,
            blood=(float(blood[0]), float(blood[1])), cava=float(blood[0] * (uniform(1.0, 3.0) if contrast else 1.0)),
            liver_hu=uniform(45, 65) + (45 if contrast else 0), gas=uniform(0.0, 1.0),
            couch=Couch.draw(pose) if pose.random() < 0.9 else None,
            arms=ARMS[int(pose.integers(len(ARMS)))] if pose.random() < 0.2 else (True, True),
            round_field=bool(rng.random() < 0.85), field=uniform(320, 470), scan=scan, noise=uniform(8, 32),
            findings=findings)

    @classmethod
    def standard(cls) -> Thorax:
        """The thorax of average size, healthy, without contrast agent, noise or table, scanned as a whole."""
        return cls(
            seed=0, offset=(0.0, 0.0, 0.0), width=136.0, depth=96.0, height=259.0, wall=13.0, back=9.0, fat=20.0,
            marbling=0.7, muscle_hu=55.0, dome=54.0, dome_step=12.0, heart=0.455, heart_turn=0.62, breast=0.0,
            arm_width=41.0, spine=17.2, vertebra=23.0, rib_slope=1.2, kyphosis=18.0, aorta=13.8, trachea=8.0,
            parenchyma=-848.0, gravity=30.0, bone=175.0, contrast=False, blood=(42.0, 42.0), cava=42.0, liver_hu=55.0,
            gas=0.5, couch=None, arms=(True, True), round_field=False, field=800.0, scan=(-400.0, 400.0), noise=0.0)

    def level(self, z):
        """0 at the deepest recess of the lungs, 1 at the apices."""
        return z / self.height + 0.5

    @property
    def carina(self) -> float:
        """z of the tracheal bifurcation."""
        return 0.14 * self.height

    @property
    def horizontal_fissure(self) -> float:
        """z of the fissure under the right upper lobe."""
        return 0.03 * self.height

    @property
    def cortex(self) -> float:
        """HU of compact bone."""
        return 430 + 3.2 * self.bone

    @property
    def back_plane(self) -> float:
        """mm behind the centre, in the scanner's y, of the plane on which the patient lies."""
        return max(self.depth + self.back + 4 + 0.8 * self.fat, self.depth + 28)

    def bend(self, z):
        """mm by which the body at height z lies further forwards in the scanner than in a straight thorax."""
        return self.kyphosis * ((np.clip(self.level(z), -0.5, 1.4) - 0.4) / 0.6) ** 2

    def cage_axes(self, z):
        """Half-width, half-depth and centre y of the rib cage's inner surface at height z."""
        level = np.clip(self.level(z), -0.8, 1.3)
        narrow = CAGE_DEPTH(level)
        return self.width * CAGE_WIDTH(level), self.depth * narrow, -0.75 * self.depth * (1 - narrow)

    def cage(self, x, y, z):
        """Inner surface of the rib cage, open below and above."""
        a, b, centre = self.cage_axes(z)
        return superellipse(x, y - centre, a, b, 2.3)

    def muscle(self, x, y, z):
        """Outer surface of muscle and bone of the trunk without arms and neck."""
        level = np.clip(self.level(z), -0.8, 1.2)
        a = self.width + self.wall + SHOULDER(level)
        b = self.depth + (self.wall + self.back) / 2 + 4
        lean = 0.26 * b * np.clip(level - 0.38, 0, 1) + 0.22 * b * np.clip(level - 0.55, 0, 1)
        belly = 8 * np.clip(1 - 3 * level, 0, 1.5)
        shift = (self.back - self.wall) / 2 + 6 + lean * 0.9 - belly / 2
        trunk = superellipse(x, y + shift, a, b - lean + belly / 2, 2.4)
        top = 0.5 * self.height + 16 + 0.2 * np.maximum(np.abs(x) - 45, 0)
        return smooth_max(trunk, (z - top) * 0.92, 12.0)

    def diaphragm(self, x, y):
        """Height z of the diaphragm: two domes, the right one higher, falling to the recess at wall and back."""
        x, y = np.broadcast_arrays(x, y)
        side = np.abs(x) / self.width - 0.5
        drop = 38 * np.clip(2 * side, 0, 1.3) ** 1.4 + 9 * np.clip(-2 * side, 0, 1) ** 2
        depth = (y - 6) / self.depth
        drop = drop + 62 * np.clip(-depth, 0, 1.4) ** 1.3 + 30 * np.clip(depth, 0, 1.4) ** 2
        right = 1 / (1 + np.exp(-np.clip(x / 14, -30, 30)))
        return -0.5 * self.height + self.dome + 12 + self.dome_step * right - drop

    def heart_ellipsoid(self, ratio: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Centre (3,), rotation (3, 3, rows are the axes) and half-axes (3,) of a heart with cardiothoracic `ratio`."""
        turn, dip = self.heart_turn, 0.45
        long = np.array([-np.cos(dip) * np.cos(turn), np.cos(dip) * np.sin(turn), -np.sin(dip)])
        across = np.cross([0, 0, 1.0], long)
        across /= np.linalg.norm(across)
        axes = np.stack([long, across, np.cross(long, across)])
        unit = np.array([1.0, 0.75, 0.70])
        half = unit * ratio * self.width / np.sqrt(((axes[:, 0] * unit) ** 2).sum())
        reach = np.sqrt(((axes * half[:, None]) ** 2).sum(0))
        front = self.cage_axes(-0.15 * self.height)[1]
        bottom = self.diaphragm(-0.25 * self.width, 0.3 * self.depth) - 8 - 70 * max(ratio - 0.45, 0)
        centre = np.array([-0.34 * reach[0], max(front - reach[1] - 8, -0.9 * self.depth + 52 + reach[1] * 0.62),
                           bottom + 0.78 * reach[2]])
        return centre, axes, half

    def spine_y(self, z):
        """y of the vertebral bodies' centres: a gentle kyphosis along the back of the cage."""
        return -self.depth + 37 + 10 * (self.level(z) - 0.45) ** 2 * 2

    def lung(self, side: str, x, y, z):
        """One lung's cavity with the heart of `heart` and the spine cut out; findings do not change it."""
        s = SIDES[side]
        _, b, centre = self.cage_axes(z)
        inner = MEDIASTINUM_LEVEL(np.clip(self.level(z), -1, 1.5)) * MEDIASTINUM_DEPTH(np.clip((y - centre) / b, -2, 2))
        inner = inner - 3 * s
        floor = self.diaphragm(x, y)
        apex_x, apex_y = s * x - 0.33 * self.width, y + 0.32 * self.depth
        apex = np.sqrt(apex_x**2 + apex_y**2) / 34
        roof = 0.5 * self.height - 10 * apex**2
        wall = smooth_max(self.cage(x, y, z), (z - roof) / np.sqrt(1 + (0.6 * apex) ** 2), 10.0)
        wall = np.maximum(wall, inner - s * x)
        wall = smooth_max(wall, (floor - z) * 0.8, 3.0)
        column = np.hypot(x, y - self.spine_y(z) + 4) - self.spine - 8
        return np.maximum(np.maximum(wall, -column), 2 - ellipsoid(x, y, z, *self.heart_ellipsoid(self.heart)))

    def lobe(self, side: str, lobe: str, x, y, z):
        """Half-spaces of a lobe, bounded by the oblique and (right) the horizontal fissure."""
        above = (z - 0.02 * self.height + 0.95 * (y + 0.1 * self.depth)) * 0.72
        if lobe == "lower":
            return above + 0 * x
        if side == "left":
            return -above + 0 * x
        shelf = z - self.horizontal_fissure
        return np.maximum(-above, shelf if lobe == "middle" else -shelf) + 0 * x

    @lru_cache(maxsize=8)  # noqa: B019
    def lung_points(self, side: str) -> tuple[np.ndarray, float]:
        """Points (N, 3) spread evenly inside one lung, at least 2 mm deep, and that region's volume in mm^3."""
        rng = np.random.default_rng([self.seed, 3, int(SIDES[side] > 0)])
        box = np.array([self.width, 2 * self.depth, self.height])
        points = rng.random((LUNG_POINTS, 3)) * box - [0, self.depth, self.height / 2]
        points[:, 0] *= SIDES[side]
        inside = points[self.lung(side, *points.T) < -2]
        inside.setflags(write=False)
        return inside, float(box.prod() * len(inside) / LUNG_POINTS)


def superellipse(x, y, a, b, power: float):
    """Distance along the ray from the centre to the curve |x/a|^p + |y/b|^p = 1."""
    size = (np.abs(x / a) ** power + np.abs(y / b) ** power) ** (1 / power)
    return np.sqrt(x * x + y * y) * (1 - 1 / np.maximum(size, 1e-3))


def ellipsoid(x, y, z, centre, axes, half):
    """Distance to an ellipsoid, to first order at its surface; rows of `axes` are its unit axes."""
    parts = [(axis[0] * (x - centre[0]) + axis[1] * (y - centre[1]) + axis[2] * (z - centre[2])) / length
             for axis, length in zip(axes, half)]
    size = np.sqrt(sum(part**2 for part in parts))
    gradient = np.sqrt(sum((part / length) ** 2 for part, length in zip(parts, half)))
    return np.where(size > 1e-4, size * (size - 1) / np.maximum(gradient, 1e-6), -np.min(half))


def smooth_max(a, b, width: float):
    """Intersection of two bodies whose common edge is rounded over `width` mm."""
    blend = np.maximum(width - np.abs(a - b), 0) / width
    return np.maximum(a, b) + blend * blend * width / 4


def report(thorax: Thorax) -> str:
    """The radiology report of `thorax`, with a Findings and an Impression section."""
    return write_report(thorax.findings, thorax.contrast, thorax.seed)


def without(thorax: Thorax) -> Thorax:
    """The healthy twin: the same thorax and noise without its findings."""
    return replace(thorax, findings=())


def wrong_side(thorax: Thorax) -> Thorax:
    """The same thorax with every finding on the other side; its report is the wrong-side report."""
    return replace(thorax, findings=tuple(finding.mirrored for finding in thorax.findings))
