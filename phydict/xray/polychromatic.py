"""Realistic X-rays: a tube's spectrum through materials, a scintillator, scatter, counting and readout noise.

One line integral per material carries all the energies (DeepDRR, Unberath et al. 2018, arXiv:1803.08606):

    primary = sum over E of w(E) R(E) exp(-sum over m of (mu/rho)_m(E) A rho_m) / sum over E of w(E) R(E)
    X-rays  = -log(primary + scatter + noise)

with the spectrum w, the detector's response R, and rho_m the partial density of material m. The division is air
normalisation, by a noiseless exposure without patient.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from numbers import Real

import numpy as np
import torch

from phydict.units import mu_to_hu
from phydict.xray.geometry import ConeBeam
from phydict.xray.materials import MATERIALS, partial_densities
from phydict.xray.noise import normal, poisson
from phydict.xray.projectors.projector import Projector
from phydict.xray.simulate import Simulator, check_photons
from phydict.xray.spectrum import Spectrum, attenuation, mass_attenuation

WATER_PATH = 200.0
"""mm of water that a chest's rays typically pass, at which effective_mu_water is stated."""


@dataclass(frozen=True)
class Polychromatic(Simulator):
    """X-rays of a tube at 70, 80, 100 or 120 kVp, read by an energy-integrating detector.

    Not modelled: heel effect, bow-tie filters, focal spot, blur of the detector, motion.

    Args:
        kvp: the tube (Spectrum.tube)
        spectrum: used instead of the tube's
        air_photons: photons per pixel that reach the detector without patient, None for no noise at all. At 120 kVp 27
            uGy of air kerma are a million on a pixel of 1.25 mm.
        readout: standard deviation of electronic noise, in detected photons.
        scintillator: mm of solid caesium iodide. A photon is absorbed with probability 1 - exp(-mu mm) and then gives
            light in proportion to its energy; fluorescence does not escape. None: every photon is absorbed. 0.45 mm are
            the solid part of the usual 0.6 mm of columns.
        scatter: amplitude of scattered radiation, 0 for none (scatter_of). 0.3 gives about as much scatter as primary
            behind a wide object of line integral 3; an antiscatter grid leaves about a fifth of that.
        scatter_width: standard deviation in mm on the detector of the scatter kernel.
        saturation: the largest signal that the detector can read, as a multiple of the signal without patient; None: no
            limit. Signals below half a detected photon read as half a photon, so that no pixel is infinite.
        metal: HU from which voxels are titanium (such as 3000), None for never. CTs clipped to a prior's HU window hold
            no metal.
        ct_energy: effective energy in keV of the CT that the volume is from; 70 suits 120 kVp.
    """

    kvp: int = 120
    air_photons: float | None = 1e6
    readout: float = 3.0
    scintillator: float | None = 0.45
    scatter: float = 0.0
    scatter_width: float = 60.0
    saturation: float | None = None
    metal: float | None = None
    ct_energy: float = 70.0
    spectrum: Spectrum | None = None

    def __post_init__(self):
        check_photons(self.air_photons)
        for name in ("readout", "scatter"):
            value = getattr(self, name)
            if not (_is_number(value) and 0 <= value < math.inf):
                raise ValueError(f"{name} must be finite and >= 0, 0 for none; {value!r} was given")
        for name in ("scintillator", "saturation", "metal", "scatter_width", "ct_energy"):
            value = getattr(self, name)
            left_out = value is None and name not in ("scatter_width", "ct_energy")
            if not left_out and not (_is_number(value) and 0 < value < math.inf):
                raise ValueError(f"{name} must be finite and > 0, but {value!r} was given; leave it out for the "
                                 "default")
        for energies in (self.ct_energy, self.beam_spectrum.energies):
            attenuation("water", energies)  # refuses energies off its table

    @property
    def beam_spectrum(self) -> Spectrum:
        """The spectrum that leaves the tube."""
        return self.spectrum or Spectrum.tube(self.kvp)

    @property
    def effective_mu_water(self) -> float:
        """1/mm: what WATER_PATH mm of 0 HU read, without scatter and noise, over their length."""
        densities = partial_densities(torch.zeros(1, dtype=torch.float64), self.ct_energy)
        primary, _ = self.primary(WATER_PATH * densities)
        return -math.log(float(primary)) / WATER_PATH

    def primary(self, paths: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Signal (...) without scatter relative to air, and its quantum, behind (3, ...) g/cm^3 mm of the materials.

        The quantum is the variance of the signal of one incident photon over the signal: with n photons the signal
        varies like (quantum / n) times a Poisson count of mean n signal / quantum.
        """
        energies, weights = (np.array(x) for x in (self.beam_spectrum.energies, self.beam_spectrum.weights))
        absorbed = weights if self.scintillator is None else weights * -np.expm1(
            -self.scintillator * attenuation("caesium_iodide", energies))
        first = absorbed * energies / np.dot(absorbed, energies)
        second = first * energies / np.dot(absorbed, energies)
        present = [i for i in range(len(paths)) if paths[i].any()]
        tables = np.stack([0.1 * mass_attenuation(m, energies) for m in MATERIALS[1:]], 1)
        signal, variance = torch.zeros_like(paths[0]), torch.zeros_like(paths[0])
        for light, square, table in zip(first, second, tables):
            exponent = sum((float(table[i]) * paths[i] for i in present), torch.zeros_like(paths[0]))
            passed = torch.exp(-exponent)
            signal += float(light) * passed
            variance += float(square) * passed
        return signal, torch.where(signal > 0, variance / signal, torch.full_like(signal, second.sum()))

    def _measure(self, projector: Projector, mu: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
        densities = partial_densities(mu_to_hu(mu), self.ct_energy, self.metal)
        paths = mu.new_zeros(len(densities), projector.beam.views, *projector.beam.shape)
        for path, density in zip(paths, densities):
            if density.any():
                path.copy_(projector(density[None])[0])
        signal, quantum = self.primary(paths)
        photon = float(self.primary(paths.new_zeros(3))[1])
        if self.scatter > 0:
            signal = signal + scatter_of(signal, projector.beam, self.scatter, self.scatter_width)
        floor = torch.finfo(signal.dtype).tiny
        if self.air_photons is not None:
            quantum, photon = quantum.double() / self.air_photons, photon / self.air_photons
            signal = quantum * poisson(signal / quantum, generator) + self.readout * photon * normal(signal, generator)
            floor = photon / 2
        signal = signal.clamp(min=floor)
        if self.saturation is not None:
            signal = signal.clamp(max=self.saturation)
        return -signal.log().to(mu)


def _is_number(value: object) -> bool:
    return isinstance(value, Real)


def scatter_of(primary: torch.Tensor, beam: ConeBeam, amplitude: float, width: float) -> torch.Tensor:
    """Scattered signal (K, V, U) of a primary signal (K, V, U) relative to air.

    amplitude * G(primary * -log primary): rays scatter in proportion to what they meet and to what is left of them,
    into a Gaussian G of standard deviation `width` mm that sums to 1 (the form of Ohnesorge, Flohr and
    Klingenbeck-Regn 1999, Eur Radiol 9:563, with a Gaussian for the kernel). Outside the detector nothing scatters.
    """
    source = amplitude * -torch.special.xlogy(primary, primary)
    return torch.stack([
        _spread(len(view), float(np.linalg.norm(v)), width).to(view) @ view
        @ _spread(view.shape[1], float(np.linalg.norm(u)), width).to(view).T
        for view, u, v in zip(source, beam.u, beam.v)])


def _spread(count: int, pixel: float, width: float) -> torch.Tensor:
    """Gaussian blur along a row of pixels as a matrix; what it spreads beyond the row is lost."""
    distance = torch.arange(-count, count + 1, dtype=torch.float64) * pixel
    reach = torch.arange(-int(8 * width / pixel) - 1, int(8 * width / pixel) + 2, dtype=torch.float64) * pixel
    total = torch.exp(-((reach / width) ** 2) / 2).sum()
    kernel = torch.exp(-((distance / width) ** 2) / 2) / total
    pixels = torch.arange(count)
    return kernel[count + pixels[:, None] - pixels]
