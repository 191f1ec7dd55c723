"""Training a prior or a super-resolution stage with Lightning."""

from phydict.training.crops import SuperResolutionData
from phydict.training.data import PriorData
from phydict.training.prior import PriorTraining
from phydict.training.super_resolution import SuperResolutionTraining

__all__ = ["PriorData", "PriorTraining", "SuperResolutionData", "SuperResolutionTraining"]
