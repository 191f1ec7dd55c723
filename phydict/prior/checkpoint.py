"""One file per prior: weights as safetensors, and in its header everything needed to use them rightly."""

from __future__ import annotations

import json
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from phydict.atomic import whole_file
from phydict.checksum import file_crc32
from phydict.diffusion import CosineSchedule
from phydict.grid import Grid
from phydict.prior.detail import DetailNetwork
from phydict.prior.finite import check_finite, not_finite
from phydict.prior.local_unet import LocalUNet
from phydict.prior.medsyn import MedSynPrior, MedSynSuperResolution
from phydict.prior.pretrained import (
    FILES, MedSynCheckpoint, as_checkpoint, is_medsyn, load_medsyn, load_medsyn_super_resolution)
from phydict.prior.prior import STATE, Prior
from phydict.prior.super_resolution import SuperResolution
from phydict.prior.text import TextEncoder
from phydict.prior.unet import VolumeUNet
from phydict.shipped import own_or_shipped, shipped
from phydict.units import HUWindow

FORMAT = 1

DEFAULT_PRIOR = shipped("data/prior/phydict_64.safetensors")
"""The prior that comes with the project."""

STAGES = {"base": "a base prior", "super_resolution": "a super-resolution stage"}
"""What a file's header may call it, and what that is; a header that says nothing is of a base prior."""


def save_prior(prior: Prior, path: str | Path, training: dict | None = None, dtype: torch.dtype = torch.float16):
    """Writes `prior` to one .safetensors file, replacing it only when complete. Raises OSError where it cannot,
    and ValueError where weights are not finite.

    training: what the header should say of how it was trained (data, steps, command); plain JSON values.
    dtype: precision of the weights on disk.
    """
    if prior.text is None and prior.load_text is not None:
        prior.text = prior.load_text()
    weights = prior.state_dict()
    if prior.text is not None and prior.text.source:  # a pretrained BERT is named, not copied
        weights = {k: w for k, w in weights.items() if not k.startswith("text.")}
    _write(Path(path), describe(prior) | {"training": training or {}}, weights, dtype)


def save_super_resolution(fine: SuperResolution, path: str | Path, training: dict | None = None,
                          dtype: torch.dtype = torch.float16):
    """Writes `fine` to one .safetensors file, as `save_prior` does."""
    _write(Path(path), describe_super_resolution(fine) | {"training": training or {}}, fine.state_dict(), dtype)


def _write(path: Path, header: dict, weights: dict[str, Tensor], dtype: torch.dtype) -> None:
    tensors = {k: w.detach().to("cpu", dtype).contiguous() for k, w in weights.items()}
    if broken := not_finite(tensors):
        raise ValueError(f"'{path}' was not written, since its weights are not finite in {dtype}: {broken}")
    try:
        with whole_file(path) as part:
            save_file(tensors, part, {"phydict": json.dumps(header)})
    except (SafetensorError, OSError) as error:
        raise OSError(f"'{path}' could not be written ({error}): free some space, or give another place") from error


def describe(prior: Prior) -> dict:
    """What a prior is, as plain JSON values: from this and the weights `load_prior` builds it again."""
    text = prior.text
    if text is not None:
        text = {"source": text.source, "length": text.length, "width": text.width,
                "layers": text.bert.config.num_hidden_layers,
                "vocabulary": None if text.source else text.vocabulary,
                **({"padded_to": text.padded_to} if text.padded_to else {})}
    return {"format": FORMAT, "stage": "base", "grid": prior.grid.to_dict(),
            "hu_window": [prior.window.low, prior.window.high], "state": STATE[:prior.network.state_channels],
            "sigma_data": prior.sigma_data, "skip_std": prior.skip_std, "schedule": vars(prior.schedule),
            "network": prior.network.settings, "text": text,
            **({"detail": prior.detail.settings} if prior.detail else {})}  # which older files do not name


def describe_super_resolution(fine: SuperResolution) -> dict:
    """What a super-resolution stage is, as plain JSON values, for `build_super_resolution`."""
    return {"format": FORMAT, "stage": "super_resolution", "grid": fine.grid.to_dict(),
            "hu_window": [fine.window.low, fine.window.high], "factor": fine.factor,
            "state": STATE[:fine.state_channels], "coarse_state": STATE[:fine.coarse_channels],
            "detail_std": fine.detail_std, "skip_std": fine.skip_std, "schedule": vars(fine.schedule),
            "network": fine.network.settings}


def load_prior(path: str | Path | MedSynCheckpoint = DEFAULT_PRIOR, device: str = "cpu") -> Prior | MedSynPrior:
    """The prior in a .safetensors file written by `save_prior`, or in a file or folder of MedSyn's (`load_medsyn`),
    ready to denoise (float32, evaluation mode).

    The default is the one that comes with the project. The text encoder stays on disk until the first report. Raises
    FileNotFoundError when there is no file, ValueError when it is truncated, is no prior, or holds weights that are not
    finite.
    """
    path = _found(path)
    if isinstance(path, MedSynCheckpoint) or is_medsyn(path):
        return load_medsyn(path, device)
    header, weights = _read(path, "base", device)
    try:
        prior = build_prior(header, weights)
    except ValueError as error:
        raise ValueError(f"'{path}' contradicts itself: {error}") from error
    if header["text"]:
        prior.load_text = lambda: _load_text(path, header["text"])
    return prior.to(device).eval().requires_grad_(False)


def load_super_resolution(path: str | Path | MedSynCheckpoint,
                          device: str = "cpu") -> SuperResolution | MedSynSuperResolution:
    """The super-resolution stage in a file written by `save_super_resolution`, or MedSyn's; as `load_prior`."""
    path = _found(path)
    if isinstance(path, MedSynCheckpoint) or is_medsyn(path):
        return load_medsyn_super_resolution(path, device)
    header, weights = _read(path, "super_resolution", device)
    try:
        fine = build_super_resolution(header, weights)
    except ValueError as error:
        raise ValueError(f"'{path}' contradicts itself: {error}") from error
    return fine.to(device).eval().requires_grad_(False)


def _found(path: str | Path | MedSynCheckpoint) -> Path | MedSynCheckpoint:
    return path if isinstance(path, MedSynCheckpoint) else own_or_shipped(path)


def _read(path: Path, stage: str, device: str) -> tuple[dict, dict[str, Tensor]]:
    """Header and weights, but those of a text encoder, of a file that must be of one of STAGES."""
    if not path.is_file():
        raise FileNotFoundError(f"no prior at '{path}': give the .safetensors file that training wrote")
    try:
        with safe_open(path, "pt", device=device) as file:
            header = json.loads((file.metadata() or {}).get("phydict", "{}"))
            weights = {k: file.get_tensor(k) for k in file.keys() if not k.startswith("text.")}
    except (SafetensorError, OSError, ValueError) as error:
        raise ValueError(f"'{path}' is truncated or not a safetensors file ({error}): copy it again, "
                         "or export it from its training checkpoint") from error
    if header.get("format") != FORMAT:
        raise ValueError(f"'{path}' carries no phydict prior of format {FORMAT}: give a file that save_prior wrote")
    check_stage(header, stage, f"'{path}'")
    check_finite(weights, path)
    return header, weights


def is_saved_prior(path: str | Path) -> bool:
    """Whether `save_prior` or `save_super_resolution` wrote a file."""
    try:
        with safe_open(path, "pt") as file:
            return "phydict" in (file.metadata() or {})
    except (SafetensorError, OSError):
        return False


def check_stage(header: dict, stage: str, name: str) -> None:
    """Raises ValueError where the header of the file `name` is of another stage."""
    found = header.get("stage", "base")
    if found != stage:
        raise ValueError(f"{name} is {STAGES.get(found, found)}, but {STAGES[stage]} is needed here: give the file of "
                         "that stage")


def fingerprint(path: str | Path | MedSynCheckpoint) -> int:
    """CRC-32 of the file that `load_prior` or `load_super_resolution` reads: two priors with different ones are not the
    same."""
    return file_crc32(as_checkpoint(_found(path)).file)


def file_read(path: str | Path | MedSynCheckpoint) -> str | None:
    """Of a folder of MedSyn's, the file that is read and, in brackets, which weights it holds by its name; None for a
    file."""
    given = as_checkpoint(_found(path))
    if Path(given.path).is_file():
        return None
    file = given.file
    kind = next(kind for kind, names in FILES.items() if file.name in names)
    return f"{file.parent.name}/{file.name} ({kind})"


def build_prior(header: dict, weights: dict[str, Tensor]) -> Prior:
    """The prior that `describe` described, with these weights; those of the text encoder ("text.") are left out.

    Raises ValueError where header and weights do not fit together.
    """
    try:
        prior = Prior(VolumeUNet(**header["network"]), Grid(**header["grid"]), HUWindow(*header["hu_window"]),
                      schedule=CosineSchedule(**header["schedule"]), sigma_data=header["sigma_data"],
                      skip_std=header["skip_std"],
                      detail=DetailNetwork(**header["detail"]) if "detail" in header else None)
        prior.load_state_dict({k: w.float() for k, w in weights.items() if not k.startswith("text.")})
    except (KeyError, TypeError, RuntimeError) as error:
        raise ValueError(f"the weights are not those of the network that the header describes ({error})") from error
    return prior


def build_super_resolution(header: dict, weights: dict[str, Tensor]) -> SuperResolution:
    """The stage that `describe_super_resolution` described, with these weights.

    Raises ValueError where header and weights do not fit together.
    """
    try:
        fine = SuperResolution(
            LocalUNet(**header["network"]), Grid(**header["grid"]), HUWindow(*header["hu_window"]), header["factor"],
            len(header["coarse_state"]), CosineSchedule(**header["schedule"]), header["detail_std"],
            header["skip_std"])
        fine.load_state_dict({k: w.float() for k, w in weights.items()})
    except (KeyError, TypeError, RuntimeError) as error:
        raise ValueError(f"the weights are not those of the network that the header describes ({error})") from error
    return fine


def build_text(text: dict, weights: dict[str, Tensor]) -> TextEncoder:
    """The text encoder of a header's "text", frozen; `weights` ("text.") are used unless it is a pretrained one."""
    if text["source"]:
        return TextEncoder.pretrained(text["source"], text["length"], text.get("padded_to"))
    encoder = TextEncoder.small(text["vocabulary"], text["width"], text["layers"], text["length"])
    encoder.load_state_dict({k.removeprefix("text."): w.float() for k, w in weights.items() if k.startswith("text.")})
    encoder.trainable = False
    return encoder.eval().requires_grad_(False)


def _load_text(path: Path, text: dict) -> TextEncoder:
    with safe_open(path, "pt") as file:
        weights = {k: file.get_tensor(k) for k in file.keys() if k.startswith("text.")}
    check_finite(weights, path)
    return build_text(text, weights)
