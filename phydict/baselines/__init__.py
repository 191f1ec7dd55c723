"""Reconstruction without a learnt prior."""

from phydict.baselines.sirt import SIRT

__all__ = ["SIRT"]
