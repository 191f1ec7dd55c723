"""LPIPS, the perceptual distance of two images (Zhang et al. 2018, arXiv:1801.03924), by the package lpips."""

from __future__ import annotations

import re
import warnings
from functools import lru_cache

import torch
from torch import Tensor, nn

from phydict.runtime.reading import reason

FILES = {"alex": "alexnet-owt-7be5be79.pth", "vgg": "vgg16-397923af.pth", "squeeze": "squeezenet1_1-b8a52dc0.pth"}
"""Backbone -> the file of its trained weights, torchvision's."""

OF_A_REWARD = ("set the reward's lpips weight to 0 (--model.method.init_args.likelihood.init_args.reward.lpips 0), or "
               "set random_backbone: true")


@lru_cache(maxsize=4)
def load_lpips(backbone: str, random_backbone: bool, otherwise: str = OF_A_REWARD, needing: str = "LPIPS") -> nn.Module:
    """LPIPS, frozen and in evaluation mode.

    Raises FileNotFoundError naming the file, what is `needing` it and what can be done `otherwise` when the trained
    backbone is not there and cannot be downloaded, and ValueError for an unknown backbone or a damaged file.
    """
    if backbone not in FILES:
        raise ValueError(f"LPIPS backbones are {', '.join(FILES)}, but '{backbone}' was given")
    import lpips

    try:
        with torch.random.fork_rng(), warnings.catch_warnings():
            warnings.filterwarnings("ignore", module="torchvision")  # of whose older interface lpips makes use
            torch.manual_seed(0)  # an untrained backbone is the same in every process
            network = lpips.LPIPS(net=backbone, pnet_rand=random_backbone, verbose=False)
    except OSError as error:
        raise FileNotFoundError(
            f"{needing} needs the trained backbone {FILES[backbone]} in {torch.hub.get_dir()}/checkpoints and could "
            f"not download it: put the file there, or {otherwise}") from error
    except Exception as error:  # whatever a damaged file leads to
        raise ValueError(f"{torch.hub.get_dir()}/checkpoints/{FILES[backbone]} cannot be read as the trained backbone "
                         f"that {needing} needs ({reason(error)}): put the file of torchvision there, or {otherwise}"
                         ) from error
    return network.eval().requires_grad_(False)


def lpips_distances(network: nn.Module, images: Tensor, others: Tensor, otherwise: str) -> Tensor:
    """LPIPS (N,) of grey images (N, H, W), each and its other, in [-1, 1].

    Raises ValueError, saying what can be done `otherwise`, where they are too small for the backbone.
    """
    try:
        return network(*(v[:, None].expand(-1, 3, -1, -1) for v in (images, others))).flatten()
    except RuntimeError as error:
        if not re.search("Output size is too small|Kernel size can't be greater", str(error)):
            raise
        raise ValueError(f"images of {images.shape[1]} x {images.shape[2]} pixels are too small for LPIPS' "
                         f"{network.pnet_type}: {otherwise}") from error
