"""What a file is: a prior, a checkpoint of its training, or one of MedSyn's networks, and whether it is whole."""

from __future__ import annotations

import json
from pathlib import Path

from safetensors import safe_open
from torch import Tensor

from phydict.prior.finite import check_finite
from phydict.prior.medsyn.checkpoint import FILES, STAGES, MedSynWeights, default_kind, files_in, listed, read_tensors
from phydict.prior.medsyn.networks import TextUNet
from phydict.prior.stage_file import STAGES as KINDS
from phydict.prior.stage_file import header_of
from phydict.prior.tensors import read_torch
from phydict.runtime.reading import reason, refusing


def inspect_prior(path: str | Path) -> dict[str, dict[str, str]]:
    """What a file or folder is, as file -> {property: value}; nothing is run, and tensors are not kept.

    Kinds: priors and training checkpoints of phydict, MedSyn's two stages, and others, with the reason why they
    are none of these. Raises FileNotFoundError where nothing is there, and ValueError where weights are not finite.
    """
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"there is nothing at '{path}': give a prior's file, a checkpoint or MedSyn's folder")
    if path.is_file():
        return {str(path): _inspect_file(path)}
    held = files_in(path)
    chosen = default_kind(held)
    kinds = {str(file): {"by its name": kind + (", read by default" if kind == chosen else "")} | _inspect_file(file)
             for kind, file in held.items()}
    names = [name for both in FILES.values() for name in both]
    return kinds or {str(path): {"kind": f"unknown: the folder holds no {' or '.join(names)}, nor <N>_ckpt folders"}}


def _inspect_file(file: Path) -> dict[str, str]:
    try:
        if file.suffix == ".safetensors":
            entries = read_tensors(file, shapes_only=True)
            header: dict | None = header_of(file)
        else:
            content = read_torch(file)
            saved = content if isinstance(content, dict) else {}
            header = saved.get("phydict")
            entries = saved.get("state_dict", {}) if header else read_tensors(file)
        if header:
            report, used = _inspect_phydict(header, entries, file.suffix == ".safetensors"), [*entries]
        else:
            medsyn = MedSynWeights.sort(entries)
            report, used = _inspect_medsyn(medsyn, entries), [name for name in entries if name not in medsyn.ignored]
    except Exception as error:  # whatever a file that is none of these leads to
        return {"kind": "unknown: " + reason(error).removeprefix(f"'{file}' ")}
    with refusing(file, "copy it again"):
        if file.suffix != ".safetensors":
            check_finite({name: entries[name] for name in used}, file)
            return report
        with safe_open(file, "pt") as opened:
            for name in used:
                check_finite({name: opened.get_tensor(name)}, file)
    return report


def _inspect_phydict(header: dict, entries: dict[str, Tensor], finished: bool) -> dict[str, str]:
    text = header.get("text") or {}
    stage = str(header.get("stage", "base"))
    kind = KINDS.get(stage, "stage of another version").removeprefix("a ")
    checkpoint = f"training checkpoint of a {kind} (train.py export makes its file)"
    return {"kind": f"phydict {kind if finished else checkpoint}",
            "stage": stage,
            "grid": " x ".join(map(str, header.get("grid", {}).get("shape", "?"))),
            "HU window": " to ".join(f"{hu:g}" for hu in header.get("hu_window", ())),
            "text": text.get("source") or ("its own" if text else "none"),
            "parameters": f"{sum(tensor.numel() for tensor in entries.values()):,}",
            "training": json.dumps(header.get("training", {}))}


def _inspect_medsyn(medsyn: MedSynWeights, entries: dict[str, Tensor]) -> dict[str, str]:
    parameters = sum(weight.numel() for weight in medsyn.network.parameters())
    report = {"kind": f"MedSyn's {STAGES[medsyn.stage]}", "width": " ".join(map(str, medsyn.network.widths)),
              "parameters": f"{parameters:,}", "entries": str(len(entries)),
              "prefix": next(iter(entries)).partition("denoise_fn.")[0] + "denoise_fn."
              if any("denoise_fn." in name for name in entries) else "none"}
    if medsyn.stage == 1:
        report["names of the shared self-attention"] = f"{medsyn.tied} of {2 * TextUNet.REPEATS}"
    if medsyn.ignored:
        report["ignored"] = f"{len(medsyn.ignored)} ({listed(medsyn.ignored)})"
    return report | {"fits": f"no: {medsyn.misfits}" if medsyn.misfits else "yes"}
