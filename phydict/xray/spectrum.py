"""X-ray spectra of tubes, and the attenuation of matter by energy.

The tables lie in data/spectra, with their provenance; everything between their energies is interpolated.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from numbers import Real

import numpy as np

from phydict.runtime.shipped import shipped

DENSITIES = {"water": 1.0, "soft_tissue": 1.06, "bone": 1.92, "titanium": 4.54, "aluminium": 2.699,
             "caesium_iodide": 4.51, "air": 1.205e-3}
"""g/cm^3, as NIST tabulates them with the compositions in data/spectra/make.py; bone is cortical (ICRU-44)."""


@cache
def _table(name: str) -> dict[str, np.ndarray]:
    path = shipped(f"data/spectra/{name}")
    if not path.is_file():
        raise FileNotFoundError(f"there is no table {path}; install phydict again, or write it in a checkout with "
                                "python data/spectra/make.py")
    columns = path.read_text().split("\n", 1)[0].split(",")
    return dict(zip(columns, np.loadtxt(path, delimiter=",", skiprows=1).T))


def mass_attenuation(material: str, energies) -> np.ndarray:
    """mu / rho in cm^2/g of a material at `energies` in keV.

    material: a key of DENSITIES, or "air_energy_absorption" for mu_en / rho of air. Log-log interpolation of bins
    1 keV wide. Raises ValueError for other materials and for energies off the table.
    """
    table = _table("attenuation.csv")
    known, energies = table["energy_kev"], np.asarray(energies, float)
    if material == "energy_kev" or material not in table:
        raise ValueError(f"there is no attenuation table of {material!r}; use one of {', '.join(list(table)[1:])}")
    if not ((energies >= known[0]) & (energies <= known[-1])).all():
        raise ValueError(f"attenuation is tabulated from {known[0]} to {known[-1]} keV, but energies from "
                         f"{energies.min()} to {energies.max()} keV were given; stay inside the table")
    return np.exp(np.interp(np.log(energies), np.log(known), np.log(table[material])))


def attenuation(material: str, energies) -> np.ndarray:
    """Linear attenuation in 1/mm of a key of DENSITIES at its own density, at `energies` in keV."""
    return 0.1 * DENSITIES[material] * mass_attenuation(material, energies)


@dataclass(frozen=True)
class Spectrum:
    """Photons by energy: `energies` in keV and the `weights` of each, which are scaled to sum to 1.

    Raises ValueError unless there are as many finite weights >= 0 as energies, with one > 0.
    """

    energies: tuple[float, ...]
    weights: tuple[float, ...]

    def __post_init__(self):
        weights = np.asarray(self.weights, float)
        if len(weights) != len(self.energies) or not (np.isfinite(weights) & (weights >= 0)).all() or not weights.any():
            raise ValueError(f"a spectrum needs one finite weight >= 0 per energy and one > 0, but the energies "
                             f"{self.energies} and the weights {self.weights} were given")
        object.__setattr__(self, "energies", tuple(float(e) for e in self.energies))
        object.__setattr__(self, "weights", tuple((weights / weights.sum()).tolist()))

    @classmethod
    def tube(cls, kvp: int) -> Spectrum:
        """A tungsten tube at 70, 80, 100 or 120 kVp: 12 degrees, 3 mm of aluminium, 1 m of air (data/spectra).

        Raises ValueError for other voltages.
        """
        table, tube = _table("tungsten.csv"), f"{kvp:g}kvp" if isinstance(kvp, Real) else ""
        if tube not in table:
            tubes = ", ".join(name.removesuffix("kvp") for name in list(table)[1:])
            raise ValueError(f"there is no tube spectrum of {kvp!r} kVp; use one of {tubes}, or give a Spectrum")
        there = table[tube] > 1e-7
        return cls(tuple(table["energy_kev"][there]), tuple(table[tube][there]))
