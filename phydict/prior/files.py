"""One file per prior: weights as safetensors, and in its header everything needed to use them rightly."""

from __future__ import annotations

import json
import reprlib
from collections.abc import Callable, Sequence
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor, nn

from phydict.diffusion import CosineSchedule
from phydict.grid import Grid
from phydict.prior.detail import DetailNetwork
from phydict.prior.finite import check_finite, not_finite
from phydict.prior.local_unet import LocalUNet
from phydict.prior.medsyn.checkpoint import (
    FILES, MedSynCheckpoint, as_checkpoint, is_medsyn, load_medsyn, load_medsyn_super_resolution)
from phydict.prior.medsyn.prior import MedSynPrior
from phydict.prior.medsyn.super_resolution import MedSynSuperResolution
from phydict.prior.prior import STATE, Prior
from phydict.prior.refiner import Refiner
from phydict.prior.super_resolution import SuperResolution
from phydict.prior.text import TextEncoder
from phydict.prior.unet import VolumeUNet
from phydict.runtime.files import atomic_write, file_crc32
from phydict.runtime.reading import not_written, reason, refusing
from phydict.runtime.shipped import own_or_shipped, shipped
from phydict.units import HUWindow

FORMAT = 1

DEFAULT_PRIOR = shipped("data/prior/phydict_64.safetensors")
"""The prior that comes with the project."""

DEFAULT_REFINER = shipped("data/prior/refiner_64.safetensors")
"""The refiner that comes with the project."""

ADVICE = "copy it again, or export it from its training checkpoint"

MOST_HU, MOST_LAYERS = 1e6, 256
"""No window reaches as far, and no network has more blocks on its way down, or layers."""

STAGES = {"base": "a base prior", "super_resolution": "a super-resolution stage", "refiner": "a refiner",
          "lifted": "a rival", "x2ct": "a rival", "xray2ctpa": "a rival"}
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
    write_stage(Path(path), describe(prior) | {"training": training or {}}, weights, dtype)


def save_super_resolution(fine: SuperResolution, path: str | Path, training: dict | None = None,
                          dtype: torch.dtype = torch.float16):
    """Writes `fine` to one .safetensors file, as `save_prior` does."""
    write_stage(Path(path), describe_super_resolution(fine) | {"training": training or {}}, fine.state_dict(), dtype)


def save_refiner(refiner: Refiner, path: str | Path, training: dict | None = None, dtype: torch.dtype = torch.float16):
    """Writes `refiner`, with the prior that it is made of, to one .safetensors file, as `save_prior` does."""
    if refiner.prior.text is None and refiner.prior.load_text is not None:
        refiner.prior.text = refiner.prior.load_text()
    copied = refiner.prior.text is not None and not refiner.prior.text.source
    weights = {k.replace("prior.text.", "text.", 1): w for k, w in refiner.state_dict().items()
               if copied or not k.startswith("prior.text.")}
    write_stage(Path(path), describe_refiner(refiner) | {"training": training or {}}, weights, dtype)


def write_stage(path: Path, header: dict, weights: dict[str, Tensor], dtype: torch.dtype) -> None:
    """Writes header and weights to one .safetensors file, replacing it only when complete. Raises OSError where it
    cannot, and ValueError where weights are not finite in `dtype`."""
    tensors = {k: w.detach().to("cpu", dtype).contiguous() for k, w in weights.items()}
    if broken := not_finite(tensors):
        raise ValueError(f"'{path}' was not written, since its weights are not finite in {dtype}: {broken}")
    try:
        with atomic_write(path) as part:
            save_file(tensors, part, {"phydict": json.dumps(header)})
    except (SafetensorError, OSError) as error:
        raise not_written(f"'{path}'", error, "give another place") from error


def describe(prior: Prior) -> dict:
    """What a prior is, as plain JSON values: from this and the weights `load_prior` builds it again."""
    text = prior.text
    if text is not None:
        text = {"source": text.source, "length": text.length, "width": text.width,
                "layers": text.bert.config.num_hidden_layers,
                "vocabulary": None if text.source else text.vocabulary,
                **({"padded_to": text.padded_to} if text.padded_to else {}),
                **({"sentences": text.sentences} if text.sentences else {})}
    return {"format": FORMAT, "stage": "base", "grid": prior.grid.to_dict(),
            "hu_window": [prior.window.low, prior.window.high], "state": STATE[:prior.network.state_channels],
            "sigma_data": prior.sigma_data, "skip_std": prior.skip_std, "schedule": vars(prior.schedule),
            "text": text, "network": prior.network.settings,
            **({"detail": prior.detail.settings} if prior.detail else {})}  # which older files do not name


def describe_super_resolution(fine: SuperResolution) -> dict:
    """What a super-resolution stage is, as plain JSON values, for `build_super_resolution`."""
    return {"format": FORMAT, "stage": "super_resolution", "grid": fine.grid.to_dict(),
            "hu_window": [fine.window.low, fine.window.high], "factor": fine.factor,
            "state": STATE[:fine.state_channels], "coarse_state": STATE[:fine.coarse_channels],
            "detail_std": fine.detail_std, "skip_std": fine.skip_std, "schedule": vars(fine.schedule),
            "network": fine.network.settings}


def describe_refiner(refiner: Refiner) -> dict:
    """What a refiner is, as plain JSON values, for `build_refiner`: its prior, called by another stage."""
    return describe(refiner.prior) | {"stage": "refiner"}


def load_prior(path: str | Path | MedSynCheckpoint = DEFAULT_PRIOR,
               device: str = "cpu") -> Prior | Refiner | MedSynPrior:
    """The prior in a .safetensors file written by `save_prior`, the refiner in one written by `save_refiner`, or the
    prior in a file or folder of MedSyn's (`load_medsyn`), ready to denoise (float32, evaluation mode).

    The default is the one that comes with the project. The text encoder stays on disk until the first report. Raises
    FileNotFoundError when there is no file, ValueError when it is truncated, is no prior, or holds weights that are not
    finite.
    """
    path = _found(path)
    if isinstance(path, MedSynCheckpoint) or is_medsyn(path):
        return load_medsyn(path, device)
    with refusing(path, ADVICE):
        header, weights = read_stage(path, ("base", "refiner"), device)
        try:
            build = build_refiner if header.get("stage") == "refiner" else build_prior
            found = build(header, weights)
            if has_text(header):
                prior = found.prior if isinstance(found, Refiner) else found
                prior.load_text = lambda: _load_text(path, header["text"])
        except ValueError as error:
            raise ValueError(f"'{path}' contradicts itself: {error}") from error
    return found.to(device).eval().requires_grad_(False)


def load_super_resolution(path: str | Path | MedSynCheckpoint,
                          device: str = "cpu") -> SuperResolution | MedSynSuperResolution:
    """The super-resolution stage in a file written by `save_super_resolution`, or MedSyn's; as `load_prior`."""
    path = _found(path)
    if isinstance(path, MedSynCheckpoint) or is_medsyn(path):
        return load_medsyn_super_resolution(path, device)
    with refusing(path, ADVICE):
        header, weights = read_stage(path, ("super_resolution",), device)
        try:
            fine = build_super_resolution(header, weights)
        except ValueError as error:
            raise ValueError(f"'{path}' contradicts itself: {error}") from error
    return fine.to(device).eval().requires_grad_(False)


def _found(path: str | Path | MedSynCheckpoint) -> Path | MedSynCheckpoint:
    return path if isinstance(path, MedSynCheckpoint) else own_or_shipped(path)


def read_stage(path: Path, stages: Sequence[str], device: str) -> tuple[dict, dict[str, Tensor]]:
    """Header and weights, but those of a text encoder, of a file that must be of one of `stages`."""
    if not path.is_file():
        raise FileNotFoundError(f"no prior at '{path}': give the .safetensors file that training wrote")
    try:
        with safe_open(path, "pt", device=device) as file:
            header = json.loads((file.metadata() or {}).get("phydict", "{}"))
            weights = {k: file.get_tensor(k) for k in file.keys() if not k.startswith("text.")}
    except Exception as error:  # whatever a damaged file leads its readers to
        raise ValueError(f"'{path}' is truncated or not a safetensors file ({reason(error)}): {ADVICE}") from error
    if not isinstance(header, dict) or header.get("format") != FORMAT:
        raise ValueError(f"'{path}' carries no phydict prior of format {FORMAT}: give a file that save_prior wrote")
    check_stage(header, stages, f"'{path}'")
    check_finite(weights, path)
    return header, weights


def is_saved_prior(path: str | Path) -> bool:
    """Whether `save_prior` or `save_super_resolution` wrote a file."""
    try:
        with safe_open(path, "pt") as file:
            return "phydict" in (file.metadata() or {})
    except (SafetensorError, OSError):
        return False


def check_stage(header: dict, stages: Sequence[str], name: str) -> None:
    """Raises ValueError where the header of the file `name` is of none of `stages`."""
    found = header.get("stage", "base")
    if found not in stages:
        kind = STAGES.get(found) if isinstance(found, str) else None
        raise ValueError(f"{name} is {kind or f'of stage {reprlib.repr(found)}'}, but {STAGES[stages[0]]} is needed "
                         "here: give the file of that stage")


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
    weights = {k: w.float() for k, w in weights.items() if not k.startswith("text.")}
    return built_network(lambda: _untrained(header), weights, header, ("network", "detail"))


def _untrained(header: dict) -> Prior:
    return Prior(VolumeUNet(**header["network"]), Grid(**header["grid"]), window_of(header),
                 schedule=CosineSchedule(**header["schedule"]), sigma_data=_number(header, "sigma_data"),
                 skip_std=_number(header, "skip_std"),
                 detail=DetailNetwork(**header["detail"]) if "detail" in header else None)


def build_refiner(header: dict, weights: dict[str, Tensor]) -> Refiner:
    """The refiner that `describe_refiner` described, with these weights, as `build_prior` builds a prior."""
    def made() -> Refiner:
        prior = _untrained(header)
        return Refiner(prior, torch.zeros(prior.state_channels, *prior.grid.shape))

    weights = {k: w.float() for k, w in weights.items() if not k.startswith(("text.", "prior.text."))}
    return built_network(made, weights, header, ("network", "detail"))


def build_super_resolution(header: dict, weights: dict[str, Tensor]) -> SuperResolution:
    """The stage that `describe_super_resolution` described, with these weights.

    Raises ValueError where header and weights do not fit together.
    """
    def made() -> SuperResolution:
        return SuperResolution(
            LocalUNet(**header["network"]), Grid(**header["grid"]), window_of(header),
            _whole(header, "factor"), len(header["coarse_state"]), CosineSchedule(**header["schedule"]),
            _number(header, "detail_std"), _number(header, "skip_std"))

    return built_network(made, {k: w.float() for k, w in weights.items()}, header, ("network",))


def built_network(made: Callable[[], nn.Module], weights: dict[str, Tensor], header: dict,
           networks: tuple[str, ...]) -> nn.Module:
    """What `made` makes of a header, with these weights. What does not fit them is refused before it takes memory.

    networks: the header's keys whose values are settings of networks.
    """
    try:
        for name in networks:
            if name in header:
                _check_sizes(name, header[name], weights)
        with torch.device("meta"):
            shapes = {k: w.shape for k, w in made().state_dict().items()}
        unlike = [k for k in shapes.keys() | weights.keys() if k not in shapes or k not in weights
                  or shapes[k] != weights[k].shape]
        if unlike:
            raise ValueError(f"{len(unlike)} of them are missing, unexpected or of another shape, such as "
                             f"{min(unlike)}")
        stage = made()
        stage.load_state_dict(weights)
    except Exception as error:  # of whatever kind: it is the header that leads to it
        lacks = f"the header lacks {error}" if isinstance(error, KeyError) else reason(error)
        raise ValueError(f"the weights are not those of the network that the header describes ({lacks})") from error
    return stage


def _check_sizes(name: str, settings: dict, weights: dict[str, Tensor]) -> None:
    """Raises ValueError where a network's settings hold anything larger than its weights have of it, or more layers
    than can be meant."""
    if not isinstance(settings, dict):
        raise ValueError(f"{name} is {reprlib.repr(settings)}, where a mapping of settings is needed")
    most = max([len(weights), *(n for w in weights.values() for n in w.shape)])
    layers = len(settings["channels"]) if isinstance(settings.get("channels"), list) else 1
    for key, value in settings.items():
        if key in ("res_blocks", "layers") and type(value) is int:
            layers *= value
        elif isinstance(value, list) and (key == "res_blocks" or not value):
            raise ValueError(f"{name}.{key} is {reprlib.repr(value)}")
    if layers > MOST_LAYERS:
        raise ValueError(f"{name} has {layers:,} layers, more than {MOST_LAYERS}")
    for key, value in settings.items():
        if key == "kinds" and isinstance(value, list) and all(isinstance(kind, str) for kind in value):
            value = len(value)
        values = value if isinstance(value, list) else [value]
        if len(values) > most or not all(isinstance(n, int) and 0 <= n <= most for n in values):
            raise ValueError(f"{name}.{key} is {reprlib.repr(value)}")


def _number(header: dict, key: str) -> float:
    if isinstance(header[key], bool) or not isinstance(header[key], int | float) or not 0 < header[key] < 1e6:
        raise ValueError(f"{key} is {reprlib.repr(header[key])}, where a positive number is needed")
    return header[key]


def window_of(header: dict) -> HUWindow:
    """The HU window of a header. Raises ValueError where it holds none."""
    ends = header["hu_window"]
    if not isinstance(ends, list) or len(ends) != 2 or not all(
            type(end) in (int, float) and abs(end) < MOST_HU for end in ends):
        raise ValueError(f"hu_window is {reprlib.repr(ends)}, where two numbers of HU are needed")
    return HUWindow(*ends)


def _whole(header: dict, key: str) -> int:
    if type(header[key]) is not int or not 0 < header[key] < 2**16:
        raise ValueError(f"{key} is {reprlib.repr(header[key])}, where a positive whole number is needed")
    return header[key]


def has_text(header: dict) -> bool:
    """Whether a header describes a text encoder. Raises ValueError where "text" is not what `describe` writes."""
    text, keys = header.get("text", "missing"), ("source", "length", "width", "layers", "vocabulary")
    if text is None:
        return False
    if not isinstance(text, dict) or any(key not in text for key in keys):
        raise ValueError(f"text is {reprlib.repr(text)}, where {', '.join(keys)} are needed, or null")
    for key in ("length", "width", "layers"):
        _whole(text, key)
    for key in ("padded_to", "sentences"):
        if key in text:
            _whole(text, key)
    words = text["vocabulary"]
    if not isinstance(text["source"], str | None) or (text["source"] is None and not (
            isinstance(words, list) and all(isinstance(word, str) for word in words))):
        raise ValueError(f"text.source is {reprlib.repr(text['source'])} and text.vocabulary {reprlib.repr(words)}, "
                         "where one of them names a text encoder or lists words")
    return True


def build_text(text: dict, weights: dict[str, Tensor]) -> TextEncoder:
    """The text encoder of a header's "text", frozen; `weights` ("text.") are used unless it is a pretrained one."""
    if text["source"]:
        return TextEncoder.pretrained(text["source"], text["length"], text.get("padded_to"))
    weights = {k.removeprefix("text."): w.float() for k, w in weights.items() if k.startswith("text.")}
    try:
        _check_sizes("text", {key: text[key] for key in ("length", "width", "layers")}, weights)
        held = len(weights["bert.embeddings.word_embeddings.weight"])
        if len(text["vocabulary"]) != held:
            raise ValueError(f"it lists {len(text['vocabulary'])} words, but its weights have {held}")
        encoder = TextEncoder.small(text["vocabulary"], text["width"], text["layers"], text["length"],
                                    text.get("sentences"))
        encoder.load_state_dict(weights)
    except Exception as error:  # of whatever kind: it is the header that leads to it
        raise ValueError(f"the text encoder is not the one that the header describes ({reason(error)})") from error
    encoder.trainable = False
    return encoder.eval().requires_grad_(False)


def _load_text(path: Path, text: dict) -> TextEncoder:
    with refusing(path, ADVICE):
        with safe_open(path, "pt") as file:
            weights = {k: file.get_tensor(k) for k in file.keys() if k.startswith("text.")}
        check_finite(weights, path)
        try:
            return build_text(text, weights)
        except ValueError as error:
            raise ValueError(f"'{path}' contradicts itself: {error}") from error
