"""The reward of Eq. 5: how well a volume's projections agree with the measured X-rays.

| here            | paper                                             |
|-----------------|---------------------------------------------------|
| Reward()(m, x)  | -J(Y, x), J = (1/K) sum_k (|y_k - P_k(x)|^2 + LPIPS) |
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import torch
from torch import Tensor, nn

from phydict.posterior.measurement import Measurement


@dataclass(frozen=True)
class Reward:
    """-J(Y, x) per case: squared error per view plus `lpips` times the perceptual distance.

    lpips: weight of LPIPS; at 0 it is not loaded. backbone: alex, vgg or squeeze. random_backbone: use LPIPS with an
    untrained backbone, which needs no download; its figures mean nothing beside those of the trained one.
    """

    lpips: float = 0.0
    backbone: str = "vgg"
    random_backbone: bool = False

    def __call__(self, measurement: Measurement, x: Tensor) -> Tensor:
        """CTs x (B, 1, X, Y, Z) in the prior's range -> rewards (B,)."""
        projected = measurement.project(x)
        error = (projected - measurement.y).square().sum((-2, -1))
        if self.lpips:
            network = load_lpips(self.backbone, self.random_backbone).to(x.device)
            error = error + self.lpips * _lpips(network, projected, measurement.y)
        return -error.mean(1)


def _lpips(network: nn.Module, projected: Tensor, measured: Tensor) -> Tensor:
    """LPIPS per view (B, K); the measured views' range is mapped to the [-1, 1] that LPIPS expects."""
    low, high = measured.amin((-2, -1), keepdim=True), measured.amax((-2, -1), keepdim=True)
    scale = 2 / (high - low).clamp(min=1e-6)
    images = [((v - low) * scale - 1).flatten(0, 1)[:, None].expand(-1, 3, -1, -1)
              for v in (projected, measured.expand_as(projected))]
    return network(*images).view(projected.shape[:2])


@lru_cache(maxsize=2)
def load_lpips(backbone: str, random_backbone: bool) -> nn.Module:
    """LPIPS (Zhang et al. 2018, arXiv:1801.03924), frozen and in evaluation mode.

    Raises FileNotFoundError naming the file and the switch when the trained backbone is not there and cannot be
    downloaded.
    """
    files = {"alex": "alexnet-owt-7be5be79.pth", "vgg": "vgg16-397923af.pth", "squeeze": "squeezenet1_1-b8a52dc0.pth"}
    if backbone not in files:
        raise ValueError(f"LPIPS backbones are {', '.join(files)}, but '{backbone}' was given")
    import lpips

    try:
        with torch.random.fork_rng():  # an untrained backbone is the same in every process
            torch.manual_seed(0)
            network = lpips.LPIPS(net=backbone, pnet_rand=random_backbone, verbose=False)
    except OSError as error:
        raise FileNotFoundError(
            f"LPIPS needs the trained backbone {files[backbone]} in {torch.hub.get_dir()}/checkpoints and could not "
            "download it: put the file there, set the reward's lpips weight to 0, or set random_backbone: true"
        ) from error
    return network.eval().requires_grad_(False)
