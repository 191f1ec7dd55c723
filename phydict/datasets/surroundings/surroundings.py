"""Drawing what lies around a chest."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from phydict.datasets.surroundings.arms import Arm
from phydict.datasets.surroundings.couches import Couch
from phydict.datasets.surroundings.covers import Cover
from phydict.datasets.surroundings.leads import Lead
from phydict.datasets.surroundings.scene import Scene
from phydict.grid import Grid
from phydict.runtime.ranges import check_fields

FIELD_MM = 560.0
"""Largest diameter of the scanner's field that is drawn for what lies around a body."""


@dataclass(frozen=True)
class Surroundings:
    """Shares of the cases, in [0, 1], whose surroundings or scan are changed; 0 leaves that kind out.

    Nothing inside the body changes but by `field` and `ends`.

    Args:
        table: couch and clothes are taken away
        couch: another couch is put in, of those whose own is gone, by `table` or by `Augmentation.girth`
        cover: a sheet, clothes or a blanket lies on the body
        leads: ECG leads, cables or tubes lie on the chest
        arms: one or both arms lie beside the body
        field: a circular field of view of 310 to 400 mm cuts the body
        ends: the scan ends at any height, of those without a report, which may tell of what is cut off
    """

    table: float = 0.7
    couch: float = 0.85
    cover: float = 0.25
    leads: float = 0.2
    arms: float = 0.15
    field: float = 0.15
    ends: float = 0.2

    def __post_init__(self):
        check_fields(self, "data.augmentation.surroundings", **dict.fromkeys(vars(self), (0, 1)))

    @classmethod
    def none(cls) -> Surroundings:
        return cls(**{field.name: 0.0 for field in fields(cls)})

    @property
    def adds(self) -> bool:
        """Whether anything may be put around a body."""
        return any((self.table and self.couch, self.cover, self.leads, self.arms))


def surround(hu: np.ndarray, body: np.ndarray, grid: Grid, seed: int, shares: Surroundings,
             couch: bool = True) -> np.ndarray:
    """HU (X, Y, Z) of a chest among what `seed` draws of couch, cover, leads and arms.

    body: (X, Y, Z) bool, where HU stay as they are. couch: whether the chest has none, so that one may be drawn. Each
    kind depends on `seed` and its own share alone.
    """
    arms, leads, cover, couches, field = (np.random.default_rng([seed, stream]) for stream in range(5))
    drawn: list[Arm | Lead | Cover | Couch] = [
        *(Arm.draw_pair(arms) if arms.random() < shares.arms else []),
        *(Lead.draw_set(leads) if leads.random() < shares.leads else []),
        *([Cover.draw(cover)] if cover.random() < shares.cover else []),
        *([Couch.draw(couches)] if couch and couches.random() < shares.couch else [])]
    if not drawn or not body.any():
        return hu
    scene = Scene(np.array(hu, np.float32), body, grid, _field(field, body, grid))
    for thing in drawn:
        thing.add_to(scene)
    return scene.hu


def _field(rng: np.random.Generator, body: np.ndarray, grid: Grid) -> float:
    """A diameter in mm of a field of view that contains the body."""
    x, y = (np.ptp(np.flatnonzero(body.any(tuple({0, 1, 2} - {a})))) * grid.spacing[a] for a in (0, 1))
    least = max(x, 0.9 * np.hypot(x, y)) + 10
    return float(least + rng.random() * max(FIELD_MM - least, 0))
