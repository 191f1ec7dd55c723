"""A stage's file: weights as safetensors, and in the header what is needed to build its network again."""

from __future__ import annotations

import json
import reprlib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Protocol, TypeVar

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor, nn

from phydict.grid import Grid
from phydict.prior.finite import check_finite, not_finite
from phydict.runtime.files import atomic_write
from phydict.runtime.reading import naming, not_written, reason, refusing
from phydict.units import HUWindow

Network = TypeVar("Network", bound=nn.Module)

FORMAT = 1

ADVICE = "copy it again, or export it from its training checkpoint"

MOST_HU, MOST_LAYERS = 1e6, 256
"""No window reaches as far, and no network has more blocks on its way down, or layers."""

STAGES = {"base": "a base prior", "super_resolution": "a super-resolution stage", "refiner": "a refiner",
          "refinement": "a refinement on finer voxels", "lifted": "a rival", "x2ct": "a rival", "xray2ctpa": "a rival"}
"""What a file's header may call it, and what that is; a header that says nothing is of a base prior."""


class Described(Protocol):
    """A network that says what it is, as plain JSON values: from this and its weights it is built again."""

    def describe(self) -> dict: ...

    def state_dict(self) -> dict[str, Tensor]: ...


def header_start(stage: str, grid: Grid, window: HUWindow) -> dict:
    """What the header of every stage's file begins with, as plain JSON values; stage: one of STAGES."""
    return {"format": FORMAT, "stage": stage, "grid": grid.to_dict(), "hu_window": [window.low, window.high]}


def save_stage(stage: Described, path: str | Path, training: dict | None = None, dtype: torch.dtype = torch.float16):
    """Writes a super-resolution stage, a correction or a rival to one .safetensors file, as `save_prior` does a
    prior."""
    write_stage(Path(path), stage.describe() | {"training": training or {}}, stage.state_dict(), dtype)


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


def header_of(path: str | Path) -> dict:
    """What `write_stage` put into a file's header, {} where it put none. Raises SafetensorError, OSError or ValueError
    where that cannot be read."""
    with safe_open(path, "pt") as file:
        return json.loads((file.metadata() or {}).get("phydict", "{}"))


def read_stage(path: Path, stages: Sequence[str]) -> tuple[dict, dict[str, Tensor]]:
    """Header and weights, but those of a text encoder, of a file that must be of one of `stages`."""
    if not path.is_file():
        raise FileNotFoundError(f"no prior at '{path}': give the .safetensors file that training wrote")
    try:
        header = header_of(path)
        with safe_open(path, "pt") as file:
            weights = {k: file.get_tensor(k) for k in file.keys() if not k.startswith("text.")}
    except Exception as error:  # whatever a damaged file leads its readers to
        raise ValueError(f"'{path}' is truncated or not a safetensors file ({reason(error)}): {ADVICE}") from error
    if not isinstance(header, dict) or header.get("format") != FORMAT:
        raise ValueError(f"'{path}' carries no phydict prior of format {FORMAT}: give a file that save_prior wrote")
    check_stage(header, stages, f"'{path}'")
    check_finite(weights, path)
    return header, weights


def loaded_stage(path: Path, stages: Sequence[str], build: Callable[[dict, dict[str, Tensor]], Network]) -> Network:
    """What `build` makes of a file of one of these stages, ready to be used (evaluation mode, no gradients).

    Raises FileNotFoundError where there is no file, ValueError where it is truncated, is of another stage, contradicts
    itself or holds weights that are not finite.
    """
    with refusing(path, ADVICE):
        header, weights = read_stage(path, stages)
        with naming(f"'{path}' contradicts itself"):
            loaded = build(header, weights)
    return loaded.eval().requires_grad_(False)


def is_saved_prior(path: str | Path) -> bool:
    """Whether `write_stage` wrote a file."""
    try:
        with safe_open(path, "pt") as file:
            return "phydict" in (file.metadata() or {})
    except (SafetensorError, OSError):
        return False


def check_stage(header: dict, stages: Sequence[str], name: str) -> None:
    """Raises ValueError where the header of the file `name` is of none of `stages`."""
    stage = header.get("stage", "base")
    if stage not in stages:
        kind = STAGES.get(stage) if isinstance(stage, str) else None
        raise ValueError(f"{name} is {kind or f'of stage {reprlib.repr(stage)}'}, but {STAGES[stages[0]]} is needed "
                         "here: give the file of that stage")


def built_network(made: Callable[[], Network], weights: dict[str, Tensor], header: dict,
                  networks: tuple[str, ...]) -> Network:
    """What `made` makes of a header, with these weights. What does not fit them is refused before it takes memory.

    networks: the header's keys whose values are settings of networks.
    """
    try:
        for name in networks:
            if name in header:
                check_sizes(name, header[name], weights)
        with torch.device("meta"):
            wrong = unlike(weights, made().state_dict())
        if wrong:
            raise ValueError(f"{len(wrong)} of them are missing, unexpected or of another shape, such as {min(wrong)}")
        with torch.random.fork_rng(devices=[]):  # what it begins with is random
            stage = made()
        stage.load_state_dict(weights)
    except Exception as error:  # of whatever kind: it is the header that leads to it
        lacks = f"the header lacks {error}" if isinstance(error, KeyError) else reason(error)
        raise ValueError(f"the weights are not those of the network that the header describes ({lacks})") from error
    return stage


def unlike(given: Mapping[str, Tensor], own: Mapping[str, Tensor]) -> list[str]:
    """The names of the weights that are given to a network and are not its own, or of another shape, or missing."""
    return [name for name in given.keys() | own.keys()
            if name not in given or name not in own or given[name].shape != own[name].shape]


def check_sizes(name: str, settings: dict, weights: dict[str, Tensor]) -> None:
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


def number_of(header: dict, key: str) -> float:
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


def whole_of(header: dict, key: str) -> int:
    if type(header[key]) is not int or not 0 < header[key] < 2**16:
        raise ValueError(f"{key} is {reprlib.repr(header[key])}, where a positive whole number is needed")
    return header[key]
