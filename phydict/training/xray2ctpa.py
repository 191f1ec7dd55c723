"""Training of X-ray2CTPA: its autoencoder first, then the diffusion of its latents."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import cast

import torch
from safetensors.torch import load_file
from torch import Tensor, nn
from torch.nn.functional import l1_loss

from phydict.diffusion import noise_like
from phydict.grid import Cube
from phydict.prior.stage_file import unlike
from phydict.rivals import Rival, XrayToCTPANetwork
from phydict.rivals.rival import WATER_MM, bound_orbit
from phydict.runtime.reading import refusing
from phydict.training.rivals import OrbitScenes, RivalTraining
from phydict.training.settings import Optimisation
from phydict.units import HUWindow
from phydict.xray import ConeBeam

FORGOTTEN = 0.01
"""By which share a new case moves the size of the latents."""

SETTLING = 100
"""Steps of a new diffusion, from its first on, in which larger latents still raise their size."""


@dataclass(frozen=True)
class LatentSettings:
    """The parts around the diffusion.

    Args:
        autoencoder_steps: of the training, the first, in which the autoencoder learns and nothing else; none where
            model.initial knows X-rays, whose diffusion is that of its autoencoder's latents
        slices: of a case, that each of them takes
        kl_weight: of the latents' divergence from a normal distribution beside the mean absolute error
        autoencoder: a .safetensors file of weights of MONAI's AutoencoderKL of the network's slice_channels, to begin
            with; with autoencoder_steps 0 they are kept
        encoder: a .safetensors file of weights of the network's XrayEmbedding, to begin with
    """

    autoencoder_steps: int = 4000
    slices: int = 8
    kl_weight: float = 1e-6
    autoencoder: str | None = None
    encoder: str | None = None

    def __post_init__(self):
        if self.autoencoder_steps < 0 or self.slices < 1 or not 0 <= self.kl_weight < 1:
            raise ValueError("model.latent has autoencoder_steps of 0 or more, slices of 1 or more and a kl_weight in "
                             f"[0, 1), but {self.autoencoder_steps}, {self.slices} and {self.kl_weight} were given")


class XrayToCTPATraining(RivalTraining):
    """Learns an XrayToCTPANetwork: mean absolute error of slices, then of the velocity of their latents.

    Args:
        network: the network; none given: that of initial, else the default XrayToCTPANetwork
        scenes: the X-rays, of one geometry
        cube: of voxels
        window: HU that the range [-1, 1] stands for
        optimisation: how the weights are learnt
        latent: the autoencoder's training, and weights of one's own
        initial: a rival's file to continue from
        seed: of noise, slices and times
    """

    def __init__(self, network: XrayToCTPANetwork | None = None, scenes: OrbitScenes = OrbitScenes(),
                 cube: Cube = Cube(), window: tuple[float, float] = (-1000.0, 1000.0),
                 optimisation: Optimisation = Optimisation(1e-4), latent: LatentSettings = LatentSettings(),
                 initial: str | None = None, seed: int = 0):
        if initial and (files := [part for part in ("autoencoder", "encoder") if getattr(latent, part)]):
            raise ValueError(f"model.initial brings all of its weights, but model.latent.{files[0]} was given beside "
                             "it: leave one of the two out")
        if not (initial or latent.autoencoder or latent.autoencoder_steps):
            raise ValueError("model.latent.autoencoder_steps is 0, but no autoencoder that has learnt was given: give "
                             "model.latent.autoencoder or model.initial, or some steps")
        given, network, grid = network is not None, network or XrayToCTPANetwork(), cube.grid()
        for part in ("autoencoder", "encoder"):
            if file := getattr(latent, part):
                _load_own(getattr(network, part), file, f"model.latent.{part}")
        made = Rival(network, grid, HUWindow(*window), bound_orbit(grid, scenes.views, scenes.arc_degrees))
        super().__init__(made, scenes, (scenes.views,), optimisation, initial, seed, given)
        self.latent = replace(latent, autoencoder_steps=0) if initial and self.network.knows_xrays else latent
        self.settles = not (self.network.knows_xrays and self.network.latent_size)

    @property
    def network(self) -> XrayToCTPANetwork:
        return cast(XrayToCTPANetwork, self.prior.network)

    @property
    def learns_slices(self) -> bool:
        """Whether the autoencoder is being learnt, before the diffusion."""
        return self.global_step < self.latent.autoencoder_steps

    def case_loss(self, ct: Tensor, water: Tensor, beam: ConeBeam, generator: torch.Generator) -> Tensor:
        if self.learns_slices:
            return self._slices_loss(ct, generator)
        network, y = self.network, water / WATER_MM
        with torch.no_grad():
            latent, size = network.latent(ct).float(), network.latent_size
            if self.settles and self.global_step - self.latent.autoencoder_steps < SETTLING:
                sizes = torch.cummax(torch.cat([size[None], self._everywhere(latent.abs().max())]), 0).values
                network.latent_size.copy_(sizes[-1])
                size = sizes[self.global_rank + 1]
            x0 = (latent / size).clamp(-1, 1)
        noise, t = noise_like(x0, generator), torch.rand(1, generator=generator).to(x0)
        signal, sigma = (scale.view(-1, 1, 1, 1, 1) for scale in network.schedule.scales(t))
        directions, _ = network.geometry(self.prior.grid, beam, y)
        velocity = network(signal * x0 + sigma * noise, t, y, directions).float()
        return l1_loss(velocity, signal * noise - sigma * x0)

    def _slices_loss(self, ct: Tensor, generator: torch.Generator) -> Tensor:
        network = self.network
        chosen = torch.randperm(ct.shape[-1], generator=generator)[:self.latent.slices]
        slices = ct[0, :, :, :, chosen.to(ct.device)].permute(3, 0, 1, 2)
        mean, std = (part.float() for part in network.autoencoder.encode(slices))
        with torch.no_grad():
            for size in self._everywhere(mean.abs().max()):
                network.latent_size.lerp_(size, FORGOTTEN if network.latent_size else 1.0)
        divergence = (mean.square() + std.square() - 1 - 2 * std.clamp(min=1e-12).log()).mean() / 2
        again = network.autoencoder.decode(mean + std * noise_like(mean, generator))
        return l1_loss(again.float(), slices) + self.latent.kl_weight * divergence

    def _everywhere(self, size: Tensor) -> Tensor:
        """The size of this process's case and of those that the others have at once, (n,), in their turns."""
        return self.all_gather(size).reshape(-1) if self._trainer else size[None]  # type: ignore[union-attr]

    def on_load_checkpoint(self, checkpoint: dict) -> None:
        super().on_load_checkpoint(checkpoint)
        knows = bool(checkpoint["state_dict"]["prior.network.denoiser.leave.weight"].any())
        if knows and checkpoint["global_step"] < self.latent.autoencoder_steps:  # of a run with a model.initial
            self.latent, self.settles = replace(self.latent, autoencoder_steps=0), False

    def validation_step(self, batch: dict, index: int) -> None:
        if self.network.knows_xrays:
            super().validation_step(batch, index)


def _load_own(part: nn.Module, file: str, option: str) -> None:
    """Gives a part of a network the weights of a user's file. Raises ValueError where they are not its own."""
    if not Path(file).is_file():
        raise ValueError(f"there is no file {file}: give another {option}, a .safetensors file of weights")
    with refusing(file, f"give another {option}"):
        given = load_file(file)
        if wrong := unlike(given, part.state_dict()):
            raise ValueError(f"{file} does not hold the weights of this {type(part).__name__} ({len(wrong)} are "
                             f"missing, unexpected or of another shape, such as {min(wrong)}): give another "
                             f"{option}, or the network's settings that it was trained with")
        part.load_state_dict(given)
