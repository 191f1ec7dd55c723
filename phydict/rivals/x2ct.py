"""X2CT-GAN for K views: dense 2D encoders, lifted by three kinds of connections into a fused 3D decoder."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn.functional import conv2d, interpolate

from phydict.grid import Grid
from phydict.prior.convolution import channels_last, speed_up
from phydict.prior.unet import check_sizes
from phydict.rivals.network import Geometry, RivalNetwork
from phydict.rivals.planes import on_planes, plane_places, turned, turned_mean, turns
from phydict.xray import ConeBeam

BOTTOM = 4
"""Voxels along each side where the decoder begins."""

DROPOUT = 0.5


class DenseLayer(nn.Module):
    """Adds `growth` maps to its input, by way of four times as many (Huang et al. 2017, arXiv:1608.06993)."""

    def __init__(self, channels: int, growth: int):
        super().__init__()
        self.narrow = nn.Conv2d(channels, 4 * growth, 1, bias=False)
        self.grow = nn.Conv2d(4 * growth, growth, 3, padding=1, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        return torch.cat([x, self.grow(_normal(self.narrow(_normal(x))))], 1)


class Stage(nn.Sequential):
    """Half the size: a convolution of stride 2, a dense block and a convolution that halves the channels."""

    def __init__(self, channels: int, growth: int, layers: int):
        grown = channels + layers * growth
        super().__init__(nn.Conv2d(channels, channels, 3, 2, 1),
                         *(DenseLayer(channels + n * growth, growth) for n in range(layers)),
                         nn.Conv2d(grown, grown // 2, 1))
        self.out_channels = grown // 2


class ConnectionA(nn.Module):
    """The whole image, as one vector, spread over the first volume of the decoder."""

    def __init__(self, channels: int, out: int):
        super().__init__()
        self.linear, self.out = nn.Linear(channels, out * BOTTOM**3), out

    def forward(self, h: Tensor) -> Tensor:
        spread = nn.functional.dropout(self.linear(h.mean((-2, -1))).relu(), DROPOUT, self.training)
        return spread.view(-1, self.out, BOTTOM, BOTTOM, BOTTOM)


class ConnectionB(nn.Module):
    """A map of the encoder, repeated along the depth of its view."""

    def __init__(self, channels: int, out: int):
        super().__init__()
        self.flat, self.deep = nn.Conv2d(channels, out, 1), nn.Conv3d(out, out, 3, padding=1)

    def forward(self, h: Tensor) -> Tensor:
        flat, depth, weight = self.flat(h).relu(), h.shape[-1], self.deep.weight
        # What is repeated is the same at all depths but the first and the last, which see the padding.
        slices = torch.stack([conv2d(flat, weight[:, :, taps].sum(2), self.deep.bias, padding=1)
                              for taps in (slice(1, 3), slice(3), slice(2))], 2).float()
        repeats = slices.new_tensor([1, depth - 2, 1])[:, None, None] / depth / flat[0, 0].numel()
        slices = slices - (repeats * slices).sum((2, 3, 4), keepdim=True)
        slices = (slices * ((repeats * slices**2).sum((2, 3, 4), keepdim=True) + 1e-5).rsqrt()).relu().to(flat)
        first, inner, last = slices.split(1, 2)
        return torch.cat([first, inner.expand(-1, -1, depth - 2, -1, -1), last], 2)


class Join(nn.Module):
    """What came from below, doubled in size, and what is new at this size."""

    def __init__(self, below: int, new: int, out: int):
        super().__init__()
        self.first, self.second = nn.Conv3d(below + new, out, 3, padding=1), nn.Conv3d(out, out, 3, padding=1)

    def forward(self, below: Tensor, new: Tensor) -> Tensor:
        if below.shape[-1] < new.shape[-1]:
            below = interpolate(below, scale_factor=2.0, mode="nearest")
        return _normal(self.second(_normal(self.first(torch.cat([below, new.to(below)], 1)))))


class X2CTNetwork(RivalNetwork):
    """The generator of X2CT-GAN (Ying et al. 2019, doi:10.1109/CVPR.2019.01087), from its paper, for K views.

    A view's image, on the plane through the isocentre, goes through a dense encoder that all views share. Connection A
    makes the first volume of its whole, connection B adds its maps at every size, repeated along the view's depth.
    Connection C turns each view's volumes into the grid's frame and takes their mean, at every size, for a decoder of
    their own, whose end is a convolution of 7^3. As in the paper, the rays of a view are taken as parallel.

    Not as published: any number of views at any angle, one encoder and decoder for all of them, doublings in place of
    transposed convolutions, the mean is not fed back to the views; HU are those of the training's window in
    place of 0 to 2500 over -1000; it learns from one case at a step, against a smaller PatchGAN (two layers, 16
    channels).

    stem: channels of the first convolution; growth, blocks: maps that a dense
    layer adds, and layers of each stage; channels: of the volumes, from the full size to that of 4^3, one more than
    blocks. The grid is a cube of 4 * 2^len(blocks) voxels a side.
    """

    stage = "x2ct"
    bound = True

    def __init__(self, stem: int = 32, growth: int = 16, blocks: tuple[int, ...] = (3, 6, 12, 8),
                 channels: tuple[int, ...] = (8, 16, 32, 64, 64)):
        super().__init__()
        check_sizes(stem=stem, growth=growth, blocks=blocks, channels=channels)
        if len(channels) != len(blocks) + 1:
            raise ValueError("an X2CT network has one more of channels than of blocks, but "
                             f"{channels} and {blocks} were given")
        self.settings = {"stem": stem, "growth": growth, "blocks": list(blocks), "channels": list(channels)}
        self.side = BOTTOM * 2 ** len(blocks)
        self.enter, self.stages, widths = nn.Conv2d(1, stem, 7, padding=3), nn.ModuleList(), [stem]
        for layers in blocks:
            stage = Stage(widths[-1], growth, layers)
            self.stages.append(stage)
            widths.append(stage.out_channels)
        self.a = ConnectionA(widths[-1], channels[-1])
        self.b = nn.ModuleList(ConnectionB(width, out) for width, out in zip(widths, channels))
        below = [*channels[1:], channels[-1]]
        self.branch = nn.ModuleList(Join(under, out, out) for under, out in zip(below, channels))
        self.main = nn.ModuleList(Join(under, out, out) for under, out in zip(below, channels))
        self.leave = nn.Conv3d(channels[0], 1, 7, padding=3)
        for layer in self.modules():
            if isinstance(layer, nn.Conv2d | nn.Conv3d | nn.Linear):
                nn.init.normal_(layer.weight, std=0.02)
                if layer.bias is not None:
                    nn.init.zeros_(layer.bias)
        # The last ReLU lets gradients pass where the volume starts.
        nn.init.constant_(self.leave.get_parameter("bias"), 0.1)
        speed_up(self)
        channels_last(self)

    def check(self, grid: Grid) -> None:
        if set(grid.shape) != {self.side} or max(grid.spacing) - min(grid.spacing) > 1e-3 * min(grid.spacing):
            raise ValueError(f"this network is for a cube of {self.side} voxels a side, but the grid has {grid.shape} "
                             f"of {grid.spacing} mm: set model.cube.voxels, or other blocks of the network")

    def geometry(self, grid: Grid, beam: ConeBeam, like: Tensor) -> Geometry:
        return plane_places(grid, beam, like), turns(grid, beam, like)

    def lifted(self, y: Tensor, places: Tensor, theta: Tensor) -> Tensor:
        """The X-rays, each repeated along its view's depth: (B, K, X, Y, Z)."""
        images = on_planes(y, places)
        volumes = images[:, :, None, None].expand(-1, -1, 1, images.shape[-1], -1, -1)
        return turned(volumes, theta)[:, :, 0]

    def forward(self, y: Tensor, places: Tensor, theta: Tensor) -> Tensor:
        cases = y.shape[:2]
        h = self.enter(on_planes(y, places).flatten(0, 1)[:, None])
        maps = [h]
        for stage in self.stages:
            maps.append(stage(_normal(maps[-1])))
        view = self.a(maps[-1])
        main = turned_mean(view.unflatten(0, cases), theta)
        for n in range(len(maps) - 1, -1, -1):
            view = self.branch[n](view, self.b[n](maps[n]))
            main = self.main[n](main, turned_mean(view.unflatten(0, cases), theta))
        return 2 * self.leave(main).relu() - 1


def _normal(h: Tensor) -> Tensor:
    """Normalised over each map, without learnt scales, and rectified."""
    return nn.functional.instance_norm(h).relu()
