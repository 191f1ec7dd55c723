"""The diffusion prior of CT: network, report encoder, and the file that keeps them with their grid and HU window."""

from phydict.prior.checkpoint import describe, load_prior, save_prior
from phydict.prior.prior import STATE, BoundPrior, Prior
from phydict.prior.text import TextEncoder, learn_vocabulary
from phydict.prior.unet import VolumeUNet

__all__ = ["STATE", "BoundPrior", "Prior", "TextEncoder", "VolumeUNet", "describe", "learn_vocabulary",
           "load_prior", "save_prior"]
