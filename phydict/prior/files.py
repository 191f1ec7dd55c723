"""One file per prior: weights as safetensors, and in its header everything needed to use them rightly."""

from __future__ import annotations

import re
from pathlib import Path

import torch
from safetensors import SafetensorError
from torch import Tensor

from phydict.diffusion import CosineSchedule
from phydict.grid import Grid
from phydict.prior.correction import CorrectionNetwork
from phydict.prior.detail import DetailNetwork
from phydict.prior.finer_uncertainty import FinerUncertainty
from phydict.prior.local_unet import LocalUNet
from phydict.prior.medsyn.checkpoint import (
    FILES,
    MedSynCheckpoint,
    as_checkpoint,
    is_medsyn,
    load_medsyn,
    load_medsyn_super_resolution,
)
from phydict.prior.medsyn.prior import MedSynPrior
from phydict.prior.medsyn.super_resolution import MedSynSuperResolution
from phydict.prior.prior import Prior
from phydict.prior.refiner import Refiner
from phydict.prior.stage_file import built_network, header_of, loaded_stage, number_of, whole_of, window_of, write_stage
from phydict.prior.super_resolution import SuperResolution
from phydict.prior.text_file import has_text, load_text
from phydict.prior.uncertainty import Uncertainty
from phydict.prior.unet import VolumeUNet
from phydict.runtime.device import usable_device
from phydict.runtime.files import file_crc32
from phydict.runtime.shipped import own_or_shipped, shipped

DEFAULT_PRIOR = shipped("data/prior/phydict_64.safetensors")
"""The prior that comes with the project."""

UNHEARD = ("phydict_64 takes from a report that there is a finding, not its side: for reports give "
           "data/prior/phydict_64_reports.safetensors")
"""What is warned of when a report is given to DEFAULT_PRIOR."""

DEFAULT_REFINER = shipped("data/prior/refiner_64.safetensors")
"""The refiner that comes with the project."""

DEFAULT_CORRECTION = shipped("data/prior/refinement_128.safetensors")
"""The network that corrects the shipped refiner's reconstructions on voxels of 3 mm, if this file is there."""

FINEST_CORRECTION = shipped("data/prior/refinement_256.safetensors")
"""The same on voxels of 1.5 mm."""


def save_prior(prior: Prior, path: str | Path, training: dict | None = None, dtype: torch.dtype = torch.float16):
    """Writes `prior` to one .safetensors file, replacing it only when complete. Raises OSError where it cannot,
    and ValueError where weights are not finite.

    training: what the header should say of how it was trained (data, steps, command); plain JSON values.
    dtype: precision of the weights on disk.
    """
    text = prior.ready_text()
    weights = prior.state_dict()
    if text is not None and text.source:  # a pretrained BERT is named, not copied
        weights = {k: w for k, w in weights.items() if not k.startswith("text.")}
    write_stage(Path(path), prior.describe() | {"training": training or {}}, weights, dtype)


def save_refiner(refiner: Refiner, path: str | Path, training: dict | None = None, dtype: torch.dtype = torch.float16):
    """Writes `refiner`, with the priors that it is made of, to one .safetensors file, as `save_prior` does."""
    text = refiner.reader.ready_text()
    copied = text is not None and not text.source
    named = {re.sub(r"^(prior|first)\.text\.", "text.", k): w for k, w in refiner.state_dict().items()}
    weights = {k: w for k, w in named.items() if copied or not k.startswith("text.")}
    write_stage(Path(path), refiner.describe() | {"training": training or {}}, weights, dtype)


def load_prior(path: str | Path | MedSynCheckpoint = DEFAULT_PRIOR,
               device: str = "cpu") -> Prior | Refiner | MedSynPrior:
    """The prior in a .safetensors file written by `save_prior`, the refiner in one written by `save_refiner`, or the
    prior in a file or folder of MedSyn's (`load_medsyn`), ready to denoise (float32, evaluation mode).

    The default is the one that comes with the project. The text encoder stays on disk until the first report. Raises
    FileNotFoundError when there is no file, ValueError when it is truncated, is no prior, or holds weights that are not
    finite, and where there is no such device.
    """
    path, place = _resolved(path), usable_device(device, "device")
    if isinstance(path, MedSynCheckpoint) or is_medsyn(path):
        return load_medsyn(path).to(place)

    def build(header: dict, weights: dict[str, Tensor]) -> Prior | Refiner:
        loaded = (build_refiner if header.get("stage") == "refiner" else build_prior)(header, weights)
        if has_text(header):
            reader = loaded.reader if isinstance(loaded, Refiner) else loaded
            reader.load_text = lambda: load_text(path, header["text"])
            reader.unheard = UNHEARD if Path(path).resolve() == DEFAULT_PRIOR.resolve() else ""
        return loaded

    return loaded_stage(path, ("base", "refiner"), build).to(place)


def load_super_resolution(path: str | Path | MedSynCheckpoint) -> SuperResolution | MedSynSuperResolution:
    """The super-resolution stage in a file written by `save_stage`, or MedSyn's; as `load_prior`."""
    path = _resolved(path)
    if isinstance(path, MedSynCheckpoint) or is_medsyn(path):
        return load_medsyn_super_resolution(path)
    return loaded_stage(path, ("super_resolution",), build_super_resolution)


def load_correction(path: str | Path = DEFAULT_CORRECTION) -> CorrectionNetwork:
    """The network in a file written by `save_stage`; as `load_prior`."""
    return loaded_stage(own_or_shipped(path), ("refinement",), build_correction)


def is_refiner(given: object) -> bool:
    """Whether what may be given as a prior is a Refiner, or a file that `save_refiner` wrote."""
    if not isinstance(given, str | Path):
        return isinstance(given, Refiner)
    try:
        return header_of(own_or_shipped(given)).get("stage") == "refiner"
    except (SafetensorError, OSError, ValueError, AttributeError):  # whoever reads it says what it lacks
        return False


def held_out_of(path: str | Path) -> list[str] | None:
    """The ids of the CTs that the trainings of a saved stage held out, by its file's header; None where it tells
    nothing of them."""
    training = header_of(own_or_shipped(path)).get("training")
    held_out = training.get("held_out") if isinstance(training, dict) else None
    return held_out if isinstance(held_out, list) and all(isinstance(id, str) for id in held_out) else None


def _resolved(path: str | Path | MedSynCheckpoint) -> Path | MedSynCheckpoint:
    return path if isinstance(path, MedSynCheckpoint) else own_or_shipped(path)


def fingerprint(path: str | Path | MedSynCheckpoint) -> int:
    """CRC-32 of the file that `load_prior` or `load_super_resolution` reads: two priors with different ones are not the
    same."""
    return file_crc32(as_checkpoint(_resolved(path)).file)


def file_read(path: str | Path | MedSynCheckpoint) -> str | None:
    """Of a folder of MedSyn's, the file that is read and, in brackets, which weights it holds by its name; None for a
    file."""
    given = as_checkpoint(_resolved(path))
    if Path(given.path).is_file():
        return None
    file = given.file
    kind = next(kind for kind, names in FILES.items() if file.name in names)
    return f"{file.parent.name}/{file.name} ({kind})"


def build_prior(header: dict, weights: dict[str, Tensor]) -> Prior:
    """The prior that `Prior.describe` described, with these weights; those of the text encoder ("text.") are left out.

    Raises ValueError where header and weights do not fit together.
    """
    weights = {k: w for k, w in weights.items() if not k.startswith("text.")}
    return built_network(lambda: _untrained(header), weights, header, ("network", "detail"))


def _untrained(header: dict) -> Prior:
    return Prior(VolumeUNet(**header["network"]), Grid(**header["grid"]), window_of(header),
                 schedule=CosineSchedule(**header["schedule"]), sigma_data=number_of(header, "sigma_data"),
                 skip_std=number_of(header, "skip_std"),
                 detail=DetailNetwork(**header["detail"]) if "detail" in header else None)


def build_refiner(header: dict, weights: dict[str, Tensor]) -> Refiner:
    """The refiner that `Refiner.describe` described, with these weights, as `build_prior` builds a prior."""
    def made() -> Refiner:
        prior = _untrained(header)
        uncertainty = Uncertainty(**header["uncertainty"]) if "uncertainty" in header else None
        return Refiner(prior, torch.zeros(prior.state_channels, *prior.grid.shape), uncertainty,
                       _untrained(header["first"]) if "first" in header else None)

    first = header.get("first", {})
    if not isinstance(first, dict):
        raise ValueError(f"first is {first}, where a mapping of settings is needed")
    described = header | {f"first.{name}": settings for name, settings in first.items()}
    weights = {k: w for k, w in weights.items() if not k.startswith(("text.", "prior.text.", "first.text."))}
    return built_network(made, weights, described, ("network", "detail", "uncertainty", "first.network",
                                                    "first.detail"))


def build_super_resolution(header: dict, weights: dict[str, Tensor]) -> SuperResolution:
    """The stage that `SuperResolution.describe` described, with these weights.

    Raises ValueError where header and weights do not fit together.
    """
    def made() -> SuperResolution:
        return SuperResolution(
            LocalUNet(**header["network"]), Grid(**header["grid"]), window_of(header),
            whole_of(header, "factor"), len(header["coarse_state"]), CosineSchedule(**header["schedule"]),
            number_of(header, "detail_std"), number_of(header, "skip_std"))

    return built_network(made, weights, header, ("network",))


def build_correction(header: dict, weights: dict[str, Tensor]) -> CorrectionNetwork:
    """The network that `CorrectionNetwork.describe` described, with these weights, as `build_prior` builds a prior."""
    def made() -> CorrectionNetwork:
        uncertainty = FinerUncertainty(**header["uncertainty"]) if "uncertainty" in header else None
        return CorrectionNetwork(**header["network"], grid=Grid(**header["grid"]), window=window_of(header),
                                 uncertainty=uncertainty)

    return built_network(made, weights, header, ("network", "uncertainty"))
