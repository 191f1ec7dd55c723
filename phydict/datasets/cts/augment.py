"""Random change of a patient's anatomy and of how it was scanned, for learning from few CTs."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, fields, replace

import torch

from phydict.datasets.case import Case, lacking
from phydict.datasets.cts.acquisition import change_contrast, cut_ends, cut_field, without_table
from phydict.datasets.cts.anatomy import body_mask
from phydict.datasets.cts.girth import Girth
from phydict.datasets.surroundings.surroundings import Surroundings, surround
from phydict.grid import Grid
from phydict.runtime.ranges import check_fields
from phydict.units import AIR, HUWindow

NAMES_A_SIDE = re.compile(r"\b((left|right|levo|dextro|lingula)\w*|(mid|middle)[\s-]+(lung[\s-]+)?lobes?|"
                          r"azygos[\s-]+lobes?|[LR](t|UL|ML|LL)?)\b", re.IGNORECASE)
"""What makes an English report one of a side."""

FIELD_MM, FIELD_SHIFT_MM = (310.0, 400.0), 15.0
"""Diameters of the scanner's field that `Surroundings.field` draws, and how far it lies off the grid's centre."""

LEAST_SCAN_MM = 120.0
"""Height that `Surroundings.ends` leaves of a scan at least."""


@dataclass(frozen=True)
class Augmentation:
    """How strong random changes of a patient are; 0 leaves that kind out. `Augmentation.none()` changes nothing.

    Nothing is ever turned upside down or back to front.

    Args:
        rotation: degrees, at most, about any axis
        scale: change of the size, at most, along each axis, as a share of it
        shift: length in mm, at most
        elastic_mm: mm, amplitude of the slowest bending
        girth: share of the cases, in [0, 1], whose body's wall grows or shrinks towards a width of 300 to 600 mm, as
            far as GROWTH in girth.py lets it, and that lose their table
        hu_scale: change of HU + 1000, at most, as a share of it
        hu_offset: change of HU, at most, in tissue only
        contrast: change of HU, at most, in blood only
        mirror: share of the cases mirrored left to right among those whose report is empty or names no side (in
            English), in [0, 1]; 0 unless given, since a mirrored thorax has its heart on the right
        surroundings: what lies around the body and how much of it the scan shows
    """

    rotation: float = 8.0
    scale: float = 0.1
    shift: float = 20.0
    elastic_mm: float = 2.5
    girth: float = 0.25
    hu_scale: float = 0.03
    hu_offset: float = 20.0
    contrast: float = 60.0
    mirror: float = 0.0
    surroundings: Surroundings = Surroundings()

    def __post_init__(self):
        negative = [name for name, value in vars(self).items() if name != "surroundings" and not value >= 0]
        if negative:
            raise ValueError(f"augmentation strengths are not negative, but {negative[0]} is "
                             f"{vars(self)[negative[0]]}: give 0 for none")
        if self.scale > 0.5 or self.hu_scale > 0.5 or self.rotation > 45:
            raise ValueError("augmentation is for small changes: rotation up to 45 degrees, scale and gain up to 0.5, "
                             f"but {self.rotation}, {self.scale} and {self.hu_scale} were given")
        check_fields(self, "data.augmentation", girth=(0, 1), mirror=(0, 1))

    @classmethod
    def none(cls) -> Augmentation:
        return cls(**{field.name: 0.0 for field in fields(cls) if field.name != "surroundings"},
                   surroundings=Surroundings.none())


@dataclass(frozen=True)
class Deformation:
    """A small random change of a patient: pose, size, shape and HU.

    rotation: (3,) radians about x, y, z. scale: (3,). shift: (3,) mm. elastic_mm: (3, 4, 4, 4) mm, amplitudes of
    cosines of up to 1.5 periods over the grid. hu_scale: factor of HU + 1000. hu_offset: HU, in tissue only. girth:
    how the wall of the chest grows before all else. mirrored: left to right.
    """

    rotation: torch.Tensor
    scale: torch.Tensor
    shift: torch.Tensor
    elastic_mm: torch.Tensor
    hu_scale: float
    hu_offset: float
    girth: Girth | None = None
    mirrored: bool = False

    @classmethod
    def draw(cls, seed: int | torch.Generator, strength: Augmentation = Augmentation()) -> Deformation:
        """Within `strength`; without its mirroring, which depends on the report, and its changes of the scan."""
        generator = seed if isinstance(seed, torch.Generator) else torch.Generator().manual_seed(int(seed))

        def uniform(size, bound):
            return (2 * torch.rand(size, generator=generator) - 1) * bound

        elastic_mm = torch.randn((3, 4, 4, 4), generator=generator)
        frequency = torch.stack(torch.meshgrid(*[torch.arange(4.0)] * 3, indexing="ij")).pow(2).sum(0)
        bending = elastic_mm * strength.elastic_mm / (1 + frequency.sqrt())
        elastic_mm = torch.where((frequency > 0) & (frequency <= 9), bending, 0.0)
        return cls(uniform(3, math.radians(strength.rotation) / math.sqrt(3)), 1 + uniform(3, strength.scale),
                   uniform(3, strength.shift / math.sqrt(3)), elastic_mm, 1 + float(uniform(1, strength.hu_scale)),
                   float(uniform(1, strength.hu_offset)))

    def sample_points(self, grid: Grid) -> torch.Tensor:
        """(X, Y, Z, 3) mm from the grid's centre, along its axes: where the deformed voxels take their values."""
        axes = [(torch.arange(n) - (n - 1) / 2) * s for n, s in zip(grid.shape, grid.spacing)]
        points = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1)
        a, b, c = self.rotation.tolist()
        turn = torch.linalg.matrix_exp(torch.tensor([[0, -c, b], [c, 0, -a], [-b, a, 0]]))
        cosines = [torch.cos(math.pi * torch.arange(4.0) * (torch.arange(n)[:, None] + 0.5) / n) for n in grid.shape]
        elastic_mm = self.elastic_mm
        for basis in cosines:
            elastic_mm = torch.tensordot(elastic_mm, basis, dims=([1], [1]))
        points = (points @ turn.T) * self.scale + self.shift + elastic_mm.movedim(0, -1)
        if self.mirrored:
            points = points * torch.tensor([-1.0, 1, 1])
        return self.girth.source(points) if self.girth else points

    def changed_hu(self, hu: torch.Tensor) -> torch.Tensor:
        """HU scaled about air and, where there is no air, offset."""
        above = hu - AIR
        return AIR + self.hu_scale * above + self.hu_offset * (above / 200).clamp(0, 1)

    def apply(self, case: Case, grid: Grid, window: HUWindow) -> Case:
        """The deformed Case; volume and masks are sampled at the same points, air and zeros outside."""
        half = torch.tensor([n * s / 2 for n, s in zip(grid.shape, grid.spacing)])
        points = (self.sample_points(grid) / half).flip(-1)[None]  # grid_sample wants z, y, x of the last axis first
        air = float(window.to_range(torch.tensor(AIR)))
        state = torch.cat([case["volume"] - air, case["masks"]])
        state = torch.nn.functional.grid_sample(state[None], points, padding_mode="zeros", align_corners=False)[0]
        hu = self.changed_hu(window.to_hu(state[:1] + air))
        return lacking(case, "affine", "centred_on") | {
            "volume": window.to_range(hu), "masks": state[1:].clamp(0, 1)}


def augment(case: Case, seed: int | torch.Generator, grid: Grid = Grid.cube(64), window: HUWindow = HUWindow(),
            strength: Augmentation = Augmentation()) -> Case:
    """A Case deformed by `Deformation.draw(seed, strength)`; the same integer seed gives the same Case.

    The place in the source CT ("affine") is dropped. Raises ValueError for a Case on another grid or with X-rays.
    """
    if tuple(case["volume"].shape[1:]) != grid.shape:
        raise ValueError(f"the case has {tuple(case['volume'].shape[1:])} voxels, but the grid {grid.shape} was given; "
                         "give the grid the case was prepared on")
    if "xrays" in case:
        raise ValueError(f"case {case['id']} holds X-rays of the undeformed patient; deform it before projecting")
    generator = seed if isinstance(seed, torch.Generator) else torch.Generator().manual_seed(int(seed))
    deformation = Deformation.draw(generator, strength)
    if strength.mirror and not NAMES_A_SIDE.search(case["report"]):
        mirrored = bool(torch.rand(1, generator=generator) < strength.mirror)
        deformation = replace(deformation, mirrored=mirrored)
    shares = strength.surroundings
    if not (strength.girth or shares.table or shares.adds):
        return _rescanned(deformation.apply(case, grid, window), generator, grid, window, strength)
    chance, size = torch.rand(2, generator=generator), torch.rand(1, generator=generator)
    seed = int(torch.randint(2**31, (1,), generator=generator))
    hu = window.to_hu(case["volume"])
    body = torch.from_numpy(body_mask(hu[0].numpy(), grid.spacing))
    if chance[1] < strength.girth:
        deformation = replace(deformation, girth=Girth.draw(float(size), body, case["masks"][0], grid))
    if bare := bool(chance[0] < shares.table) or deformation.girth is not None:
        hu = without_table(hu, grid, body)
    state = case | {"volume": window.to_range(hu), "masks": torch.cat([case["masks"], body[None].float()])}
    case = deformation.apply(state, grid, window)
    *masks, body = case["masks"]
    hu = window.to_hu(case["volume"])
    hu = torch.from_numpy(surround(hu[0].numpy(), body.numpy() > 0.5, grid, seed, shares, couch=bare))[None]
    case |= {"volume": window.to_range(hu), "masks": torch.stack(masks)}
    return _rescanned(case, generator, grid, window, strength)


def _rescanned(case: Case, generator: torch.Generator, grid: Grid, window: HUWindow, strength: Augmentation) -> Case:
    """The Case with another contrast of the blood, in a smaller field of view or in a shorter scan, by chance."""
    chance, amount, diameter, centre, ends = torch.rand(8, generator=generator).split((2, 1, 1, 2, 2))
    hu, masks = window.to_hu(case["volume"]), case["masks"]
    if strength.contrast:
        hu = change_contrast(hu, masks, strength.contrast * (2 * float(amount) - 1))
    if chance[0] < strength.surroundings.field:
        x, y = (FIELD_SHIFT_MM * (2 * float(place) - 1) for place in centre)
        hu, masks = cut_field(hu, masks, grid, FIELD_MM[0] + float(diameter) * (FIELD_MM[1] - FIELD_MM[0]), (x, y))
    if chance[1] < strength.surroundings.ends and not case["report"].strip():
        hu, masks = cut_ends(hu, masks, grid, *_ends(hu, grid, ends))
    return case | {"volume": window.to_range(hu), "masks": masks}


def _ends(hu: torch.Tensor, grid: Grid, chance: torch.Tensor) -> tuple[float, float]:
    """Lowest and highest z in mm from the grid's centre of a scan that is cut below, above (or both) at any height."""
    scanned = (hu[0] > AIR + 100).any(0).any(0).nonzero()
    if not len(scanned):
        return -math.inf, math.inf
    low, high = ((float(scanned[i]) - (grid.shape[2] - 1) / 2 + d / 2) * grid.spacing[2] for i, d in ((0, -1), (-1, 1)))
    room = max(high - low - LEAST_SCAN_MM, 0)
    kind, share = float(chance[0]), float(chance[1])
    if kind < 0.4:
        return low + share * room, high
    if kind < 0.8:
        return low, high - share * room
    return low + share * room / 2, high - (kind - 0.8) / 0.2 * room / 2
