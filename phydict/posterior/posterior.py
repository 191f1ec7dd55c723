"""Prior times reward, sampled: the reconstruction method of the paper and its relatives."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import torch
from torch import Tensor

from phydict.diffusion import Denoiser
from phydict.grid import Grid
from phydict.posterior.measurement import Measurement
from phydict.posterior.sampler import Sampler
from phydict.posterior.split_gibbs import SplitGibbs, noise_like
from phydict.prior import Prior
from phydict.reconstructor import Reconstruction, Reconstructor, Stopwatch, misfits
from phydict.units import MU_WATER
from phydict.xray import Projector


class Counted:
    """A denoiser that counts its calls."""

    def __init__(self, denoiser: Denoiser):
        self.schedule, self._denoiser, self.calls = denoiser.schedule, denoiser, 0

    def denoise(self, x: Tensor, t: float) -> Tensor:
        self.calls += 1
        return self._denoiser.denoise(x, t)


@dataclass(frozen=True)
class Posterior(Reconstructor):
    """Reconstructs by sampling p(x | Y, report) under a prior.

    sampler: how; guidance: classifier-free guidance scale used when a report is given; mu_water: 1/mm;
    bf16: run the denoiser in bfloat16, which on most processors is twice as fast.
    """

    prior: Prior
    sampler: Sampler = field(default_factory=SplitGibbs)
    guidance: float = 1.0
    mu_water: float = MU_WATER
    name: str = "phydict"
    bf16: bool = True

    @property
    def grid(self) -> Grid:
        """Where the reconstructed volumes live."""
        return self.prior.grid

    @property
    def full_detector(self) -> bool:
        return self.sampler.full_detector

    @property
    def citation(self) -> str:
        return self.sampler.citation

    def steps(self) -> int:
        return self.sampler.steps()

    @torch.no_grad()
    def reconstruct(self, xrays: Tensor, projector: Projector, report: str = "", display: bool = False,
                    seed: int = 0, on_step: Callable[[], None] = lambda: None) -> Reconstruction:
        prior, watch = self.prior, Stopwatch()
        if not prior.grid.same_as(projector.grid):
            raise ValueError(
                f"the prior was trained on {prior.grid.shape} voxels of {prior.grid.spacing} mm, but the X-rays are "
                f"projected from {projector.grid.shape} voxels of {projector.grid.spacing} mm: use the prior's grid")
        with watch.stage("prepare"):
            denoiser = Counted(prior.bind(report, self.guidance, self.bf16))
            measurement = Measurement(projector, xrays, prior.window, display, self.mu_water)
            draw = torch.Generator().manual_seed(seed)
            state = torch.empty(1, prior.state_channels, *prior.grid.shape, device=xrays.device)
            x = noise_like(state, draw)
        with watch.stage("sample"):
            state = self.sampler.sample(denoiser, measurement, x, draw, on_step)
        with watch.stage("score"):
            ct = state[:, :1]
            measurement.calibrate(ct)
            reprojection = measurement.project(ct)[0].cpu()
            measured = measurement.y[0].cpu()
        return Reconstruction(
            volume=prior.window.to_hu(ct[0, 0]).cpu(), grid=prior.grid, method=self.name, seed=seed,
            **misfits(reprojection, measured), seconds=watch.seconds, xrays=measured, reprojection=reprojection,
            network_calls=denoiser.calls * (2 if report and self.guidance != 1 else 1),
            projector_calls=measurement.calls, masks=((state[0, 1:] + 1) / 2).cpu())
