"""The mathematics of diffusion: schedule, moves, denoisers. Knows no CT and no X-rays."""

from phydict.diffusion.denoiser import Denoiser, GaussianDenoiser, guided
from phydict.diffusion.schedule import CosineSchedule
from phydict.diffusion.steps import Generators, ddim, noise_in, noise_like, renoise

__all__ = ["CosineSchedule", "Denoiser", "GaussianDenoiser", "Generators", "ddim", "guided", "noise_in", "noise_like",
           "renoise"]
