"""MedSyn's networks at reduced width, with random weights, and files of them as accelerate writes them."""

from __future__ import annotations

from pathlib import Path

import torch
from safetensors.torch import save_file
from torch import Tensor

from phydict.prior.medsyn.networks import SliceUNet, SuperResolutionUNet, TextUNet

SMALL = {"width": 8, "multipliers": (1, 2), "heads": 1}


def text_unet(seed: int = 0, **settings) -> TextUNet:
    return _random(TextUNet, seed, {"tokens": 6, "context_dim": 16} | settings)


def super_resolution_unet(seed: int = 0, **settings) -> SuperResolutionUNet:
    return _random(SuperResolutionUNet, seed, settings)


def _random(kind: type[SliceUNet], seed: int, settings: dict) -> SliceUNet:
    with torch.random.fork_rng(), torch.no_grad():
        torch.manual_seed(seed)
        network = kind(**SMALL | settings)
        for weight in network.parameters():  # gains too, so that none can be mistaken for another
            weight.add_(0.1 * torch.randn(weight.shape))
    return network.eval().requires_grad_(False)


def entries(network: SliceUNet, prefix: str = "denoise_fn.") -> dict[str, Tensor]:
    """A checkpoint's names and tensors, tied ones under every name."""
    return {prefix + name: weight for name, weight in network.state_dict().items()}


def write(file: Path, tensors: dict[str, Tensor]) -> Path:
    """A checkpoint file; safetensors keep one name of a tensor that has several."""
    file.parent.mkdir(parents=True, exist_ok=True)
    if file.suffix != ".safetensors":
        torch.save(tensors, file)
        return file
    seen: dict[int, str] = {}
    for name, tensor in tensors.items():
        seen.setdefault(tensor.data_ptr(), name)
    save_file({name: tensors[name].contiguous() for name in seen.values()}, file, {"format": "pt"})
    return file
