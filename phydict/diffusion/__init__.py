"""The mathematics of diffusion: schedule, moves, denoisers. Knows no CT and no X-rays."""

from phydict.diffusion.denoiser import Denoiser, GaussianDenoiser, guided
from phydict.diffusion.schedule import CosineSchedule
from phydict.diffusion.steps import ddim, noise_in, renoise

__all__ = ["CosineSchedule", "Denoiser", "GaussianDenoiser", "ddim", "guided", "noise_in", "renoise"]
