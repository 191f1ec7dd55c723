"""Sampling a CT prior under the X-rays' likelihood."""

from phydict.posterior.cascade import CascadePosterior
from phydict.posterior.likelihood import GradientSteps, LikelihoodStep, ProximalCG
from phydict.posterior.measurement import Measurement
from phydict.posterior.posterior import Posterior
from phydict.posterior.reward import Reward
from phydict.posterior.sampler import PriorOnly, Sampler, descend
from phydict.posterior.split_gibbs import SplitGibbs

__all__ = ["CascadePosterior", "GradientSteps", "LikelihoodStep", "Measurement", "Posterior", "PriorOnly",
           "ProximalCG", "Reward", "Sampler", "SplitGibbs", "descend"]
