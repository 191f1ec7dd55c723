"""Sampling a CT prior under the X-rays' likelihood."""

from phydict.posterior.admm_tv import ADMMTV
from phydict.posterior.cascade import CascadePosterior
from phydict.posterior.daps import DAPS
from phydict.posterior.dds import DDS
from phydict.posterior.diffpir import DiffPIR
from phydict.posterior.dps import DPS
from phydict.posterior.langevin import Langevin
from phydict.posterior.likelihood import GradientSteps, LikelihoodStep, ProximalCG
from phydict.posterior.likelihood_draw import ExactDraw, LikelihoodDraw
from phydict.posterior.measurement import Measurement
from phydict.posterior.pnp_dm import PnPDM
from phydict.posterior.posterior import Posterior
from phydict.posterior.reward import Reward
from phydict.posterior.sampler import PriorOnly, Sampler, descend
from phydict.posterior.split_gibbs import SplitGibbs

__all__ = ["ADMMTV", "CascadePosterior", "DAPS", "DDS", "DPS", "DiffPIR", "ExactDraw", "GradientSteps", "Langevin",
           "LikelihoodDraw", "LikelihoodStep", "Measurement", "PnPDM", "Posterior", "PriorOnly", "ProximalCG", "Reward",
           "Sampler", "SplitGibbs", "descend"]
