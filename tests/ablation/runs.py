"""A method for the tests of ablations, and runs of them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import yaml

from phydict.baselines.baseline import Baseline
from phydict.cli.infer import main
from phydict.evaluation import read_csv
from phydict.units import MU_WATER

TINY = {"voxels": 16, "detector": 24, "views": 3}


@dataclass(frozen=True)
class Trace(Baseline):
    """A method of four steps that keeps what it is given, does as it is told, and spoils its own X-rays."""

    citation = "none"
    given = []
    behave = staticmethod(lambda calls: None)

    mu_water: float = MU_WATER
    name: str = "trace"

    def steps(self):
        return 4

    def reconstruct(self, xrays, projector, report="", display=False, seed=0, on_step=lambda: None):
        Trace.given.append((xrays.clone(), seed, report))
        try:
            return super().reconstruct(xrays, projector, report, display, seed, on_step)
        finally:
            xrays.zero_()

    def solve(self, A, y, on_step):
        for _ in range(4):
            on_step()
        Trace.behave(len(Trace.given))
        return A.T(y) / 1e4


def write(folder: Path, **content) -> Path:
    file = folder / "spec.yaml"
    file.write_text(yaml.safe_dump({"out": str(folder / "out"), "phantoms": 2, "base": TINY} | content))
    return file


def ablate(folder: Path, *more: str, **content) -> list[dict]:
    """The rows after a run with more options."""
    main(arguments(folder, **content) + [*more])
    return read_csv(folder / "out" / "results.csv")


def arguments(folder: Path, **content) -> list[str]:
    return ["ablate", "-c", str(write(folder, **content)), "--device", "cpu"]


def row(case: str, method: str, psnr: float | None, **more) -> dict:
    scores = {"status": "refused", "error": "no."} if psnr is None else {
        "status": "ok", "psnr": psnr, "ssim": psnr / 40, "mae_hu": 100.0, "misfit": 1 / psnr, "seconds": 1.0,
        "network_calls": 4}
    return {"case": case, "method": method, "views": 8, "simulator": "ideal", "seed": 0, "grid": "64x64x64"} | more | \
        scores
