"""The physics: where the X-rays pass, what they measure, and the exact adjoint of measuring it."""

from phydict.grid import Grid
from phydict.xray.binning import binned, binning
from phydict.xray.geometry import ConeBeam
from phydict.xray.polychromatic import Polychromatic
from phydict.xray.projectors.projector import Projector
from phydict.xray.simulate import Ideal, Simulator
from phydict.xray.spectrum import Spectrum

__all__ = ["ConeBeam", "Grid", "Ideal", "Polychromatic", "Projector", "Simulator", "Spectrum", "binned", "binning"]
