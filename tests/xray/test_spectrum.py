"""Spectra and attenuation tables against published figures, and the laws of filtering."""

import numpy as np
import pytest

from phydict.xray import Spectrum
from phydict.xray.spectrum import attenuation, mass_attenuation

TUBES = (70, 80, 100, 120)

# mu/rho in cm^2/g: NIST's tables of X-ray mass attenuation coefficients (NISTIR 5632).
NIST = {"water": {20: 0.8096, 40: 0.2683, 60: 0.2059, 80: 0.1837, 100: 0.1707},
        "soft_tissue": {60: 0.2048, 100: 0.1693}, "bone": {20: 4.001, 40: 0.6655, 60: 0.3148, 100: 0.1855},
        "titanium": {60: 0.7661, 100: 0.2721}, "aluminium": {60: 0.2778, 100: 0.1704}, "air": {60: 0.1875},
        "air_energy_absorption": {40: 0.06833, 60: 0.03041, 100: 0.02325}}


@pytest.mark.parametrize("material", NIST)
def test_attenuation_is_nists(material):
    found = mass_attenuation(material, list(NIST[material]))
    assert found == pytest.approx(list(NIST[material].values()), rel=0.01)


def test_caesium_iodide_has_both_k_edges():
    below, between, above = mass_attenuation("caesium_iodide", [32.5, 35.0, 37.0])
    assert between > 2 * below and above > 1.2 * between


@pytest.mark.parametrize("kvp", TUBES)
def test_a_tube_ends_at_its_voltage_and_sums_to_one(kvp):
    tube = Spectrum.tube(kvp)
    assert sum(tube.weights) == pytest.approx(1) and min(tube.weights) > 0
    assert kvp - 2 < max(tube.energies) < kvp
    line, beside = (tube.weights[tube.energies.index(energy)] for energy in (59.5, 61.5))
    assert (line > 1.5 * beside) == (kvp > 70)  # tungsten's K-alpha at 59.3 keV needs 69.5 keV


@pytest.mark.parametrize("kvp, mm", [(70, 2.58), (80, 3.01), (100, 3.97), (120, 5.00)])
def test_half_value_layers_are_those_of_the_rqr_qualities(kvp, mm):
    """IEC 61267:2005, beams as they leave a tube; their filtration is free, hence the tolerance."""
    assert Spectrum.tube(kvp).half_value_layer() == pytest.approx(mm, rel=0.08)


@pytest.mark.parametrize("kvp, aluminium, mm, photons", [(70, 21, 6.8, 29653), (120, 40, 11.6, 31077)])
def test_half_value_layer_and_photons_are_those_of_the_rqa_qualities(kvp, aluminium, mm, photons):
    """IEC 61267:2005 half-value layers, IEC 62220-1 photons per mm^2 and uGy, behind a patient of aluminium."""
    beam = Spectrum.tube(kvp).behind("aluminium", aluminium)
    assert beam.half_value_layer() == pytest.approx(mm, rel=0.02)
    assert 1 / beam.kerma() == pytest.approx(photons, rel=0.03)


def test_matter_hardens_a_beam_and_energies_rise_with_voltage():
    means = [Spectrum.tube(kvp).mean_energy for kvp in TUBES]
    assert means == sorted(means) and all(0.4 * kvp < mean < 0.6 * kvp for kvp, mean in zip(TUBES, means))
    tube = Spectrum.tube(100)
    assert tube.mean_energy < tube.behind("water", 100).mean_energy < tube.behind("water", 200).mean_energy
    assert tube.behind("bone", 3).behind("bone", 4).weights == pytest.approx(tube.behind("bone", 7).weights)


def test_one_energy_has_an_analytic_half_value_layer():
    one = Spectrum.monoenergetic(60)
    assert one.mean_energy == 60
    assert one.half_value_layer("water") == pytest.approx(np.log(2) / attenuation("water", 60))
    assert one.kerma("water", 50) == pytest.approx(one.kerma() * np.exp(-50 * attenuation("water", 60)))


def test_bad_input_is_refused():
    with pytest.raises(ValueError, match="no tube spectrum of 90 kVp; use one of 70, 80, 100, 120"):
        Spectrum.tube(90)
    with pytest.raises(ValueError, match="no attenuation table of 'gold'"):
        mass_attenuation("gold", 60)
    with pytest.raises(ValueError, match="from 10.5 to 119.5 keV, but energies from 5.0 to 60.0 keV"):
        mass_attenuation("water", [5, 60])
    for weights in ((1.0,), (0.0, 0.0), (1.0, -1.0), (1.0, float("nan"))):
        with pytest.raises(ValueError, match="one finite weight >= 0 per energy"):
            Spectrum((50.0, 60.0), weights)
