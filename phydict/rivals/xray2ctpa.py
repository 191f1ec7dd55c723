"""X-ray2CTPA for K views: diffusion of a CT's latent, conditioned on an embedding of the X-rays."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d

from phydict.diffusion import CosineSchedule, ddim, noise_like
from phydict.grid import Grid
from phydict.prior.convolution import speed_up
from phydict.prior.unet import check_sizes
from phydict.rivals.lifted import ResidualBlock
from phydict.rivals.network import Geometry, RivalNetwork
from phydict.rivals.slice_unet import SliceUNet
from phydict.xray import ConeBeam

LATENT = 4
"""Channels of the latent, as those of the published autoencoder."""


class XrayEmbedding(nn.Module):
    """X-rays and where their sources stand -> one vector: a small convolutional network of each view, their mean."""

    def __init__(self, channels: tuple[int, ...], width: int):
        super().__init__()
        self.down = nn.ModuleList(nn.Conv2d(a, b, 3, padding=1) for a, b in zip((1, *channels), channels))
        self.blocks = nn.ModuleList(ResidualBlock(c, 2) for c in channels)
        self.look, self.place = nn.Linear(16 * channels[-1], width), nn.Linear(3, width)
        self.leave = nn.Sequential(nn.SiLU(), nn.Linear(width, width))

    def forward(self, y: Tensor, directions: Tensor) -> Tensor:
        """X-rays (B, K, V, U), unit vectors to the sources (K, 3) -> (B, width)."""
        h = y.flatten(0, 1)[:, None]
        for down, block in zip(self.down, self.blocks):
            h = avg_pool2d(block(down(h)), 2, ceil_mode=True)
        embedding = self.look(nn.functional.adaptive_avg_pool2d(h, 4).flatten(1)).unflatten(0, y.shape[:2])
        return self.leave(embedding + self.place(directions)).mean(1)


class XrayToCTPANetwork(RivalNetwork):
    """X-ray2CTPA (Cahan et al. 2025, arXiv:2406.16109), from its paper, for K views.

    The CT's slices go through a variational autoencoder that shrinks them by four or so; a UNet over the stack of their
    latents tells its velocity, at all times of a cosine schedule, beside an embedding of the X-rays, and DDIM draws a
    stack, which is decoded.

    Not as published: an autoencoder trained on the same CTs in place of Stable Diffusion's, a small convolutional
    network in place of BiomedCLIP's image encoder, the mean over the views of their embeddings with their directions,
    DDIM in place of 1000 ancestral steps, the prior's HU window, no perceptual loss, no linear attention within slices,
    sinusoids in place of rotary positions, latents that their largest value scales in place of the least and largest of
    all CTs, one case at a step, and the velocity in place of the noise (Salimans and Ho 2022, arXiv:2202.00512): where
    next to nothing but noise is seen, the least error in it would be a stack of another CT.

    image_channels, embedding: widths of the X-rays' network and of its vector; slice_channels: of the autoencoder, one
    halving less than their number; channels: of the UNet; ddim_steps: of the sampler.
    """

    stage = "xray2ctpa"
    bound = True
    latent_size: Tensor

    def __init__(self, image_channels: tuple[int, ...] = (16, 32, 64, 64), embedding: int = 256,
                 slice_channels: tuple[int, ...] = (32, 64, 64), channels: tuple[int, ...] = (32, 64, 128),
                 ddim_steps: int = 50):
        from monai.networks.nets import AutoencoderKL

        super().__init__()
        check_sizes(image_channels=image_channels, embedding=embedding, slice_channels=slice_channels,
                    channels=channels, ddim_steps=ddim_steps)
        if any(width % 4 for width in (*slice_channels, *channels)):
            raise ValueError("the channels of an X-ray2CTPA network are multiples of 4, but slice_channels "
                             f"{slice_channels} and channels {channels} were given")
        self.settings = {"image_channels": list(image_channels), "embedding": embedding,
                         "slice_channels": list(slice_channels), "channels": list(channels), "ddim_steps": ddim_steps}
        self.shrink = 2 ** (len(slice_channels) - 1)
        self.divisor = self.shrink * 2 ** (len(channels) - 1)
        self.schedule, self.ddim_steps = CosineSchedule(), ddim_steps
        self.autoencoder = AutoencoderKL(
            2, 1, 1, num_res_blocks=(1,) * len(slice_channels), channels=tuple(slice_channels),
            attention_levels=(False,) * len(slice_channels), latent_channels=LATENT, norm_num_groups=4,
            with_encoder_nonlocal_attn=False, with_decoder_nonlocal_attn=False)
        self.encoder = XrayEmbedding(tuple(image_channels), embedding)
        self.denoiser = SliceUNet(LATENT, embedding, tuple(channels))
        self.register_buffer("latent_size", torch.zeros(()))  # brings latents to [-1, 1]; 0: not known
        speed_up(self)

    def geometry(self, grid: Grid, beam: ConeBeam, like: Tensor) -> Geometry:
        """Unit vectors (K, 3) towards the sources, and zeros (4, X', Y', Z) in the place of the latent."""
        towards = (beam.sources - grid.centre) @ (grid.affine[:3, :3] / grid.spacing)
        directions = torch.from_numpy(towards / np.linalg.norm(towards, axis=1, keepdims=True)).to(like)
        x, y, z = grid.shape
        return directions, torch.zeros(LATENT, x // self.shrink, y // self.shrink, z).to(like)

    def inputs(self, grid: Grid, beam: ConeBeam) -> tuple[Tensor, ...]:
        y = torch.zeros(1, beam.views, *beam.shape)
        directions, latent = self.geometry(grid, beam, y)
        return latent[None], torch.zeros(1), y, directions

    def latent(self, ct: Tensor) -> Tensor:
        """The latents (B, 4, X', Y', Z) of the slices of a CT (B, 1, X, Y, Z), before they are scaled."""
        slices = ct.permute(0, 4, 1, 2, 3)
        return self.autoencoder.encode(slices.flatten(0, 1))[0].unflatten(0, slices.shape[:2]).permute(0, 2, 3, 4, 1)

    def decoded(self, latent: Tensor) -> Tensor:
        """The CT of scaled latents."""
        slices = (latent * self.latent_size).permute(0, 4, 1, 2, 3)
        return self.autoencoder.decode(slices.flatten(0, 1)).unflatten(0, slices.shape[:2]).permute(0, 2, 3, 4, 1)

    @property
    def knows_xrays(self) -> bool:
        """Whether the diffusion has learnt anything: its last layer begins at zero."""
        return bool(self.denoiser.leave.weight.any())

    def forward(self, x: Tensor, t: Tensor, y: Tensor, directions: Tensor) -> Tensor:
        """The velocity of scaled latents x (B, 4, X', Y', Z) at times t (B,), given the X-rays y: signal times their
        noise less sigma times what they are without it."""
        return self.denoiser(x, t, self.encoder(y, directions))

    def steps(self) -> int:
        return self.ddim_steps

    def reconstruct(self, y: Tensor, geometry: Geometry, generator: torch.Generator,
                    on_step: Callable[[], None] = lambda: None) -> Tensor:
        if not self.knows_xrays:
            raise ValueError("this X-ray2CTPA network has learnt its autoencoder alone, nothing of X-rays: train it on "
                             "with model.initial, its file, and model.latent.autoencoder_steps 0")
        directions, latent = geometry
        condition = self.encoder(y, directions)
        x = noise_like(latent.expand(len(y), -1, -1, -1, -1), generator)
        for t, s in self.schedule.steps(self.ddim_steps):
            velocity = self.denoiser(x, torch.full((len(x),), t).to(y), condition).to(x)
            signal, sigma = (float(scale) for scale in self.schedule.scales(t))
            x0 = (signal * x - sigma * velocity).clamp(-1, 1)
            x = ddim(self.schedule, x0, x, t, s)
            on_step()
        return self.decoded(x0)
