"""Training with Lightning: priors, super-resolution, refiners, refinement on finer voxels, uncertainty and rivals."""

from phydict.training.crops import SuperResolutionData
from phydict.training.data import PriorData
from phydict.training.prior import PriorTraining
from phydict.training.super_resolution import SuperResolutionTraining

__all__ = ["PriorData", "PriorTraining", "SuperResolutionData", "SuperResolutionTraining"]
