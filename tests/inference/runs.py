"""Runs of infer.py's commands in tests, and what they leave."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import nibabel
import numpy as np
from dicom_files import orbit_tags, write_dicom

from phydict.datasets import save_xrays
from phydict.xray import ConeBeam

ROOT = Path(__file__).parents[2]
BEAM = ConeBeam.orbit(3, 1020.0, 740.0, (24, 24), 24.0)
ORBIT = ["--data.orbit.views=3", "--data.orbit.detector=[24,24]", "--data.orbit.pixel=[24,24]"]
FILES = ["panel.png", "reconstruction.json", "thumbnail.png", "view.js", "volume.nii.gz"]


def sirt(command: str, out: Path, *more: str) -> list[str]:
    return [command, "--model.method=sirt", "--model.method.init_args.iterations=3",
            f"--model.out={out}", "--trainer.accelerator=cpu", *more]


def phantoms(out: Path, count: int, *more: str) -> list[str]:
    return sirt("test", out, "--data.cts=phantom", f"--data.phantoms={count}", *ORBIT, *more)


def with_prior(command: str, out: Path, prior: Path, *more: str) -> list[str]:
    return [command, "--model.method=prior_only", "--model.method.init_args.iterations=2",
            f"--model.prior={prior}", f"--model.out={out}", "--trainer.accelerator=cpu", *more]


def record(folder: Path) -> dict:
    return json.loads((folder / "reconstruction.json").read_text())


def volume(folder: Path) -> np.ndarray:
    return np.asarray(nibabel.load(folder / "volume.nii.gz").dataobj)


def stamp(folder: Path) -> dict[str, int]:
    return {name: (folder / name).stat().st_mtime_ns for name in FILES}


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def write_ct(path: Path, seed: int, code: int = 1, change=lambda hu: hu) -> Path:
    """A box of soft tissue in air, 20^3 voxels of 10 mm."""
    path.parent.mkdir(exist_ok=True)
    hu = np.full((20, 20, 20), -1000, np.float32)
    hu[4:16, 6:15] = 40 + 10 * np.random.default_rng(seed).standard_normal((12, 9, 20))
    image = nibabel.Nifti1Image(change(hu), None)
    image.header.set_zooms((10,) * image.ndim)
    image.set_sform(np.diag([10.0, 10.0, 10.0, 1.0]), code=code)
    image.set_qform(np.diag([10.0, 10.0, 10.0, 1.0]), code=code)
    nibabel.save(image, path)
    return path


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def xrays(folder: Path, beam: ConeBeam = BEAM) -> Path:
    """A folder of X-rays of noise."""
    save_xrays(folder, np.random.default_rng(0).random((beam.views, *beam.shape), np.float32), beam)
    return folder


LAUGHS = "".join(f"{b}: &{b} [{', '.join([f'*{a}'] * 9)}]\n" for a, b in zip("abcdefgh", "bcdefghi"))


def image(write: Callable[[Path], object], ending: str = "npy") -> Callable[[Path], None]:
    """Writes X-rays of noise, the second of them by `write`."""
    def make(at: Path) -> None:
        (xrays(at) / "view_1.npy").unlink()
        write(at / f"view_1.{ending}")
    return make


def dicom(**tags: object) -> Callable[[Path], Path]:
    """Writes a DICOM run of three views with other tags, without those that are None."""
    tags = {name: value for name, value in (orbit_tags(3, 1020.0, 740.0, (24.0, 24.0)) | tags).items()
            if value is not None}
    return lambda at: write_dicom(at / "run.dcm", np.ones((3, 24, 24), np.uint16), **tags)
