"""A prior small enough for tests, whose network answers to its state, time and text although it is untrained."""

from __future__ import annotations

import torch

from phydict.grid import Grid
from phydict.prior import LocalUNet, Prior, SuperResolution, TextEncoder, VolumeUNet, learn_vocabulary
from phydict.units import HUWindow

REPORTS = ["Small nodule in the left upper lobe.", "No focal consolidation; cardiomegaly.",
           "Pleural effusion (right), 12 mm."]


def tiny_prior(text: bool = True, voxels: int = 16, seed: int = 0) -> Prior:
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        network = VolumeUNet(4, 2, (16, 16), (False, True), 1, 8, 16)
        for weight in network.parameters():  # layers that start at zero would let nothing show
            if weight.ndim > 1 and not weight.any():
                torch.nn.init.normal_(weight, std=0.3)
        encoder = TextEncoder.small(learn_vocabulary(REPORTS), 16, 1, 24) if text else None
        prior = Prior(network, Grid.cube(voxels), HUWindow(-1000, 600), encoder)
        torch.nn.init.normal_(prior.null)
    return prior.eval().requires_grad_(False)


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
