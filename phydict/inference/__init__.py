"""Reconstructing with Lightning: X-rays to volumes, CTs to scores."""

from phydict.inference.data import ReconstructionData
from phydict.inference.task import ReconstructionTask

__all__ = ["ReconstructionData", "ReconstructionTask"]
