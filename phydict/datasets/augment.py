"""Random anatomical change of a patient, for learning from few CTs."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from phydict.datasets.transforms import AIR
from phydict.grid import Grid
from phydict.units import HUWindow


@dataclass(frozen=True)
class Deformation:
    """A small random change of a patient: pose, size, shape and HU, without mirroring.

    rotation: (3,) radians about x, y, z. scale: (3,). shift: (3,) mm. waves: (3, 4, 4, 4) mm, amplitudes of cosines
    of up to 1.5 periods over the grid. gain: factor of HU + 1000. offset: HU, in tissue only.
    """

    rotation: torch.Tensor
    scale: torch.Tensor
    shift: torch.Tensor
    waves: torch.Tensor
    gain: float
    offset: float

    @classmethod
    def draw(cls, seed: int | torch.Generator) -> Deformation:
        """Rotation <= 8 degrees, scale .9-1.1, shift <= 20 mm, waves of about 4 mm, gain .97-1.03, offset <= 20 HU."""
        generator = seed if isinstance(seed, torch.Generator) else torch.Generator().manual_seed(int(seed))

        def uniform(size, bound):
            return (2 * torch.rand(size, generator=generator) - 1) * bound

        waves = torch.randn((3, 4, 4, 4), generator=generator)
        frequency = torch.stack(torch.meshgrid(*[torch.arange(4.0)] * 3, indexing="ij")).pow(2).sum(0)
        waves = torch.where((frequency > 0) & (frequency <= 9), waves * 2.5 / (1 + frequency.sqrt()), 0.0)
        return cls(uniform(3, math.radians(8) / math.sqrt(3)), 1 + uniform(3, 0.1), uniform(3, 20 / math.sqrt(3)),
                   waves, 1 + float(uniform(1, 0.03)), float(uniform(1, 20.0)))

    def sample_points(self, grid: Grid) -> torch.Tensor:
        """(X, Y, Z, 3) mm from the grid's centre, along its axes: where the deformed voxels take their values."""
        axes = [(torch.arange(n) - (n - 1) / 2) * s for n, s in zip(grid.shape, grid.spacing)]
        points = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1)
        a, b, c = self.rotation.tolist()
        turn = torch.linalg.matrix_exp(torch.tensor([[0, -c, b], [c, 0, -a], [-b, a, 0]]))
        cosines = [torch.cos(math.pi * torch.arange(4.0) * (torch.arange(n)[:, None] + 0.5) / n) for n in grid.shape]
        waves = self.waves
        for basis in cosines:
            waves = torch.tensordot(waves, basis, dims=([1], [1]))
        return (points @ turn.T) * self.scale + self.shift + waves.movedim(0, -1)

    def apply(self, case: dict, grid: Grid, window: HUWindow) -> dict:
        """The deformed Case; volume and masks are sampled at the same points, air and zeros outside."""
        half = torch.tensor([n * s / 2 for n, s in zip(grid.shape, grid.spacing)])
        points = (self.sample_points(grid) / half).flip(-1)[None]  # grid_sample wants z, y, x of the last axis first
        air = float(window.to_range(torch.tensor(AIR)))
        state = torch.cat([case["volume"] - air, case["masks"]])
        state = torch.nn.functional.grid_sample(state[None], points, padding_mode="zeros", align_corners=False)[0]
        hu = window.to_hu(state[:1] + air)
        hu = AIR + self.gain * (hu - AIR) + self.offset * ((hu - AIR) / 200).clamp(0, 1)
        moved = {key: value for key, value in case.items() if key not in ("affine", "centred_on")}
        return moved | {"volume": window.to_range(hu), "masks": state[1:].clamp(0, 1)}


def augment(case: dict, seed: int | torch.Generator, grid: Grid = Grid.cube(64), window: HUWindow = HUWindow()) -> dict:
    """A Case deformed by `Deformation.draw(seed)`; the same integer seed gives the same Case.

    The place in the source CT ("affine") is dropped. Raises ValueError for a Case on another grid or with X-rays.
    """
    if tuple(case["volume"].shape[1:]) != grid.shape:
        raise ValueError(f"the case has {tuple(case['volume'].shape[1:])} voxels, but the grid {grid.shape} was given; "
                         "give the grid the case was prepared on")
    if "xrays" in case:
        raise ValueError(f"case {case['id']} holds X-rays of the undeformed patient; deform it before projecting")
    return Deformation.draw(seed).apply(case, grid, window)
