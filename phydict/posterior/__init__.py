"""Sampling a CT prior under the X-rays' likelihood."""

from phydict.posterior.cascade import CascadePosterior
from phydict.posterior.likelihood.admm_tv import ADMMTV
from phydict.posterior.likelihood.langevin import Langevin
from phydict.posterior.likelihood.likelihood import GradientSteps, LikelihoodStep, ProximalCG
from phydict.posterior.likelihood.likelihood_draw import ExactDraw, LikelihoodDraw
from phydict.posterior.likelihood.reward import Reward
from phydict.posterior.measurement import Measurement
from phydict.posterior.metal import Metal
from phydict.posterior.posterior import Posterior
from phydict.posterior.refined import Refined
from phydict.posterior.refinement import Refinement
from phydict.posterior.samplers.daps import DAPS
from phydict.posterior.samplers.dds import DDS
from phydict.posterior.samplers.diffpir import DiffPIR
from phydict.posterior.samplers.dps import DPS
from phydict.posterior.samplers.pnp_dm import PnPDM
from phydict.posterior.samplers.prior_only import PriorOnly
from phydict.posterior.samplers.sampler import Sampler, ddim_sample
from phydict.posterior.samplers.split_gibbs import SplitGibbs
from phydict.posterior.samplers.unrolled import Unrolled

__all__ = [
           "ADMMTV",
           "DAPS",
           "DDS",
           "DPS",
           "CascadePosterior",
           "DiffPIR",
           "ExactDraw",
           "GradientSteps",
           "Langevin",
           "LikelihoodDraw",
           "LikelihoodStep",
           "Measurement",
           "Metal",
           "PnPDM",
           "Posterior",
           "PriorOnly",
           "ProximalCG",
           "Refined",
           "Refinement",
           "Reward",
           "Sampler",
           "SplitGibbs",
           "Unrolled",
           "ddim_sample",
]
