"""A prior small enough for tests, whose network answers to its state, time and text although it is untrained."""

from __future__ import annotations

import json
from pathlib import Path

import torch
from transformers import BertConfig, BertForMaskedLM

from phydict.grid import Grid
from phydict.methods import METHODS
from phydict.posterior import Sampler
from phydict.prior import (
    CorrectionNetwork,
    DetailNetwork,
    LocalUNet,
    Prior,
    Refiner,
    SuperResolution,
    TextEncoder,
    VolumeUNet,
    learn_vocabulary,
)
from phydict.prior.finer_uncertainty import FinerUncertainty
from phydict.prior.uncertainty import Uncertainty
from phydict.reconstruction import Reconstructor
from phydict.units import HUWindow

REPORTS = ["Small nodule in the left upper lobe.", "No focal consolidation; cardiomegaly.",
           "Pleural effusion (right), 12 mm."]


def tiny_prior(text: bool = True, voxels: int = 16, seed: int = 0, detail: bool = False) -> Prior:
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        network = VolumeUNet(4, 2, (16, 16), (False, True), 1, 8, 16)
        for weight in network.parameters():  # layers that start at zero would let nothing show
            if weight.ndim > 1 and not weight.any():
                torch.nn.init.normal_(weight, std=0.3)
        details = DetailNetwork(4, 8, 1) if detail else None
        if detail:
            torch.nn.init.normal_(details.leave.weight, std=0.05)
        encoder = TextEncoder.small(learn_vocabulary(REPORTS), 16, 1, 24) if text else None
        prior = Prior(network, Grid.cube(voxels), HUWindow(-1000, 600), encoder, detail=details)
        torch.nn.init.normal_(prior.null)
    return prior.eval().requires_grad_(False)


def tiny_refiner(text: bool = True, voxels: int = 16, seed: int = 0, untrained: bool = False,
                 uncertain: bool = False, begins: bool = False) -> Refiner:
    """A refiner of `tiny_prior`, whose entrances and gate answer to the evidence unless it is to be untrained.

    begins: with another such prior to begin with.
    """
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        refiner = Refiner(tiny_prior(text, voxels, seed, True), 0.3 * torch.randn(4, voxels, voxels, voxels))
        for layer in (refiner.entrance, refiner.detail_entrance, refiner.gate[-1]):
            if not untrained:
                torch.nn.init.normal_(layer.weight, std=0.2)
        refiner.uncertainty = Uncertainty(4, (4, 8)) if uncertain else None
        if begins:
            refiner.begin_with(tiny_prior(text, voxels, seed + 1, True))
    return refiner.eval().requires_grad_(False)


def tiny_correction(grid: Grid = Grid.cube(32), trained: bool = True, uncertain: bool = False) -> CorrectionNetwork:
    """What corrects estimates on a grid's voxels, none of them unless `trained`; uncertain: it knows intervals."""
    with torch.random.fork_rng():
        torch.manual_seed(0)
        made = CorrectionNetwork((4, 8), 4, grid, HUWindow(-1000, 600))
        if trained:
            torch.nn.init.normal_(made.leave.weight, std=0.1)
        made.uncertainty = FinerUncertainty((4, 8)) if uncertain else None
    return made.eval().requires_grad_(False)


def tiny_for(method: str | Sampler | Reconstructor, **settings) -> Prior | Refiner:
    """What a method needs: a `tiny_refiner`, else a `tiny_prior`."""
    method = METHODS[method] if isinstance(method, str) else method
    return tiny_refiner(**settings) if getattr(method, "needs_refiner", False) else tiny_prior(**settings)


def tiny_super_resolution(voxels: int = 32, factor: int = 2, seed: int = 0, **settings) -> SuperResolution:
    """A super-resolution stage for `tiny_prior`, untrained, whose network answers to all that it is told."""
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        network = LocalUNet(2, 1, 2, (8, 8))
        for weight in network.parameters():
            if weight.ndim > 1 and not weight.any():
                torch.nn.init.normal_(weight, std=0.1)
        fine = SuperResolution(network, Grid.cube(voxels), HUWindow(-1000, 600), factor, **settings)
    return fine.eval().requires_grad_(False)


def write_cxr_bert(folder: Path, positions: int = 64, told_positions: int = 64, seed: int = 0) -> BertForMaskedLM:
    """Writes files laid out as CXR-BERT's, with random weights, and returns the model that they hold.

    positions: rows of the table in pytorch_model.bin; told_positions: what config.json says. (MedSyn's language model
    has 2048 rows, and CXR-BERT's config.json, which its users put beside it, says 512.)
    """
    words = learn_vocabulary(REPORTS)
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        model = BertForMaskedLM(BertConfig(
            vocab_size=len(words), hidden_size=16, num_hidden_layers=2, num_attention_heads=4, intermediate_size=32,
            max_position_embeddings=positions, hidden_dropout_prob=0.25, attention_probs_dropout_prob=0.25)).eval()
        for name, weight in model.named_parameters():  # of a trained model's size, so that every word shows
            if weight.ndim > 1 or name.endswith("bias"):
                torch.nn.init.normal_(weight, std=0.4)
        heads = {f"cls_projection_head.{name}.weight": torch.randn(8, 8)
                 for name in ("dense_to_hidden", "dense_to_output")}
    weights = model.state_dict() | {"bert.embeddings.position_ids": torch.arange(positions)[None]} | heads
    folder.mkdir(parents=True, exist_ok=True)
    torch.save(weights, folder / "pytorch_model.bin")
    config = model.config.to_dict() | {
        "model_type": "cxr-bert", "architectures": ["CXRBertModel"], "projection_size": 8,
        "max_position_embeddings": told_positions, "auto_map": {"AutoModel": "modeling_cxrbert.CXRBertModel"}}
    (folder / "config.json").write_text(json.dumps(config))
    (folder / "modeling_cxrbert.py").write_text("raise SystemExit('code that came with weights was run')\n")
    (folder / "vocab.txt").write_text("\n".join(words) + "\n")
    (folder / "tokenizer_config.json").write_text(json.dumps({
        "do_lower_case": True, "model_max_length": told_positions, "tokenizer_class": "CXRBertTokenizer",
        "auto_map": {"AutoTokenizer": ["modeling_cxrbert.CXRBertTokenizer", None]}}))
    return model
