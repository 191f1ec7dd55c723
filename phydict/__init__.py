"""phydict: a 3D chest CT from a few X-rays, by a diffusion prior steered through a differentiable X-ray projector.

    units, grid      HU, mu and the prior's range; where voxels are
    runtime          whole files, settings, consoles, precision, profiles
    linalg           conjugate gradients, total variation, norms
    xray             geometry, projectors and their exact adjoints, simulation      physics
    diffusion        noise schedule, sampling moves, denoisers                      mathematics
    prior            3D UNets, report encoder, cascade, files; MedSyn's             networks
    datasets         phantoms, CTs and X-ray files -> Cases                         files
    reconstruction   what every method promises and returns; guard watches it       contract
    posterior        likelihood steps, reward, samplers                             prior x X-rays
    baselines        reconstruction without a prior                                 yardsticks
    evaluation       metrics, tables, picture panels                                scores
    rivals           published networks from X-rays to CT, re-implemented           yardsticks
    page             a page for the browser beside every result
    poses            geometry found with the volume
    methods          the named methods, and `reconstruct` in one call
    training         priors, super-resolution, refiners, uncertainty, rivals        Lightning
    inference        X-rays -> volumes, CTs -> scores                               Lightning
    ablation         methods and settings compared on the same X-rays
    cli              the command lines of train.py and infer.py                     Lightning
"""

import os

if "OMP_WAIT_POLICY" not in os.environ:  # threads that spin long for each other lose most beside another program
    os.environ.setdefault("GOMP_SPINCOUNT", "3000")  # (tests/benchmark/beside.csv); libgomp reads it as torch loads it

from phydict.datasets import load_xrays
from phydict.grid import Grid
from phydict.methods import METHODS, reconstruct
from phydict.prior import load_prior, save_prior
from phydict.runtime.seeds import case_seed
from phydict.runtime.version import VERSION
from phydict.units import HUWindow, hu_to_mu, mu_to_hu
from phydict.xray import ConeBeam, Projector

__version__ = VERSION

__all__ = ["METHODS", "ConeBeam", "Grid", "HUWindow", "Projector", "case_seed", "hu_to_mu", "load_prior", "load_xrays",
           "mu_to_hu", "reconstruct", "save_prior"]
