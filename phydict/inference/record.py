"""What is written of a finished case: the settings that decide its result, and what is known of it."""

from __future__ import annotations

import platform
from collections.abc import Callable, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch

from phydict.datasets.case import Case
from phydict.grid import Grid
from phydict.inference.case_files import body_interval
from phydict.inference.settings import Sampling
from phydict.methods import corrections_of
from phydict.posterior import CascadePosterior, Posterior, Refined, Sampler
from phydict.prior import AnyPrior, MedSynCheckpoint, file_read, fingerprint, own_identity
from phydict.reconstruction import Reconstruction, Reconstructor, describe
from phydict.runtime.precision import instruction_set
from phydict.runtime.profiling import process_peak
from phydict.runtime.version import VERSION
from phydict.xray.projectors.own import projector_settings


def method_settings(name: str, seed: int, method: Sampler | Reconstructor, projector: str | type, sampling: Sampling
                    ) -> dict:
    """Those of a method, and of the projector and the precision where one is chosen."""
    return {"name": name, "seed": seed, "method": describe(method)} | (
        {"projector": projector_settings(projector)} if projector != "auto" else {}) | (
        {"precision": sampling.precision} if sampling.precision != "auto" else {})


def prior_settings(prior: AnyPrior, given: Any, sampling: Sampling) -> dict:
    """Those of a prior, given as an object, by its file or by its class, and of how it is sampled."""
    identity = own_identity(prior, given)
    settings = _identity("prior", given) if identity is None else {"prior": identity}
    settings["guidance"] = sampling.guidance
    if sampling.samples != 1:
        settings["samples"] = sampling.samples
    return settings


def cascade_settings(file: str | MedSynCheckpoint, cascade: CascadePosterior) -> dict:
    """Those of a second stage, given by its file."""
    return _identity("super_resolution", file) | {
        "sr_noise_augmentation": cascade.level, "second": describe(cascade.second)}


def grid_settings(grid: Grid, plain: Reconstructor, method: Reconstructor) -> dict:
    """Those of voxels that were chosen, and of the refinement to them by `method` of what the `plain` one gives."""
    if not isinstance(method, Refined):
        return {"grid": grid.to_dict()}
    files = corrections_of(plain.sampler, grid) if isinstance(plain, Posterior) and method.networks else []
    return {"grid": grid.to_dict(), "refinement": describe(method.refinement)} | correction_checksums(files)


def correction_checksums(files: Sequence[Path], checksum: Callable[[str], int] = fingerprint) -> dict[str, int]:
    """Those of the networks that correct estimates on finer voxels, of long voxels first."""
    return {name: checksum(str(file)) for name, file in zip(("correction_crc32", "finer_correction_crc32"), files)}


def case_record(case: Case, result: Reconstruction, name: str, method: Reconstructor, scores: dict | None,
                settings: dict, device: torch.device) -> dict:
    """All that is known of a finished case, as plain JSON values; process_peak_memory_mb is in MiB."""
    return {"case": case["id"], "method": name, "citation": method.citation, "scores": scores,
            "misfit": result.misfit, "misfit_per_view": result.misfit_per_view, "diverged_at": result.diverged_at,
            "hardened": result.hardened, "scatter": result.scatter, "interval_90_hu": body_interval(result),
            "interval_widening": result.interval_widening, "seconds": result.seconds,
            "coarse": result.coarse is not None,
            "network_calls": result.network_calls, "projector_calls": result.projector_calls,
            "process_peak_memory_mb": process_peak(), "mu_water": case.get("mu_water", method.mu_water),
            "views": len(result.xrays), "precision": result.precision, "instruction_set": instruction_set(device),
            "grid": result.grid.to_dict(), "extended_mm": list(result.extended_mm), "seed": result.seed,
            **({"poses": result.poses} if result.poses else {}),
            **({"carried": result.carried.record()} if result.carried else {}), "warnings": case["warnings"],
            "report": case["report"], "source": case["source"], "settings": settings, "versions": versions()}


def versions() -> dict[str, str]:
    """Versions of Python and of the packages that a result depends on."""
    return {"python": platform.python_version(), "phydict": VERSION} | {
        name: version(name) for name in ("torch", "lightning", "monai", "torchmetrics", "numpy")}


def _identity(role: str, file: str | MedSynCheckpoint) -> dict:
    """What a record holds of a prior's or a stage's file: its name, CRC-32 and, where it was chosen from a folder of
    MedSyn's, which."""
    read = file_read(file)
    return {role: Path(file).name if isinstance(file, str) else describe(file),
            f"{role}_crc32": fingerprint(file)} | ({f"{role}_file": read} if read else {})
