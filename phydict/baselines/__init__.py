"""Reconstruction without a learnt prior."""

from phydict.baselines.baseline import Baseline
from phydict.baselines.cgls import CGLS
from phydict.baselines.diffvox import DiffVox
from phydict.baselines.fdk import FDK
from phydict.baselines.region import Region
from phydict.baselines.sirt import SIRT
from phydict.baselines.stored import Stored
from phydict.baselines.tv import FISTATV

__all__ = ["CGLS", "FDK", "FISTATV", "SIRT", "Baseline", "DiffVox", "Region", "Stored"]
