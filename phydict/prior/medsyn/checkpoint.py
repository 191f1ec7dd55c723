"""Weights that others trained: MedSyn's checkpoints, read strictly and never run.

A pickle may hold code. Only tensors are read from one, and a file that asks for anything else is refused.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import cast

import torch
from safetensors import safe_open
from torch import Tensor

from phydict.prior.finite import check_finite
from phydict.prior.medsyn.networks import GROUPS, HEAD_WIDTH, SliceUNet, SuperResolutionUNet, TextUNet
from phydict.prior.medsyn.prior import MedSynPrior
from phydict.prior.medsyn.super_resolution import MedSynSuperResolution
from phydict.prior.tensors import read_torch
from phydict.prior.text import TextEncoder
from phydict.runtime.reading import reason, refusing

FILES = {"ema": ("model_1.safetensors", "pytorch_model_1.bin"), "online": ("model.safetensors", "pytorch_model.bin")}
"""Names of accelerate's files by what they hold, where a folder comes straight from MedSyn's training."""

STAGES = {1: "64^3 stage (1), which reads reports", 2: "256^3 super-resolution stage (2)"}
FOLDERS = {1: "results_text_low_res_improved_unet_seg", 2: "results_SR_gaussian_aug_full_volume_seg"}
"""MedSyn's stages, and the folders of its archive that hold them."""

TEXT_FOLDER, PADDED_TO = "pretrained_lm", 2048
"""Where MedSyn keeps its language model, and how many tokens that pads a report to."""

UNUSED = re.compile(r"betas|.*alphas_cumprod.*|posterior_.*|ddim_.*|lpips\..*")
"""Entries beside the network's that older checkpoints hold: the discrete schedule and the perceptual loss."""

TIED = re.compile(r"mid_spatial_attn\d\.fn\.fn\.fn\.(to_qkv|to_out)\.weight")
"""Names of stage 1's one self-attention, of which safetensors files keep only some."""

MOST_LEVELS = 16
"""No network of MedSyn's goes down as often."""


@dataclass(frozen=True)
class MedSynCheckpoint:
    """A MedSyn checkpoint and how to read it.

    Args:
        path: a file, the <N>_ckpt folder it is in, or a folder of such folders, of which the latest is read
        which: in a folder, the averaged weights (ema), those being trained (online), or those that MedSyn's inference
            reads (auto): averaged for stage 1, online for stage 2, and the others where these are missing
        upsample_first: the order of the network's upward path: false as in MedSyn's inference code, true as in its
            training code
        text: the folder of the language model; none given: pretrained_lm, beside the checkpoint or up to two folders
            above
    """

    path: str
    which: str = "auto"
    upsample_first: bool = False
    text: str | None = None

    def __post_init__(self):
        if self.which not in ("auto", *FILES):
            raise ValueError(f"a MedSyn checkpoint is read as auto, {' or '.join(FILES)}, but '{self.which}' was given")

    @property
    def file(self) -> Path:
        """The file that is read. Raises FileNotFoundError, saying what there is, or ValueError for a file with
        `which`."""
        path = Path(self.path)
        if path.is_file():
            if self.which != "auto":
                raise ValueError(f"'{path}' is a file, which is read as it is: leave out which={self.which}, or give "
                                 "the folder")
            return path
        held = files_in(path)
        kind = default_kind(held) if self.which == "auto" else self.which
        if kind in held:
            return held[kind]
        there = f"there is {', '.join(file.name for file in held.values())}" if held else "there is none"
        wanted = [name for kind, names in FILES.items() if self.which in ("auto", kind) for name in names]
        raise FileNotFoundError(f"no prior at '{path}': MedSyn's folders hold {' or '.join(wanted)}, but {there}")

    @property
    def text_folder(self) -> Path | None:
        """The folder of the language model, if there is one."""
        if self.text is not None:
            return Path(self.text)
        path = self.file.absolute()
        return next((folder / TEXT_FOLDER for folder in path.parents[:3] if (folder / TEXT_FOLDER).is_dir()), None)


def files_in(folder: Path) -> dict[str, Path]:
    """The model files of a folder that accelerate wrote, or of the latest <N>_ckpt in it, by what they hold."""
    saved = [sub for sub in folder.glob("*_ckpt") if sub.is_dir() and sub.name.removesuffix("_ckpt").isdecimal()]
    if saved:
        folder = max(saved, key=lambda sub: int(sub.name.removesuffix("_ckpt")))
    return {kind: next(folder / name for name in names if (folder / name).is_file())
            for kind, names in FILES.items() if any((folder / name).is_file() for name in names)}


def default_kind(held: dict[str, Path]) -> str | None:
    """Of a folder's model files by what they hold, the kind that MedSyn's inference reads, where it is there; None of
    none."""
    if len(held) > 1 and any(_of_second_stage(file) for file in held.values()):
        return "online"
    return next((kind for kind in FILES if kind in held), None)


def _of_second_stage(file: Path) -> bool:
    """Whether a file holds stage 2's first convolution; not where it is damaged, which reading it will tell."""
    try:
        return any("init_conv0." in name for name in read_tensors(file, shapes_only=True))
    except ValueError:
        return False


@dataclass(frozen=True)
class MedSynWeights:
    """The entries of a MedSyn checkpoint beside the network that they belong to, which has no memory yet (meta).

    weights: the network's own names -> tensors, aliases filled in; ignored: entries that are not needed; tied: how many
    names of the shared self-attention the file holds.
    """

    stage: int
    network: SliceUNet
    weights: dict[str, Tensor]
    ignored: list[str]
    tied: int

    @classmethod
    def sort(cls, entries: dict[str, Tensor], upsample_first: bool = False) -> MedSynWeights:
        """Finds stage and size by names and shapes. Raises ValueError where it is no network of MedSyn's."""
        ignored, weights = [], {}
        for name, tensor in entries.items():
            bare = name.removeprefix("module.").removeprefix("denoise_fn.")
            if UNUSED.fullmatch(bare):
                ignored.append(name)
            else:
                weights[bare] = tensor
        stage = 1 if "init_conv.weight" in weights else 2 if "init_conv0.weight" in weights else 0
        if not stage:
            raise ValueError(f"holds none of MedSyn's networks: of {len(entries)} entries ({listed(entries)}), none is "
                             "denoise_fn.init_conv.weight (stage 1) or denoise_fn.init_conv0.weight (stage 2)")
        tied = _tie(weights)
        with torch.device("meta"):
            network = (TextUNet if stage == 1 else SuperResolutionUNet)(
                **_settings(weights, stage), upsample_first=upsample_first)
        return cls(stage, network, weights, ignored, tied)

    @property
    def missing(self) -> list[str]:
        return sorted(set(self.network.state_dict()) - set(self.weights))

    @property
    def unexpected(self) -> list[str]:
        return sorted(set(self.weights) - set(self.network.state_dict()))

    @property
    def misshapen(self) -> list[str]:
        """Names and shapes of the tensors that do not fit in the network."""
        expected = self.network.state_dict()
        return [f"{name} {tuple(tensor.shape)} instead of {tuple(expected[name].shape)}"
                for name, tensor in self.weights.items() if name in expected and tensor.shape != expected[name].shape]

    @property
    def misfits(self) -> str:
        """What keeps these weights from their network, in words; empty where they fit."""
        kinds = {"missing": self.missing, "unexpected": self.unexpected, "of another shape": self.misshapen}
        return ", ".join(f"{len(names)} {kind} ({listed(names)})" for kind, names in kinds.items() if names)

    def loaded(self) -> SliceUNet:
        """The network with copies of these weights, in float32. Raises ValueError where they do not fit it."""
        if self.misfits:
            raise ValueError(f"does not fit MedSyn's {STAGES[self.stage]} of width {self.network.widths[0]}: "
                             f"{self.misfits}")
        self.network.to_empty(device="cpu").load_state_dict(self.weights)
        return self.network


def _settings(weights: dict[str, Tensor], stage: int) -> dict:
    """The sizes of a network of MedSyn's, from shapes; where a tensor is missing, those of the full-size network."""
    def size(name: str, axis: int, default: int) -> int:
        return weights[name].shape[axis] if name in weights and weights[name].ndim > axis else default

    width = size("init_conv.weight", 0, 160) if stage == 1 else size("init_conv0.weight", 0, 56)
    if width < GROUPS:
        raise ValueError(f"is not MedSyn's: its first convolution has {width} channels, but it needs {GROUPS} at least")
    there = {name.split(".")[1] for name in weights if name.startswith("downs.")}
    levels = next(i for i in count(1) if str(i) not in there)
    if levels > MOST_LEVELS:
        raise ValueError(f"is not MedSyn's: it has {levels} levels, more than {MOST_LEVELS}")
    deep = [size(f"downs.{i}.0.block1.proj.weight", 0, width * 2**i) for i in range(levels)]
    attention = "mid_spatial_attn1" if stage == 1 else "mid_spatial_attn"
    inner = size(f"{attention}.fn.fn.fn.to_out.weight", 1, 256 if stage == 1 else 128)
    settings = {"width": width, "multipliers": [max(1, n // width) for n in deep], "heads": max(1, inner // HEAD_WIDTH)}
    if stage == 1:
        settings |= {"tokens": size("null_cond_emb", 1, 192), "context_dim": size("null_cond_emb", 2, 768)}
    return settings


def _tie(weights: dict[str, Tensor]) -> int:
    """Gives each name of the shared self-attention its tensor; returns how many names there were."""
    there = [name for name in weights if TIED.fullmatch(name)]
    for part in ("to_qkv", "to_out"):
        names = [name for name in there if f".{part}." in name]
        if not names:
            continue
        first = weights[names[0]]
        if not first.is_meta and any(not torch.equal(weights[name], first) for name in names):
            raise ValueError(f"is not MedSyn's: its self-attentions should share one {part}, but "
                             f"{listed(names)} differ")
        weights.update({f"mid_spatial_attn{n}.fn.fn.fn.{part}.weight": first for n in range(1, TextUNet.REPEATS + 1)})
    return len(there)


def load_medsyn(checkpoint: MedSynCheckpoint | str | Path) -> MedSynPrior:
    """MedSyn's 64^3 prior, ready to denoise (float32, evaluation mode). Its language model waits for the first report.

    Raises FileNotFoundError where there is no such file; ValueError where it is truncated, holds code, is of another
    stage, or where its weights are not exactly the network's.
    """
    checkpoint = as_checkpoint(checkpoint)
    prior = MedSynPrior(cast("TextUNet", _network(checkpoint, 1)))
    prior.load_text = lambda: _load_text(checkpoint, prior.null.shape[1])
    return prior.eval().requires_grad_(False)


def load_medsyn_super_resolution(checkpoint: MedSynCheckpoint | str | Path) -> MedSynSuperResolution:
    """MedSyn's 256^3 super-resolution stage, ready to denoise; raises as `load_medsyn` does."""
    network = cast("SuperResolutionUNet", _network(as_checkpoint(checkpoint), 2))
    return MedSynSuperResolution(network).eval().requires_grad_(False)


def as_checkpoint(given: MedSynCheckpoint | str | Path) -> MedSynCheckpoint:
    """A path as a checkpoint that is read by default."""
    return given if isinstance(given, MedSynCheckpoint) else MedSynCheckpoint(str(given))


def _network(checkpoint: MedSynCheckpoint, stage: int) -> SliceUNet:
    file = checkpoint.file
    with refusing(file, "copy it again"):
        entries = read_tensors(file)
        try:
            medsyn = MedSynWeights.sort(entries, checkpoint.upsample_first)
            if medsyn.stage != stage:
                raise ValueError(f"is MedSyn's {STAGES[medsyn.stage]}, but the {STAGES[stage]} is needed here: give "
                                 f"that one ({FOLDERS[stage]} in MedSyn's archive)")
            network = medsyn.loaded()
        except ValueError as error:
            raise ValueError(f"'{file}' {error}") from error
        check_finite(medsyn.weights, file)
    return network


def _load_text(checkpoint: MedSynCheckpoint, tokens: int) -> TextEncoder:
    folder = checkpoint.text_folder
    if folder is None:
        raise FileNotFoundError(f"no language model of MedSyn's beside '{checkpoint.path}': put it in a folder "
                                f"{TEXT_FOLDER} there (pytorch_model.bin, config.json, vocab.txt), or leave the report "
                                "out")
    return TextEncoder.pretrained(folder, tokens, padded_to=PADDED_TO)


def is_medsyn(path: str | Path) -> bool:
    """Whether a path should be read by `load_medsyn`: a folder with such files, a .bin, or safetensors named so."""
    path = Path(path)
    if path.is_dir():
        return bool(files_in(path))
    if path.suffix != ".safetensors" or not path.is_file():
        return path.is_file()
    try:
        with safe_open(path, "pt") as file:
            return any("init_conv" in name for name in file.keys())
    except Exception:  # whatever a damaged file leads to: `load_prior` says what
        return False


def listed(names: Iterable[str], most: int = 3) -> str:
    """The first few of many names."""
    names = list(names)
    return ", ".join(names[:most]) + (", ..." if len(names) > most else "")


def read_tensors(file: Path, shapes_only: bool = False) -> dict[str, Tensor]:
    """The named tensors of a .safetensors file, or of one that torch.save wrote; with shapes_only they may be empty.

    Raises ValueError where the file is truncated or holds anything but tensors.
    """
    if file.suffix == ".safetensors":
        try:
            with safe_open(file, "pt") as opened:
                if shapes_only:
                    return {name: torch.empty(opened.get_slice(name).get_shape(), device="meta")
                            for name in opened.keys()}
                return {name: opened.get_tensor(name) for name in opened.keys()}
        except Exception as error:  # whatever a damaged file leads to
            raise ValueError(f"'{file}' is truncated or not a safetensors file ({reason(error)}): copy it "
                             "again") from error
    content = read_torch(file)
    if isinstance(content, dict) and "phydict" in content:
        raise ValueError(f"'{file}' is a checkpoint of phydict's training: make it a prior with train.py export")
    if not isinstance(content, dict) or not all(isinstance(value, Tensor) for value in content.values()):
        raise ValueError(f"'{file}' holds no dictionary of tensors alone: give a model file of MedSyn's, such as "
                         f"{' or '.join(FILES['ema'])}")
    return content
