"""The bones of a procedural thorax: ribs and their cartilage, sternum, clavicles, scapulae, arms, vertebral arches."""

from __future__ import annotations

import numpy as np

from phydict.datasets.phantoms.thorax import Thorax
from phydict.datasets.phantoms.tubes import Tubes

RIB_DROP = np.array([34, 52, 66, 76, 84, 88, 90, 88, 80, 66, 44, 26.0])
RIB_END = np.array([52, 56, 56, 54, 52, 48, 44, 34, 24, 12, -14, -40.0])
"""Per rib pair: mm of descent from spine to front, and degrees around the cage where the bone ends (90 = front)."""


def bones(thorax: Thorax) -> Tubes:
    """All bones but the vertebral bodies, in the thorax's own frame."""
    parts = [_sternum(thorax), *_arches(thorax)]
    for side in (1.0, -1.0):
        parts += [rib for number in range(12) for rib in _rib(thorax, number, side)]
        parts += _shoulder(thorax, side)
    return Tubes.join(parts)


def _sternum_point(thorax: Thorax, below_apex: float) -> np.ndarray:
    z = 0.5 * thorax.height - below_apex
    _, depth, centre = thorax.cage_axes(z)
    return np.array([0.0, centre + depth + 8, z])


def _sternum(thorax: Thorax) -> Tubes:
    levels = np.linspace(36, 36 + 0.68 * thorax.height, 8)
    points = np.stack([_sternum_point(thorax, level) for level in levels])
    return Tubes.chain(points, [22, 24, 17, 17, 18, 18, 14, 6], 0.32, hu=0.6 * thorax.cortex,
                       core_hu=thorax.bone * 0.6, core=0.65)


def _rib(thorax: Thorax, number: int, side: float) -> list[Tubes]:
    head = 0.5 * thorax.height - 4 - number * thorax.vertebra
    angle = np.radians(np.linspace(-64, RIB_END[number], 22))
    progress = (angle - angle[0]) / np.radians(120)
    z = head - thorax.rib_slope * RIB_DROP[number] * progress**0.9
    width, depth, centre = thorax.cage_axes(z)
    cos, sin = np.cos(angle), np.sin(angle)
    x = (width + 5) * cos ** (2 / 2.3)
    y = centre + (depth + 5) * np.sign(sin) * np.abs(sin) ** (2 / 2.3)
    back = thorax.spine_y(head)
    start = np.array([[thorax.spine * 0.8, back - 12, head], [thorax.spine + 20, back - 25, head - 2]])
    points = np.concatenate([start, np.stack([x, y, z], 1)]) * [side, 1, 1]
    parts = [Tubes.chain(points, 5.2, 0.55, hu=thorax.cortex, core_hu=thorax.bone, core=0.55)]
    if number < 7:
        front = _sternum_point(thorax, 44 + 0.083 * thorax.height * number) + [side * 16, -2, 0]
        middle = (points[-1] + front) / 2 + [side * 6, 4, -6 - number]
        parts.append(Tubes.chain([points[-1], middle, front], 5.0, hu=105))
    return parts


def _shoulder(thorax: Thorax, side: float) -> list[Tubes]:
    top = 0.5 * thorax.height
    mirror = np.array([side, 1, 1])
    outer = thorax.width + thorax.wall + 10
    joint = np.array([outer + 6, -20, top + 14])
    front = _sternum_point(thorax, 34)
    clavicle = np.array([[20, front[1], front[2]], [55, front[1] - 6, top - 6], [95, -16, top + 10],
                         [outer - 8, -26, top + 26]])
    parts = [Tubes.chain(clavicle * mirror, [8, 6, 5.5, 6], hu=thorax.cortex, core_hu=thorax.bone, core=0.35)]
    for share in np.linspace(0, 1, 12):
        z = top + 8 - 138 * share
        width, depth, centre = thorax.cage_axes(z)
        medial = 68 + 14 * share
        lateral = (outer - 6) * (1 - share) + (medial + 16) * share
        reach = np.sqrt(1 - np.clip(np.array([medial, lateral]) / (width + 22), 0, 0.97) ** 2)
        y = centre - (depth + 15) * reach
        ends = np.array([[medial, y[0], z], [(medial + lateral) / 2, y.mean() - 5, z],
                         [lateral, y[1] + 4 * (1 - share), z]])
        parts.append(Tubes.chain(ends * mirror, [7, 7, 8], [0.3, 0.6], hu=0.8 * thorax.cortex,
                                 core_hu=thorax.bone, core=0.4))
    ridge = np.array([[74, -0.95 * thorax.depth - 22, top - 48], [105, -0.75 * thorax.depth - 18, top - 16],
                      [outer + 4, -40, top + 30]])
    parts.append(Tubes.chain(ridge * mirror, 6, 0.7, hu=0.8 * thorax.cortex, core_hu=thorax.bone, core=0.3))
    parts.append(Tubes.of((joint - [0, 0, 20]) * mirror, (joint + [0, 0, 20]) * mirror, 21, hu=0.7 * thorax.cortex,
                          core_hu=thorax.bone, core=0.75))
    parts.append(Tubes.of((joint + [0, 0, 12]) * mirror, arm_end(thorax, side), 12, hu=1.1 * thorax.cortex,
                          core_hu=40, core=0.4))
    return parts


def arm_end(thorax: Thorax, side: float) -> np.ndarray:
    """A point of an arm's axis far above the shoulder, or far below it where the arm is not raised."""
    outer = thorax.width + thorax.wall
    if thorax.arms[0 if side > 0 else 1]:
        return np.array([side * (outer + 4), 6, 0.5 * thorax.height + 200])
    return np.array([side * (outer + 2 * thorax.fat + thorax.arm_width + 25), -18, -0.5 * thorax.height - 120])


def _arches(thorax: Thorax) -> list[Tubes]:
    numbers = np.arange(-9, 22)
    z = 0.5 * thorax.height - 4 - numbers * thorax.vertebra
    y, wide = thorax.spine_y(z), thorax.spine

    def at(x, behind, lower=0.0):
        return np.stack([np.full(z.shape, float(x)), y - behind, z - lower], 1)

    rear = 0.8 * wide
    parts = [Tubes.of(at(0, rear + 19), at(0, rear + 36, 18), 7, 4, 0.5, 0.75 * thorax.cortex, thorax.bone, 0.35)]
    for side in (1, -1):
        parts.append(Tubes.of(at(11 * side, rear - 3), at(12 * side, rear + 9), 5, hu=0.7 * thorax.cortex,
                              core_hu=thorax.bone, core=0.4))
        parts.append(Tubes.of(at(12 * side, rear + 9), at(1 * side, rear + 20), 7, flat=0.5, hu=0.8 * thorax.cortex,
                              core_hu=thorax.bone, core=0.3))
        parts.append(Tubes.of(at(12 * side, rear + 9), at(34 * side, rear + 17), 6, 4.5, 0.75, 0.7 * thorax.cortex,
                              thorax.bone, 0.4))
    return parts
