"""Where the voxels of a volume are: shape, spacing and the index-to-world affine (RAS+, mm)."""

from __future__ import annotations

import math
import reprlib
from dataclasses import dataclass

import numpy as np

from phydict.runtime.memory import check_memory


def _numbers(values) -> np.ndarray:
    """A copy of `values` as float64, of one axis or more; NaN alone where they are no array of numbers."""
    try:
        array = np.atleast_1d(np.asarray(values))
    except ValueError:  # of rows of different lengths
        return np.full(1, np.nan)
    return array.astype(float) if array.dtype.kind in "iuf" else np.full(1, np.nan)


def whole_sizes(values) -> tuple[int, ...] | None:
    """`values` as whole numbers of 1 or more; None where they are anything else."""
    sizes = _numbers(values)
    if sizes.ndim != 1 or not np.isfinite(sizes).all():
        return None
    return tuple(map(int, sizes)) if (sizes >= 1).all() and (sizes == np.floor(sizes)).all() else None


def index_to_mm(name: str, values) -> np.ndarray:
    """A copy of an affine (4, 4) from voxel indices to mm. Raises ValueError where `values`, which `name` says, cannot
    be one."""
    affine = _numbers(values)
    if affine.shape != (4, 4) or not np.isfinite(affine).all():
        raise ValueError(f"{name} is 4x4 finite numbers, but {reprlib.repr(values)} was given")
    if not np.allclose(affine[3], (0, 0, 0, 1)):
        raise ValueError(f"{name} has the last row 0 0 0 1, but {affine[3].tolist()} was given: transpose it where its "
                         "last column is 0 0 0 1")
    return affine


def centred(axes: np.ndarray, shape: tuple[int, int, int], centre=(0.0, 0.0, 0.0)) -> np.ndarray:
    """The affine (4, 4) of voxels whose steps are the columns of `axes` (3, 3), in mm, about a `centre` in mm."""
    affine = np.eye(4)
    affine[:3, :3] = axes
    affine[:3, 3] = centre - axes @ ((np.asarray(shape) - 1) / 2)
    return affine


@dataclass(frozen=True, eq=False)
class Grid:
    """A regular voxel grid in RAS+ world millimetres, voxel centres at integer indices.

    shape: (X, Y, Z) voxels.
    spacing: (x, y, z) mm; may be left out when `affine` is given.
    affine: 4x4 index -> world mm. Left out, the grid's centre lies at the isocentre (0, 0, 0) and the axes
        follow the world's. An affine with shear is refused.
    """

    shape: tuple[int, int, int]
    spacing: tuple[float, float, float] = None  # type: ignore[assignment]  # either is made of the other
    affine: np.ndarray = None  # type: ignore[assignment]

    def __post_init__(self):
        shape = whole_sizes(self.shape)
        if shape is None or len(shape) != 3:
            raise ValueError(f"a grid needs three positive sizes (X, Y, Z), whole numbers, but {self.shape} was given")
        check_memory(3 * 4 * math.prod(shape), f"a reconstruction on {' x '.join(map(str, shape))} voxels, three "
                     "volumes at least,", "give fewer voxels")
        given = None if self.spacing is None else _numbers(self.spacing)
        if given is not None and (given.shape not in ((1,), (3,)) or np.isnan(given).any()):
            raise ValueError("a grid's spacing is a length in mm, one for all axes or three, but "
                             f"{reprlib.repr(self.spacing)} was given")
        if self.affine is None:
            if given is None:
                raise ValueError("a grid needs either its spacing in mm or its index-to-world affine")
            spacing = np.broadcast_to(given, 3)
            affine = centred(np.diag(spacing), shape)
        else:
            affine = index_to_mm("a grid's affine", self.affine)
            spacing = np.linalg.norm(affine[:3, :3], axis=0)
            if given is not None and not np.allclose(spacing, given, rtol=1e-4):
                raise ValueError(f"spacing {given.tolist()} mm contradicts the affine's {spacing.tolist()} mm")
        if not (np.isfinite(affine).all() and (spacing > 0).all()):
            raise ValueError(f"a grid's spacing must be positive and finite, but {spacing.tolist()} mm was given")
        axes = affine[:3, :3] / spacing
        cosines = axes.T @ axes - np.eye(3)
        if abs(cosines).max() > 1e-3:
            i, j = sorted(np.unravel_index(abs(cosines).argmax(), (3, 3)))
            raise ValueError(f"the affine has shear: axes {i} and {j} meet at "
                             f"{np.degrees(np.arccos(cosines[i, j])):.1f} degrees instead of 90; resample the volume "
                             "to an orthogonal grid first")
        affine.setflags(write=False)
        object.__setattr__(self, "shape", shape)
        object.__setattr__(self, "spacing", tuple(float(s) for s in spacing))
        object.__setattr__(self, "affine", affine)

    @classmethod
    def cube(cls, voxels: int, side: float = 384.0) -> Grid:
        """`voxels`^3 voxels over a cube of `side` mm centred on the isocentre."""
        count, length = whole_sizes(voxels), _numbers(side)
        if count is None or len(count) != 1:
            raise ValueError("a cube has one whole number of voxels for all sides, 1 or more, but "
                             f"{reprlib.repr(voxels)} was given; Grid.box takes three")
        if length.shape != (1,) or not 1e-3 < length[0] < 1e6:
            raise ValueError(f"the side of a cube of voxels is one length in mm, but {reprlib.repr(side)} was given; "
                             "Grid.box takes three")
        return cls((count[0],) * 3, (length[0] / count[0],) * 3)

    @classmethod
    def box(cls, voxels, side=384.0, centre=(0.0, 0.0, 0.0)) -> Grid:
        """`voxels` along each side of a box of `side` mm, one number or three each, whose centre lies `centre` mm from
        the isocentre towards right, anterior and superior."""
        shape, lengths, place = whole_sizes(voxels), _numbers(side), _numbers(centre)
        if shape is None or len(shape) not in (1, 3):
            raise ValueError("a box has a whole number of voxels along each side, 1 or more, one for all or three, but "
                             f"{reprlib.repr(voxels)} was given")
        if lengths.shape not in ((1,), (3,)) or not ((lengths > 1e-3) & (lengths < 1e6)).all():
            raise ValueError("the side of a box of voxels is a length in mm, one for all or three, but "
                             f"{reprlib.repr(side)} was given")
        if place.shape != (3,) or not (abs(place) < 1e6).all():
            raise ValueError("the centre of a box of voxels is three numbers in mm from the isocentre, but "
                             f"{reprlib.repr(centre)} was given")
        x, y, z = shape * 3 if len(shape) == 1 else shape
        return cls((x, y, z), affine=centred(np.diag(np.broadcast_to(lengths, 3) / (x, y, z)), (x, y, z), place))

    @property
    def centre(self) -> np.ndarray:
        """World position (3,) in mm of the grid's centre."""
        return self.affine[:3, :3] @ ((np.asarray(self.shape) - 1) / 2) + self.affine[:3, 3]

    def grown(self, x: int, y: int, z: int) -> Grid:
        """The grid with so many voxels more at both ends of each axis."""
        affine = self.affine.copy()
        affine[:3, 3] -= affine[:3, :3] @ (x, y, z)
        return Grid((self.shape[0] + 2 * x, self.shape[1] + 2 * y, self.shape[2] + 2 * z), affine=affine)

    @property
    def is_upright(self) -> bool:
        """Whether the third axis runs up or down the patient, within 45 degrees."""
        return bool(2 * self.affine[2, 2] ** 2 > self.spacing[2] ** 2)

    def turned_as(self, other: Grid) -> Grid:
        """The same voxels about the same centre, stacked in the directions of another grid's axes."""
        axes = other.affine[:3, :3] / other.spacing * self.spacing
        return Grid(self.shape, affine=centred(axes, self.shape, self.centre))

    @property
    def extent(self) -> np.ndarray:
        """Edge lengths (3,) in mm of the box of voxels, from face to face."""
        return np.asarray(self.shape) * self.spacing

    def index(self, world) -> np.ndarray:
        """Voxel indices (..., 3), fractional, of `world` points (..., 3) in mm."""
        return (np.asarray(world, float) - self.affine[:3, 3]) @ np.linalg.inv(self.affine[:3, :3]).T

    def corners(self) -> np.ndarray:
        """World positions (8, 3) in mm of the box's corners (voxel faces, not centres)."""
        ends = np.stack(np.meshgrid(*[(-0.5, n - 0.5) for n in self.shape], indexing="ij"), -1).reshape(-1, 3)
        return ends @ self.affine[:3, :3].T + self.affine[:3, 3]

    def same_as(self, other: Grid) -> bool:
        """Whether both grids have the same voxels, to a thousandth of a voxel."""
        return self.shape == other.shape and np.allclose(
            self.corners(), other.corners(), rtol=0, atol=1e-3 * min(self.spacing))

    def to_dict(self) -> dict:
        """Plain lists, from which `Grid(**d)` builds the same grid."""
        return {"shape": list(self.shape), "affine": self.affine.tolist()}


LONGEST = 48.0
"""Millimetres of the longest voxels on which something of a chest can be seen."""


@dataclass(frozen=True)
class Box:
    """A box of voxels: a whole chest, or a region of interest.

    Args:
        voxels: how many along each side, one number or three (right, anterior, superior)
        side: their lengths in mm, one number or three
        centre: of the box, in mm from the isocentre towards right, anterior and superior
        keep_coarse: whether the coarse volume that was refined is written beside the volume
    """

    voxels: int | tuple[int, int, int] | None = None
    side: float | tuple[float, float, float] = 384.0
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0)
    keep_coarse: bool = False

    def grid(self) -> Grid:
        """Its voxels. Raises ValueError for what cannot be."""
        if self.voxels is None:
            raise ValueError("model.grid needs the number of voxels: give model.grid.voxels, such as 128")
        grid = Grid.box(self.voxels, self.side, self.centre)
        if max(grid.spacing) > LONGEST:
            raise ValueError(f"the {' x '.join(map(str, grid.shape))} voxels of a box are up to {max(grid.spacing):g} "
                             f"mm long, but longer ones than {LONGEST:g} mm show nothing of a chest: give more voxels, "
                             "such as 64, or a shorter side")
        return grid


@dataclass(frozen=True)
class Cube:
    """A cube around the isocentre. Raises ValueError for what cannot be.

    Args:
        voxels: how many along each side
        side: its length in mm
    """

    voxels: int = 64
    side: float = 384.0

    def __post_init__(self):
        self.grid()

    def grid(self) -> Grid:
        """Its voxels."""
        return Grid.cube(self.voxels, self.side)
