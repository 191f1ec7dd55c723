"""Volumes that another program made, in the place of a reconstruction."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from phydict.baselines.baseline import Baseline, CountingProjector
from phydict.datasets import load_ct
from phydict.datasets.cts.resampling import to_grid
from phydict.grid import Grid
from phydict.units import AIR, MU_WATER, hu_to_mu
from phydict.xray.boxes import SLACK, along, averaged, interpolated, no_finer


@dataclass(frozen=True)
class Stored(Baseline):
    """The volume of a case, made by another program from its X-rays: <folder>/<case>.nii.gz, <folder>/<case>.nii or, as
    predict writes it, <folder>/<case>/volume.nii.gz.

    In HU, in world mm of the X-rays' geometry; averaged or interpolated onto the voxels that are wanted, air outside.
    Its misfit is that of the X-rays that it is compared on.

    Args:
        folder: of the volumes; where one of them changes, what was made of them before is made again
        mu_water: attenuation of water in 1/mm in the X-rays
        name: what results call the method
        case: whose volume; infer.py fills it in
    """

    local = True
    folder: str = ""
    mu_water: float = MU_WATER
    name: str = "stored"
    case: str = ""
    files: str = field(default="", init=False)

    def __post_init__(self):
        super().__post_init__()
        if self.folder and not Path(self.folder).is_dir():
            raise ValueError(f"there is no folder {self.folder} of volumes: give the one that holds them")
        if self.folder and not self.case:
            stats = ((file.relative_to(self.folder), file.stat()) for file in sorted(Path(self.folder).rglob("*.nii*")))
            stated = "".join(f"{name} {stat.st_size} {stat.st_mtime_ns}\n" for name, stat in stats)
            crc = zlib.crc32(stated.encode(errors="surrogateescape"))
            object.__setattr__(self, "files", f"crc32 {crc:08x}")

    def of_case(self, case: str) -> Stored:
        return replace(self, case=case)

    def with_room(self, x: int, y: int, z: int) -> None:
        """On more voxels it would show air, where the patient continues."""

    def steps(self) -> int:
        return 1

    @property
    def file(self) -> Path:
        """The file of the case. Raises ValueError where the folder or the case is not given, FileNotFoundError where
        there is none."""
        if not (self.folder and self.case):
            wanted = "give the folder" if self.case else "give the folder, and in Python the case"
            raise ValueError("Stored shows the volume of a case from a folder, but "
                             f"folder {self.folder!r} and case {self.case!r} were given: {wanted}")
        places = [Path(self.folder) / name for name in (
            f"{self.case}.nii.gz", f"{self.case}.nii", f"{self.case}/volume.nii.gz")]
        for place in places:
            if place.is_file():
                return place
        raise FileNotFoundError(f"there is no volume of {self.case} in {self.folder}: name it {places[0].name}, or "
                                f"{self.case}/volume.nii.gz")

    def expected(self, A: CountingProjector) -> Tensor:
        hu, affine = load_ct(self.file)
        own, volume = Grid(hu.shape, affine=affine), torch.from_numpy(hu)
        if along(own, A.grid) and no_finer(A.grid, own):
            volume = averaged(volume, own, A.grid)
        elif along(own, A.grid) and (np.divide(own.spacing, A.grid.spacing) > 1 - SLACK).all():
            volume = interpolated(volume, own, A.grid, AIR)
        else:
            volume = torch.from_numpy(to_grid(hu, affine, A.grid, AIR))
        return hu_to_mu(volume, 1.0)[None, None]

    def solve(self, A: CountingProjector, y: Tensor, on_step: Callable[[], None]) -> Tensor:
        density = self.expected(A).to(y)
        on_step()
        return density
