"""The diffusion prior of CT: network, report encoder, and the file that keeps them with their grid and HU window."""

from phydict.prior.checkpoint import describe, fingerprint, load_prior, save_prior
from phydict.prior.medsyn import MedSynPrior, MedSynSuperResolution
from phydict.prior.pretrained import MedSynCheckpoint, inspect_prior, load_medsyn_super_resolution
from phydict.prior.prior import STATE, BoundPrior, Prior
from phydict.prior.text import TextEncoder, learn_vocabulary
from phydict.prior.unet import VolumeUNet

__all__ = ["STATE", "BoundPrior", "MedSynCheckpoint", "MedSynPrior", "MedSynSuperResolution", "Prior", "TextEncoder",
           "VolumeUNet", "describe", "fingerprint", "inspect_prior", "learn_vocabulary", "load_medsyn_super_resolution",
           "load_prior", "save_prior"]
