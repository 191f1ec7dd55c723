"""Networks whose features of slices the Frechet distance compares, each with a scale of its own.

    radimagenet  ResNet50 of RadImageNet (Mei et al. 2022, doi:10.1148/ryai.210315), 2048 features; the weights are
                 MONAI/checkpoints' RadImageNet-ResNet50_notop.pth on Hugging Face, which MAISI's script uses
    inception    torchvision's Inception v3, 2048 features before its classifier, slices enlarged to 299 x 299; the
                 weights are torchvision's inception_v3_google-0cc3c7bd.pth, not those of the original FID
    squeezenet   SqueezeNet 1.1 as in LPIPS, 512 features, found where torch.hub keeps its files

The features are spatial means of the last map. Slices are normalised as in MAISI's script (compute_fid_2-5d_ct.py):
HU clipped to [-1000, 1000], the volume's own least and largest value mapped to 0 and 1, so that a wrong HU scale or
offset is not seen, then less RadImageNet's means of blue, green and red. Its voxels, on which alone a figure may stand
beside the script's, are `maisi_voxels`.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.nn.functional import interpolate

from phydict.evaluation.metrics import RANGE
from phydict.evaluation.planes import slices
from phydict.grid import Grid
from phydict.prior.finite import check_finite
from phydict.prior.tensors import read_torch
from phydict.runtime.lpips_networks import load_lpips
from phydict.xray.boxes import interpolated

DIMENSIONS = {"squeezenet": 512, "radimagenet": 2048, "inception": 2048}
FILES = {"radimagenet": "RadImageNet-ResNet50_notop.pth", "inception": "inception_v3_google-0cc3c7bd.pth"}
MEANS = (0.406, 0.456, 0.485)
NORMALISATION = (f"HU clipped to [{RANGE.low:g}, {RANGE.high:g}], each volume's least and largest value mapped to 0 "
                 "and 1")
"""Of the slices, before the means are taken off."""
MAISI_SIDE = 512
"""Voxels of 1 mm along each side of MAISI's volumes."""
BATCH = 16
LEAST_SIDE = 17
"""Pixels along each side of the smallest images that SqueezeNet takes."""


def maisi_voxels(hu: Tensor, grid: Grid) -> Tensor:
    """A volume (X, Y, Z) in HU on `grid` as MAISI's script takes it, when set to 1 mm and 512^3 voxels: voxels of 1 mm
    from the centre of its first one to that of its last one, of which the middle 512 are taken, or air put around."""
    sizes = [round((n - 1) * mm + 1) for n, mm in zip(grid.shape, grid.spacing)]
    first = [n // 2 - MAISI_SIDE // 2 if n > MAISI_SIDE else -((MAISI_SIDE - n) // 2) for n in sizes]
    affine = grid.affine.copy()
    affine[:3, :3] /= grid.spacing
    affine[:3, 3] += affine[:3, :3] @ first
    shown = interpolated(hu, grid, Grid((MAISI_SIDE,) * 3, affine=affine), RANGE.low)
    for axis, (n, start) in enumerate(zip(sizes, first)):
        along = shown.movedim(axis, 0)
        along[:max(0, -start)] = along[max(0, n - start):] = RANGE.low
    return shown


class SliceFeatures(nn.Module):
    """Features of a volume's slices by a backbone of DIMENSIONS, frozen and in evaluation mode.

    weights: the file of the backbone's weights, for all but squeezenet. Raises ValueError or FileNotFoundError, in one
    sentence, for an unknown name and for a file that is missing or another network's.
    """

    def __init__(self, name: str, weights: str | Path | None = None):
        super().__init__()
        if name not in DIMENSIONS:
            raise ValueError(f"fid.backbone is one of {', '.join(DIMENSIONS)}, but {name!r} was given")
        if (weights is None) != (name == "squeezenet"):
            raise ValueError(
                f"the FID backbone {name} needs its weights: give fid.weights the file {FILES[name]}, or fid.backbone "
                "squeezenet" if weights is None else
                f"the FID backbone squeezenet takes LPIPS' weights from {torch.hub.get_dir()}/checkpoints, but "
                f"fid.weights {weights} was given: leave it out")
        self.name, self.dimensions = name, DIMENSIONS[name]
        if weights is None:
            otherwise = "leave fid out of the metrics"
            self.network = load_lpips("squeeze", False, otherwise, "FID by squeezenet").get_submodule("net")
        else:
            self.network = _radimagenet() if name == "radimagenet" else _inception()
            _load(self.network, Path(weights), name)
        self.eval().requires_grad_(False)

    def check(self, shape: Sequence[int]) -> None:
        """Raises ValueError where the slices of volumes of a shape are too small for the backbone."""
        if self.name == "squeezenet" and min(shape) < LEAST_SIDE:
            raise ValueError(f"slices of {' x '.join(map(str, shape))} voxels are too small for the FID backbone "
                             f"squeezenet, which needs {LEAST_SIDE} along each side: give more voxels, or leave fid "
                             "out of the metrics")

    @torch.no_grad()
    def forward(self, hu: Tensor, plane: str) -> Tensor:
        """Features (N, d), float32 on the CPU, of the slices of a volume (X, Y, Z) in HU in one plane; raises as
        `check`."""
        self.check(hu.shape)
        volume = hu.float().clamp(RANGE.low, RANGE.high)
        low, high = volume.min(), volume.max()
        volume = (volume - low) / (high - low).clamp(min=1e-6)
        means = torch.tensor(MEANS, device=volume.device)[:, None, None]
        with torch.autocast(volume.device.type, enabled=False):
            return torch.cat([self._features(part[:, None] - means).cpu() for part in
                              slices(volume, plane).split(BATCH)])

    def _features(self, images: Tensor) -> Tensor:
        if self.name == "squeezenet":
            return self.network(images)[-1].mean((2, 3))
        if self.name == "inception":
            return self.network(interpolate(images, (299, 299), mode="bilinear", antialias=True))
        return self.network(images).flatten(1)


def _radimagenet() -> nn.Module:
    """ResNet50 as Keras builds it: convolutions with bias, strides in a block's first one, its own epsilon."""
    from torchvision.models import resnet50
    from torchvision.models.resnet import Bottleneck

    network = resnet50(weights=None)
    network.fc = nn.Identity()
    for module in list(network.modules()):
        if isinstance(module, Bottleneck):
            module.conv1.stride, module.conv2.stride = module.conv2.stride, (1, 1)
        if isinstance(module, nn.Conv2d):
            module.bias = nn.Parameter(torch.zeros(module.out_channels))
        if isinstance(module, nn.BatchNorm2d):
            module.eps = 1.001e-5
    return network


def _inception() -> nn.Module:
    from torchvision.models import inception_v3

    network = inception_v3(weights=None, aux_logits=False, init_weights=False)
    network.fc = nn.Identity()
    return network


def _load(network: nn.Module, file: Path, name: str) -> None:
    if not file.is_file():
        raise FileNotFoundError(f"there is no file {file} of the FID backbone {name}: give fid.weights the file "
                                f"{FILES[name]}")
    weights = read_torch(file)
    tensors = {key: value for key, value in weights.items() if isinstance(value, Tensor) and not key.startswith(
        ("fc.", "AuxLogits."))} if isinstance(weights, dict) else {}
    check_finite(tensors, file)
    wanted = network.state_dict()
    wrong = next((key for key, value in wanted.items() if not key.endswith("num_batches_tracked")
                  and (key not in tensors or tensors[key].shape != value.shape)), None)
    if wrong:
        raise ValueError(f"{file} does not hold the weights of the FID backbone {name} ({wrong} is missing or of "
                         f"another shape): give {FILES[name]}")
    network.load_state_dict(tensors, strict=False)
