"""Writes this folder's tables: tube spectra with SpekPy, mass attenuation with XrayDB.

    pip install -e '.[spectra]'
    python data/spectra/make.py
"""

from pathlib import Path

import numpy as np
import spekpy
import xraydb
from spekpy.SpekTools import load_mu_data

HERE = Path(__file__).parent
ENERGIES = np.arange(10.5, 120, 1.0)
"""Centres in keV of bins 1 keV wide."""

ANODE_DEGREES, ALUMINIUM_MM, AIR_MM = 12.0, 3.0, 1000.0
TUBES = (70, 80, 100, 120)

# Weight fractions of the elements: ICRU Report 44 as NIST tabulates it.
COMPOSITIONS = {
    "water": {"H": 0.111898, "O": 0.888102},
    "soft_tissue": {"H": 0.102, "C": 0.143, "N": 0.034, "O": 0.708, "Na": 0.002, "P": 0.003, "S": 0.003, "Cl": 0.002,
                    "K": 0.003},
    "bone": {"H": 0.034, "C": 0.155, "N": 0.042, "O": 0.435, "Na": 0.001, "Mg": 0.002, "P": 0.103, "S": 0.003,
             "Ca": 0.225},
    "titanium": {"Ti": 1.0},
    "aluminium": {"Al": 1.0},
    "caesium_iodide": {"Cs": 0.511549, "I": 0.488451},
    "air": {"C": 0.000124, "N": 0.755267, "O": 0.231781, "Ar": 0.012827},
}


def tube(kvp: int) -> np.ndarray:
    """Photons per bin, as fractions of all."""
    spectrum = spekpy.Spek(kvp=kvp, th=ANODE_DEGREES, dk=1.0, physics="casim")
    spectrum.filter("Al", ALUMINIUM_MM).filter("Air", AIR_MM)
    energies, photons = spectrum.get_spectrum(edges=False)
    photons = np.interp(ENERGIES, energies, photons, right=0.0)
    return photons / photons.sum()


def mass_attenuation(composition: dict[str, float]) -> np.ndarray:
    """cm^2/g with coherent scattering."""
    return sum(weight * xraydb.mu_elam(element, 1000 * ENERGIES) for element, weight in composition.items())


def write(name: str, columns: dict[str, np.ndarray], digits: int) -> None:
    rows = np.stack([ENERGIES, *columns.values()], 1)
    np.savetxt(HERE / name, rows, delimiter=",", fmt=["%.1f"] + [f"%.{digits}g"] * len(columns), comments="",
               header=",".join(["energy_kev", *columns]))


if __name__ == "__main__":
    write("tungsten.csv", {f"{kvp}kvp": tube(kvp) for kvp in TUBES}, 6)
    absorption = load_mu_data("nist")[1].get_muen_over_rho_air(ENERGIES)
    write("attenuation.csv", {name: mass_attenuation(parts) for name, parts in COMPOSITIONS.items()}
          | {"air_energy_absorption": absorption}, 6)
