"""Lightning data for inference: X-ray folders, or CTs and phantoms to simulate X-rays of."""

from __future__ import annotations

import os
import zlib
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import lightning
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from phydict.datasets import CTFile, CTSource, find_xrays, load_case, load_xrays, phantom_case
from phydict.datasets.case import Case
from phydict.datasets.cts.segmentations import mask_files
from phydict.datasets.itk_file import voxel_files
from phydict.datasets.phantoms.cached import HELD_OUT_PHANTOM, PHANTOM_VERSION
from phydict.datasets.radiographs.radiographs import case_files
from phydict.grid import Grid
from phydict.inference.protocols import protocol_of
from phydict.inference.settings import Orbit
from phydict.reconstruction import describe
from phydict.runtime.console import noted
from phydict.runtime.files import file_crc32
from phydict.runtime.ranges import check_between
from phydict.runtime.reading import name_of, read_ids
from phydict.runtime.shipped import configuration
from phydict.units import HUWindow
from phydict.xray import Ideal, Polychromatic, Projector, Simulator
from phydict.xray.boxes import divided, in_other_voxels
from phydict.xray.geometry_files import read_beam

PHANTOMS, MOST_PHANTOMS = 4, 100_000
"""How many phantoms where no number is given, and at most."""


class LazyCases(Dataset):
    """Cases made on demand, of (id, what identifies its data, function) triples, with the warnings that it took."""

    def __init__(self, makers: list):
        self.makers = makers

    def __len__(self) -> int:
        return len(self.makers)

    def __getitem__(self, i: int) -> Case:
        name, source, make = self.makers[i]
        case: Case = {"id": name, "index": i, "source": source, "warnings": []}
        try:
            with noted(case["warnings"], name):
                return make() | case
        except (ValueError, OSError) as error:  # the task decides what becomes of it
            return case | {"error": error}


class ReconstructionData(lightning.LightningDataModule):
    """What to reconstruct.

    Args:
        xrays: for predict, a folder of X-ray images with geometry.yaml, or a folder of such folders
        geometry: a geometry file, or the name of one of configs/geometry: used instead of the folders' own, and for
            simulated X-rays in place of orbit
        cts: for test, a NIfTI file or a folder of CTs, or the word phantom
        source: which CTs of a folder are taken, and what belongs to them
        only: a text file of the case ids to test, one a line, such as a training's held_out.txt; none given: all
        phantoms: how many phantoms where cts is the word phantom
        orbit: the simulated X-rays' geometry where no file gives it
        simulator: how X-rays are made of a CT (configs/simulate)
        simulation_voxels: voxels per side of the volume that X-rays are made of; none given: the reconstruction's own
            grid, which is an inverse crime; more lessens it
        protocol: a published evaluation that fixes the geometry, grid, HU range and noise of test: phydict, x2ct,
            luna16 or sparc
    """

    trainer: Any

    def __init__(self, xrays: str | None = None, geometry: str | None = None, cts: str | None = None,
                 source: CTSource = CTSource(), only: str | None = None, phantoms: int = PHANTOMS,
                 orbit: Orbit = Orbit(), simulator: Simulator = Ideal(), simulation_voxels: int | None = None,
                 protocol: str | None = None):
        super().__init__()
        check_between("data.phantoms", phantoms, 1, MOST_PHANTOMS)
        if simulation_voxels is not None and simulation_voxels < 1:
            raise ValueError(f"data.simulation_voxels must be at least 1, but {simulation_voxels} was given: leave it "
                             "out for the reconstruction's own")
        self.xrays, self.geometry, self.cts, self.phantoms, self.only = xrays, geometry, cts, phantoms, only
        self.source, self.simulation_voxels = source, simulation_voxels
        if cts == "phantom" and (only is not None or source != CTSource()):
            raise ValueError("only, reports and source choose among the CTs of a folder, but the cases are phantoms: "
                             "leave them out, or give a folder of CTs")
        if cts and cts != "phantom" and phantoms != PHANTOMS:
            raise ValueError(f"data.phantoms ({phantoms}) is a number of phantoms, but the cases are the CTs of {cts}: "
                             "leave it out, or give data.cts phantom")
        if cts and geometry and orbit != Orbit():
            raise ValueError(f"the simulated X-rays are those of data.geometry ({geometry}), but data.orbit was "
                             "given as well: leave one out")
        self.protocol = None if protocol is None else protocol_of(protocol)
        if self.protocol and geometry is not None:
            raise ValueError(f"data.protocol {protocol} fixes the geometry of simulated X-rays, but data.geometry "
                             f"{geometry} was given: leave one of the two out")
        self.orbit = self.protocol.fixed_orbit(orbit) if self.protocol else orbit.filled()
        self.simulator = self.protocol.fixed_simulator(simulator) if self.protocol else simulator
        if self.protocol:
            self.protocol.check_simulation(simulation_voxels)
        self.geometry_file = configuration(geometry, ("geometry",)) if geometry else None
        self.beam, self._beam_settings = self.orbit.beam(), self.orbit.settings()
        changed = {"cts": cts is not None, "phantoms": phantoms != PHANTOMS, "source": source != CTSource(),
                   "only": only is not None, "orbit": orbit != Orbit(), "simulator": simulator != Ideal(),
                   "simulation_voxels": simulation_voxels is not None, "protocol": protocol is not None}
        self._of_test = [name for name, given in changed.items() if given]
        if cts and self.geometry_file:
            self.beam = read_beam(self.geometry_file)
            crc = file_crc32(self.geometry_file)
            self._beam_settings = {"geometry": f"{self.geometry_file.name}, crc32 {crc:08x}"}
        if self.beam.continued is None and not (self.protocol and self.protocol.grid):
            self.beam = replace(self.beam, continued=False)  # X-rays are made of what the method's volume holds

    def settings(self, stage: str) -> dict:
        """What, beside the cases themselves, decides the X-rays that a stage (predict, test) reconstructs from."""
        if stage == "predict":
            return {"geometry": self.geometry_file and self.geometry_file.name}
        return self._beam_settings | {
            "simulator": describe(self.simulator), "simulation_voxels": self.simulation_voxels} | (
                {"protocol": self.protocol.name} if self.protocol else {})

    def xray_cases(self) -> dict[str, Path]:
        """Id -> folder of X-rays. Raises ValueError without data.xrays."""
        if not self.xrays:
            raise ValueError("predict needs data.xrays: a folder of X-ray images with geometry.yaml")
        if self._of_test:
            raise ValueError(f"data.{self._of_test[0]} is a setting of test, which simulates X-rays of CTs, but "
                             "predict takes measured ones: leave it out, or use test")
        folders = find_xrays(self.xrays)
        cases = {name_of(os.path.abspath(folder)): folder for folder in folders}
        if len(cases) < len(folders):
            raise ValueError(f"two folders of {self.xrays} would both become one case, since their names differ in "
                             "what is no UTF-8 alone: rename one of them")
        return cases

    def inputs(self, stage: str) -> list[Path]:
        """The files and folders that a stage (predict, test) reads its cases from."""
        if stage == "predict":
            cases = self.xray_cases()
            return [Path(str(self.xrays)), *cases.values()]
        return [Path(self.cts)] if self.cts and self.cts != "phantom" else []

    def predict_dataloader(self) -> DataLoader:
        loader = self._loader([(name, self._xrays_source(folder), lambda f=folder: load_xrays(f, self.geometry_file))
                               for name, folder in self.xray_cases().items()])
        cases, processes = len(loader), self.trainer.world_size
        if 0 < cases < processes:  # of which Lightning wants one each
            raise ValueError(f"{processes} processes were asked for, but there {'is' if cases == 1 else 'are'} {cases} "
                             f"to reconstruct: give --trainer.devices {cases}, on one node")
        return loader

    def test_dataloader(self) -> DataLoader:
        task = self.trainer.lightning_module
        return self._loader(self.test_cases(*task.scene()))

    def test_cases(self, grid: Grid, window: HUWindow) -> list[tuple[str, str, Callable[..., Case]]]:
        """The CTs or phantoms of test: id, what identifies its data, and the function that makes it on `grid`."""
        if not self.cts:
            raise ValueError("test needs data.cts: a NIfTI file, a folder of CTs, or the word phantom")
        if self.xrays:
            raise ValueError(f"data.xrays ({self.xrays}) are for predict, but test simulates X-rays of data.cts: leave "
                             "one out")
        if isinstance(self.simulator, Polychromatic) and (self.simulator.metal or 0) > window.high:
            raise ValueError(f"simulator.metal {self.simulator.metal:g} is reached nowhere, since CTs are clipped to "
                             f"an HU window that ends at {window.high:g}: leave it out, or simulate in Python")
        if self.cts == "phantom":
            return [(f"phantom-{seed:06d}", f"phantom version {PHANTOM_VERSION}", lambda s=seed: self._with_fine(
                        grid, lambda g: phantom_case(s, g, window)))
                    for seed in range(HELD_OUT_PHANTOM, HELD_OUT_PHANTOM + self.phantoms)]
        return [(ct.id, _ct_source(ct), lambda c=ct: {"file": c.path, "calibration": c.calibration} | self._with_fine(
                    grid, lambda g: load_case(c, g, window)))
                for ct in self._chosen(self.source.find(self.cts))]

    def _chosen(self, cts: list[CTFile]) -> list[CTFile]:
        if not self.only:
            return cts
        wanted = set(read_ids(self.only, "only"))
        missing = wanted - {ct.id for ct in cts}
        if missing or not wanted:
            raise ValueError(f"only ({self.only}) names {', '.join(sorted(missing)[:3]) or 'no case'}, which cts "
                             f"({self.cts}) does not hold: correct the list, or give its folder")
        return [ct for ct in cts if ct.id in wanted]

    def _xrays_source(self, folder: Path) -> str:
        """What identifies a folder's X-rays: a checksum of its files and of those that its geometry names."""
        crc = 0
        for file in case_files(folder, self.geometry_file):
            named = zlib.crc32(os.fsencode(file.name), crc)
            crc = file_crc32(file, named) if file.is_file() else named
        return f"files crc32 {crc:08x}"

    def simulate(self, case: Case, seed: int, grid: Grid, window: HUWindow, device: torch.device) -> Tensor:
        """X-rays (K, V, U) of a CT case, made on `device`."""
        source = case.get("fine", case["volume"]).to(device)
        fine = in_other_voxels(grid, source.shape[-3:])
        return self.simulator(Projector(fine, self.beam, full_detector=True), window.to_mu(source)[None], seed)[0]

    def _with_fine(self, grid: Grid, make: Callable[[Grid], Case]) -> Case:
        """A case; where X-rays are made of a finer volume, that one as "fine", and its block means as the truth."""
        if not self.simulation_voxels:
            return make(grid)
        voxels, factor = self.simulation_voxels, self.simulation_voxels // grid.shape[0]
        if voxels != factor * grid.shape[0]:
            raise ValueError(f"data.simulation_voxels must be a multiple of the reconstruction's {grid.shape[0]} "
                             f"voxels, but {voxels} was given")
        fine = make(divided(grid, factor))["volume"]
        return make(grid) | {"fine": fine, "volume": torch.nn.functional.avg_pool3d(fine, factor)}

    def transfer_batch_to_device(self, batch: Case, device: torch.device, dataloader_idx: int) -> Case:
        return batch  # a case holds its beam, which has no device; its X-rays are moved when they are reconstructed

    def _loader(self, makers: list[tuple]) -> DataLoader:
        left = set(self.trainer.lightning_module.unfinished({name: source for name, source, _ in makers}))
        cases = LazyCases([maker for maker in makers if maker[0] in left])
        self.trainer.strategy.barrier()  # every process has looked before any process finishes a case
        return DataLoader(cases, None)


def _ct_source(ct: CTFile) -> str:
    """What identifies a CT, the file of its voxels where that is another, its report and the masks of it, wherever they
    lie."""
    report, masks = zlib.crc32(ct.report.encode()), 0
    for file in mask_files(ct.path):
        masks = zlib.crc32(f"{name_of(file)} {_contents(file)}".encode(), masks)
    voxels = "".join(f", voxels crc32 {_contents(file)}" for file in voxel_files(ct.path))
    return f"{name_of(ct.path)}, crc32 {_contents(ct.path)}{voxels}, {ct.calibration}, report crc32 {report:08x}" + (
        f", masks crc32 {masks:08x}" if masks else "")


def _contents(file: Path) -> str:
    """A file's checksum in words."""
    stat = file.stat()
    return f"{_crc32_of(file, stat.st_size, stat.st_mtime_ns):08x}"


@cache
def _crc32_of(path: Path, size: int, modified: int) -> int:
    """A file's checksum, read once for all the acquisitions of a comparison while the file stays as it is."""
    return file_crc32(path)
