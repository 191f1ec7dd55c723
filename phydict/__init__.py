"""phydict: a 3D chest CT from a few X-rays, by a diffusion prior steered through a differentiable X-ray projector.

    units, grid      HU, mu and the prior's range; where voxels are
    xray             geometry, projector and its exact adjoint, simulation          physics
    diffusion        noise schedule, sampling moves, denoisers                      mathematics
    prior            3D UNets, report encoder, cascade, checkpoints                 networks
    datasets         phantoms, CTs and X-ray files -> Cases                         files
    posterior        likelihood steps, reward, samplers                             prior x X-rays
    baselines        reconstruction without a prior                                 yardsticks
    evaluation       metrics, tables, picture panels                                scores
    methods          the named methods, and `reconstruct` in one call
    dry_run         geometry drawn before anything is reconstructed
    shipped          where the priors, tables and configurations lie that come with the project
    atomic           files and folders that appear whole or not at all
    checksum         what tells one file from another
    case_results     finished cases on disk
    ablation         methods and settings compared on the same X-rays
    profiling        seconds and memory of a computation's stages
    training, inference, datamodule, super_resolution_data, reconstruction_data     Lightning
"""

from phydict.datasets import load_xrays
from phydict.grid import Grid
from phydict.methods import METHODS, reconstruct
from phydict.prior import load_prior, save_prior
from phydict.runtime.seeds import case_seed
from phydict.units import HUWindow, hu_to_mu, mu_to_hu
from phydict.xray import ConeBeam, Projector

__version__ = "0.1.0"

__all__ = ["METHODS", "ConeBeam", "Grid", "HUWindow", "Projector", "case_seed", "hu_to_mu", "load_prior", "load_xrays",
           "mu_to_hu", "reconstruct", "save_prior"]
