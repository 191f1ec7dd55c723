"""Pixel-aligned features of the X-rays, lifted into the volume and decoded there: the feed-forward rival."""

from __future__ import annotations

from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d, interpolate

from phydict.grid import Grid
from phydict.prior.convolution import silence, speed_up
from phydict.prior.unet import check_sizes
from phydict.rivals.network import Geometry, RivalNetwork
from phydict.rivals.sampling import all_places, pooled, seen
from phydict.xray import ConeBeam
from phydict.xray.boxes import halved


class ResidualBlock(nn.Module):
    """x + two convolutions of the normalised x, in two or three dimensions."""

    def __init__(self, channels: int, dimensions: int):
        super().__init__()
        conv = {2: nn.Conv2d, 3: nn.Conv3d}[dimensions]
        self.first, self.second = (conv(channels, channels, 3, padding=1) for _ in range(2))
        self.norm = nn.GroupNorm(1, channels)
        silence(self.second)

    def forward(self, x: Tensor) -> Tensor:
        return x + self.second(nn.functional.silu(self.first(self.norm(x))))


class ImageEncoder(nn.Module):
    """Features of single X-rays: `fine` ones per pixel, `coarse` ones per 2^2 pixels, of a pyramid of `channels`."""

    def __init__(self, channels: tuple[int, ...], fine: int, coarse: int):
        super().__init__()
        self.down = nn.ModuleList(nn.Conv2d(a, b, 3, padding=1) for a, b in zip((1, *channels), channels))
        self.blocks = nn.ModuleList(ResidualBlock(c, 2) for c in channels)
        self.up = nn.ModuleList(nn.Conv2d(b, a, 1) for a, b in pairwise(channels))
        self.fine = nn.Conv2d(channels[0], fine, 3, padding=1)
        self.coarse = nn.Conv2d(channels[1], coarse, 3, padding=1)

    def forward(self, y: Tensor) -> tuple[Tensor, Tensor]:
        """X-rays (N, 1, V, U) -> (N, fine, V, U) and (N, coarse, ceil(V/2), ceil(U/2))."""
        levels, h = [], y
        for n, (down, block) in enumerate(zip(self.down, self.blocks)):
            h = block(down(h if n == 0 else avg_pool2d(h, 2, ceil_mode=True)))
            levels.append(h)
        for n in range(len(levels) - 2, -1, -1):
            below = interpolate(self.up[n](levels[n + 1]), scale_factor=2.0, mode="bilinear", align_corners=False)
            levels[n] = levels[n] + below[..., :levels[n].shape[-2], :levels[n].shape[-1]]
        return self.fine(levels[0]), self.coarse(levels[1])


class VolumeDecoder(nn.Module):
    """A UNet that takes what was lifted at full and at half resolution and answers with a CT."""

    def __init__(self, fine: int, coarse: int, channels: tuple[int, ...]):
        super().__init__()
        self.enter = nn.Conv3d(fine, channels[0], 3, padding=1)
        self.join = nn.Conv3d(channels[0] + coarse, channels[1], 3, padding=1)
        self.down = nn.ModuleList(nn.Conv3d(a, b, 2, stride=2) for a, b in pairwise(channels[1:]))
        self.shrink = nn.Conv3d(channels[0], channels[0], 2, stride=2)
        self.blocks = nn.ModuleList(ResidualBlock(c, 3) for c in channels)
        self.back = nn.ModuleList(ResidualBlock(c, 3) for c in channels[:-1])
        self.up = nn.ModuleList(nn.Conv3d(b, a, 1) for a, b in pairwise(channels))
        self.leave = nn.Conv3d(channels[0], 1, 3, padding=1)
        silence(self.leave)

    def forward(self, fine: Tensor, coarse: Tensor) -> Tensor:
        """(B, fine, X, Y, Z) and (B, coarse, X/2, Y/2, Z/2) -> (B, 1, X, Y, Z)."""
        levels = [self.blocks[0](self.enter(fine))]
        levels.append(self.blocks[1](self.join(torch.cat([self.shrink(levels[0]), coarse], 1))))
        for down, block in zip(self.down, self.blocks[2:]):
            levels.append(block(down(levels[-1])))
        h = levels.pop()
        for up, block in zip(reversed(self.up), reversed(self.back)):
            h = block(levels.pop() + interpolate(up(h), scale_factor=2.0, mode="nearest"))
        return self.leave(h)


class LiftedNetwork(RivalNetwork):
    """Each voxel reads every X-ray's features where it projects; their mean and maximum over the views enter a 3D UNet.

    After C2RV (Lin et al. 2024, arXiv:2406.03902) without its attention, and DIF-Net (Lin et al. 2023,
    arXiv:2303.06681), whose points are here the grid. The line integral itself is one of the features, so that the
    mean over the views is also an unfiltered back-projection; another channel says how many views see a voxel. Any
    number of views and any geometry.

    image_channels: width of each level of the encoder; fine, coarse: features per pixel and per 2^2 pixels; channels:
    width of each level of the decoder, at least three.
    """

    stage = "lifted"

    def __init__(self, image_channels: tuple[int, ...] = (16, 32, 64), fine: int = 6, coarse: int = 32,
                 channels: tuple[int, ...] = (16, 64, 96, 128)):
        super().__init__()
        check_sizes(image_channels=image_channels, fine=fine, coarse=coarse, channels=channels)
        if len(image_channels) < 2 or len(channels) < 3:
            raise ValueError("a lifted network has two levels of image_channels or more and three of channels or more, "
                             f"but {image_channels} and {channels} were given")
        self.settings = {"image_channels": list(image_channels), "fine": fine, "coarse": coarse,
                         "channels": list(channels)}
        self.divisor = 2 ** (len(channels) - 1)
        self.encoder = ImageEncoder(tuple(image_channels), fine, coarse)
        self.decoder = VolumeDecoder(2 * (fine + 1) + 1, 2 * coarse, tuple(channels))
        speed_up(self)

    def geometry(self, grid: Grid, beam: ConeBeam, like: Tensor) -> Geometry:
        return all_places(grid, beam, like), all_places(halved(grid), beam, like)

    def forward(self, y: Tensor, places: Tensor, half_places: Tensor) -> Tensor:
        fine, coarse = (h.unflatten(0, y.shape[:2]) for h in self.encoder(y.flatten(0, 1)[:, None]))
        pixels = (y.shape[2], y.shape[3])
        fine = pooled(torch.cat([y[:, :, None], fine.to(y)], 2), places, pixels)
        coarse = pooled(coarse, half_places, pixels, 2)
        count = torch.log2(1 + seen(places).sum(0)).expand(len(y), 1, -1, -1, -1)
        return self.decoder(torch.cat([*fine, count], 1), torch.cat(coarse, 1))
