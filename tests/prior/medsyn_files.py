"""MedSyn's networks at reduced width, with random weights, and files of them as accelerate writes them."""

from __future__ import annotations

from pathlib import Path

import torch
from safetensors.torch import save_file
from torch import Tensor

from phydict.prior.medsyn import SliceUNet, SuperResolutionUNet, TextUNet

SMALL = {"width": 8, "multipliers": (1, 2), "heads": 1}


def text_unet(seed: int = 0, **settings) -> TextUNet:
    return _random(TextUNet(**SMALL | {"tokens": 6, "context_dim": 16} | settings), seed)


def super_resolution_unet(seed: int = 0, **settings) -> SuperResolutionUNet:
    return _random(SuperResolutionUNet(**SMALL | settings), seed)


def _random(network: SliceUNet, seed: int) -> SliceUNet:
    draw = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for weight in network.parameters():  # gains and biases too, so that none can be mistaken for another
            noise = torch.randn(weight.shape, generator=draw)
            weight.copy_(noise / weight[0].numel()**0.5 if weight.ndim > 1 else weight + 0.1 * noise)
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
