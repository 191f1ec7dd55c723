"""Two commands about files: checkpoint to prior, and what a file is."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from phydict.prior import Prior, Refiner
from phydict.prior.files import (
    build_correction,
    build_prior,
    build_refiner,
    build_super_resolution,
    save_prior,
    save_refiner,
)
from phydict.prior.inspection import inspect_prior
from phydict.prior.stage_file import STAGES, is_saved_prior, save_stage
from phydict.prior.text_file import build_text, has_text
from phydict.rivals import NETWORKS, build_rival
from phydict.runtime.console import check_writable
from phydict.runtime.progress_log import log_progress
from phydict.training.checkpoints import check_calibrated, read_checkpoint

BUILT: dict[str, tuple[Callable, Callable]] = {
    "base": (build_prior, save_prior), "refiner": (build_refiner, save_refiner),
    "super_resolution": (build_super_resolution, save_stage), "refinement": (build_correction, save_stage),
    **dict.fromkeys(NETWORKS, (build_rival, save_stage))}
"""What builds a stage of header and weights, and what writes its file."""


def export_prior(checkpoint: str, out: str, overwrite: bool = False) -> None:
    """Write the averaged weights of a training checkpoint as a prior, a further stage or a rival, for reconstruction.

    Args:
        checkpoint: the .ckpt file that training wrote
        out: the .safetensors file to write
        overwrite: whether a prior or stage that is there already is replaced
    """
    if Path(out).suffix != ".safetensors":
        raise ValueError(f"a prior is a .safetensors file, but {out} was given: give a name with that ending")
    check_writable(Path(out), "--out", file=True)
    if Path(out).exists() and not is_saved_prior(out):
        raise ValueError(f"{out} is there already, is no prior of phydict's, and is not replaced: give another --out")
    if Path(out).exists() and not overwrite:
        raise ValueError(f"{out} is a prior already: add --overwrite true to replace it, or give another --out")
    content = read_checkpoint(checkpoint)
    check_calibrated(content, checkpoint)
    header = content["phydict"]
    stage, steps = header.get("stage", "base"), content.get("global_step")
    log_progress(f"export: stage {stage} after {steps} steps, to {out}", event="begin", name="export", stage=stage,
                 steps=steps, out=out)
    weights = {k.removeprefix("prior."): w for k, w in content["state_dict"].items() if k.startswith("prior.")}
    training = header.get("training", {"steps": steps})
    ids = next((part["held_out"] for part in content.values()  # of older checkpoints, whose headers tell nothing
                if isinstance(part, dict) and part.get("held_out") and part.get("trained", True)), None)
    if ids and isinstance(training, dict):
        training = {"held_out": ids} | training
    build, save = BUILT[stage]
    network = build(header, weights)
    if isinstance(network, Prior | Refiner) and has_text(header):
        weights = {k.removeprefix("prior.").removeprefix("first."): w for k, w in weights.items()}
        reader = network.reader if isinstance(network, Refiner) else network
        reader.text = build_text(header["text"], {k: w for k, w in weights.items() if k.startswith("text.")})
    save(network, out, training)
    print(f"{STAGES[stage].removeprefix('a ')} in {out}")


def print_prior(path: str) -> None:
    """Tell what a file or folder is: a prior, a checkpoint of its training, or one of MedSyn's networks, and whether
    it is whole.

    Args:
        path: the file or folder
    """
    for file, properties in inspect_prior(path).items():
        print(file, *(f"  {name}: {value}" for name, value in properties.items()), sep="\n")
