"""Lightning data for inference: X-ray folders, or CTs and phantoms to simulate X-rays of."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import lightning
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from phydict.datamodule import HELD_OUT_PHANTOM
from phydict.datasets import find_cts, find_xrays, load_xrays, phantom_case, prepare_ct
from phydict.grid import Grid
from phydict.reconstructor import describe
from phydict.units import HUWindow
from phydict.xray import ConeBeam, Ideal, Projector, Simulator


class Listed(Dataset):
    """Cases made on demand: (id, function) pairs."""

    def __init__(self, makers: list):
        self.makers = makers

    def __len__(self) -> int:
        return len(self.makers)

    def __getitem__(self, i: int) -> dict:
        name, make = self.makers[i]
        return make() | {"id": name, "index": i}


class ReconstructionData(lightning.LightningDataModule):
    """What to reconstruct.

    xrays: for predict, a folder of X-ray images with geometry.yaml, or a folder of such folders; geometry: a geometry
    file used instead of theirs. cts: for test, a NIfTI file or a folder of CTs, or the word phantom; reports, metadata,
    fixed: as for training; phantoms: how many phantoms; with_report: whether the cases' reports are used.
    views, source_to_detector, source_to_isocentre (mm), detector (rows, columns), pixel (mm): the simulated orbit;
    simulator: how X-rays are made of a CT (configs/simulate); simulation_voxels: voxels per side of the volume they
    are made of (None: the reconstruction's own grid, which is an inverse crime; more lessens it).
    """

    def __init__(self, xrays: str | None = None, geometry: str | None = None, cts: str | None = None,
                 reports: str | None = None, metadata: str | None = None, fixed: bool = True, phantoms: int = 4,
                 with_report: bool = True, views: int = 8, source_to_detector: float = 1020.0,
                 source_to_isocentre: float = 740.0, detector: tuple[int, int] = (448, 448),
                 pixel: tuple[float, float] = (1.25, 1.25), simulator: Simulator = Ideal(),
                 simulation_voxels: int | None = None):
        super().__init__()
        self.xrays, self.geometry, self.cts, self.phantoms = xrays, geometry, cts, phantoms
        self.tables = {"reports": reports, "metadata": metadata, "fixed": fixed}
        self.with_report, self.simulator, self.simulation_voxels = with_report, simulator, simulation_voxels
        self.beam = ConeBeam.orbit(views, source_to_detector, source_to_isocentre, detector, pixel)
        self.orbit = {"views": views, "source_to_detector": source_to_detector,
                      "source_to_isocentre": source_to_isocentre, "detector": detector, "pixel": pixel}

    def settings(self, stage: str) -> dict:
        """What, beside the cases themselves, decides the X-rays that a stage (predict, test) reconstructs from."""
        if stage == "predict":
            return {"with_report": self.with_report, "geometry": self.geometry}
        return {"with_report": self.with_report, **self.orbit, "simulator": describe(self.simulator),
                "simulation_voxels": self.simulation_voxels}

    def xray_cases(self) -> list[tuple]:
        """(id, function that loads the Case) of every folder of X-rays. Raises ValueError without data.xrays."""
        if not self.xrays:
            raise ValueError("predict needs data.xrays: a folder of X-ray images with geometry.yaml")
        return [(Path(os.path.abspath(folder)).name, lambda f=folder: load_xrays(f, self.geometry))
                for folder in find_xrays(self.xrays)]

    def predict_dataloader(self) -> DataLoader:
        return self._loader(self.xray_cases())

    def test_dataloader(self) -> DataLoader:
        if not self.cts:
            raise ValueError("test needs data.cts: a NIfTI file, a folder of CTs, or the word phantom")
        task = self.trainer.lightning_module
        if self.cts == "phantom":
            return self._loader([
                (f"phantom-{seed:06d}", lambda s=seed: self._with_source(
                    task, lambda grid: phantom_case(s, grid, task.window)))
                for seed in range(HELD_OUT_PHANTOM, HELD_OUT_PHANTOM + self.phantoms)])
        return self._loader([
            (ct.id, lambda c=ct: self._with_source(task, lambda grid: prepare_ct(
                c.path, grid, task.window, id=c.id, calibration=c.calibration)) | {"report": c.report})
            for ct in find_cts(self.cts, **self.tables)])

    def simulate(self, case: dict, seed: int, grid: Grid, window: HUWindow, device: torch.device) -> Tensor:
        """X-rays (K, V, U) of a CT case, made on `device`."""
        source = case.get("source", case["volume"]).to(device)
        fine = Grid.cube(source.shape[-1], grid.extent[0])
        return self.simulator(Projector(fine, self.beam, full_detector=True), window.to_mu(source)[None], seed)[0]

    def _with_source(self, task: lightning.LightningModule, make: Callable[[Grid], dict]) -> dict:
        """A case, and under "source" the volume its X-rays are simulated from where that is another one."""
        if not self.simulation_voxels:
            return make(task.grid)
        return make(task.grid) | {"source": make(Grid.cube(self.simulation_voxels, task.grid.extent[0]))["volume"]}

    def transfer_batch_to_device(self, batch: dict, device: torch.device, dataloader_idx: int) -> dict:
        return batch  # a case holds its beam, which has no device; its X-rays are moved when they are reconstructed

    def _loader(self, makers: list[tuple]) -> DataLoader:
        cases = Listed(self.trainer.lightning_module.pending(makers))
        self.trainer.strategy.barrier()  # every process has looked before any process finishes a case
        return DataLoader(cases, None)
