"""The diffusion prior of CT: networks, report encoder, cascade, and their files with grid and HU window."""

from phydict.prior.cascade import Cascade
from phydict.prior.contract import AnyPrior, PriorContract, check_prior, find_prior, own_identity
from phydict.prior.correction import CorrectionNetwork
from phydict.prior.detail import DetailNetwork
from phydict.prior.files import (
    DEFAULT_CORRECTION,
    DEFAULT_PRIOR,
    DEFAULT_REFINER,
    FINEST_CORRECTION,
    file_read,
    fingerprint,
    is_refiner,
    load_correction,
    load_prior,
    load_super_resolution,
    save_prior,
    save_refiner,
)
from phydict.prior.inspection import inspect_prior
from phydict.prior.local_unet import LocalUNet
from phydict.prior.medsyn.checkpoint import MedSynCheckpoint
from phydict.prior.medsyn.prior import MedSynPrior
from phydict.prior.medsyn.super_resolution import MedSynSuperResolution
from phydict.prior.prior import STATE, BoundPrior, Prior
from phydict.prior.refiner import BoundRefiner, Refiner
from phydict.prior.stage_file import save_stage
from phydict.prior.super_resolution import SuperResolution
from phydict.prior.text import TextEncoder, learn_vocabulary
from phydict.prior.unet import VolumeUNet

__all__ = ["DEFAULT_CORRECTION", "DEFAULT_PRIOR", "DEFAULT_REFINER", "FINEST_CORRECTION", "STATE", "AnyPrior",
           "BoundPrior", "BoundRefiner", "Cascade", "CorrectionNetwork", "DetailNetwork", "LocalUNet",
           "MedSynCheckpoint", "MedSynPrior", "MedSynSuperResolution", "Prior", "PriorContract", "Refiner",
           "SuperResolution", "TextEncoder", "VolumeUNet", "check_prior", "file_read", "find_prior", "fingerprint",
           "inspect_prior", "is_refiner", "learn_vocabulary", "load_correction", "load_prior", "load_super_resolution",
           "own_identity", "save_prior", "save_refiner", "save_stage"]
