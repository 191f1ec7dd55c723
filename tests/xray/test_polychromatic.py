"""Polychromatic X-rays against the integrals they stand for: hardening, dose, scatter, starvation."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from phydict.baselines import SIRT
from phydict.units import MU_WATER, hu_to_mu
from phydict.xray import ConeBeam, Grid, Ideal, Polychromatic, Projector, Spectrum
from phydict.xray.materials import own_hu, partial_densities
from phydict.xray.polychromatic import scatter_of
from phydict.xray.spectrum import DENSITIES, attenuation, mass_attenuation

BEAM = ConeBeam.orbit(2, 1020, 740, (24, 24), 16.0)
A = Projector(Grid.cube(16), BEAM)
CLEAN = Polychromatic(air_photons=None)
BONE_HU = own_hu("bone", 70.0)


def box(hu: float, half: int = 5) -> torch.Tensor:
    """mu (1, 1, 16, 16, 16) of a cube of `hu` in air."""
    volume = torch.full((16, 16, 16), -1000.0, dtype=torch.float64)
    volume[8 - half:8 + half, 8 - half:8 + half, 8 - half:8 + half] = hu
    return hu_to_mu(volume)[None, None]


def chest() -> torch.Tensor:
    hu = box(0.0, 7)[0, 0] * 1000 / MU_WATER - 1000
    hu[4:7, 4:12, 3:13] = -850
    hu[9, 9, :] = 700
    return hu_to_mu(hu)[None, None]


@pytest.mark.parametrize("energy", [60.0, 70.0])
@pytest.mark.parametrize("scintillator", [None, 0.45])
def test_one_energy_is_ideal(energy, scintillator):
    simulate = replace(CLEAN, spectrum=Spectrum((energy,), (1.0,)), ct_energy=energy, scintillator=scintillator)
    scale = float(attenuation("water", energy)) / MU_WATER
    torch.testing.assert_close(simulate(A, chest()), scale * Ideal(noise=0)(A, chest()), rtol=1e-9, atol=1e-9)
    assert simulate.effective_mu_water == pytest.approx(float(attenuation("water", energy)))


@pytest.mark.parametrize("kvp", [70, 120])
@pytest.mark.parametrize("hu, material", [(own_hu("soft_tissue", 70.0), "soft_tissue"), (BONE_HU, "bone")])
def test_a_slab_is_the_integral_over_the_spectrum(kvp, hu, material):
    tube = Spectrum.tube(kvp)
    energies, weights = np.array(tube.energies), np.array(tube.weights)
    response = weights * energies * (1 - np.exp(-0.45 * attenuation("caesium_iodide", energies)))
    lengths = A(box(1000.0)) / (2 * MU_WATER)
    xrays = replace(CLEAN, kvp=kvp)(A, (1 + hu / 1000) / 2 * box(1000.0))
    passed = np.exp(-lengths.numpy()[..., None] * 0.1 * DENSITIES[material] * mass_attenuation(material, energies))
    expected = -np.log((passed * response).sum(-1) / response.sum())
    assert lengths.max() > 100
    np.testing.assert_allclose(xrays.numpy(), expected, rtol=1e-6, atol=1e-9)


def test_zero_hu_are_water():
    """Soft tissue diluted to 0 HU attenuates like water to 0.5 % at every energy of a tube's body."""
    tube = Spectrum.tube(120)
    energies = np.array(tube.energies)
    weights = np.array(tube.weights) * np.exp(-100 * attenuation("water", energies))
    expected = -np.log((weights * energies * np.exp(-120 * attenuation("water", energies))).sum()
                       / (weights * energies).sum())
    simulate = replace(CLEAN, spectrum=Spectrum(tube.energies, tuple(weights)), scintillator=None)
    primary, _ = simulate.primary(120 * torch.tensor([1.0 / (1 + own_hu("soft_tissue", 70.0) / 1000) * 1.06, 0.0, 0.0],
                                                     dtype=torch.float64))
    assert -math.log(float(primary)) == pytest.approx(float(expected), rel=0.005)


@pytest.mark.parametrize("material", [0, 1, 2])
def test_matter_hardens_the_beam(material):
    thickness = torch.linspace(10, 300, 30, dtype=torch.float64)
    paths = torch.zeros(3, 30, dtype=torch.float64)
    paths[material] = thickness
    effective = -CLEAN.primary(paths)[0].log() / thickness
    assert (effective.diff() < 0).all()


def test_bone_hardens_more_than_as_much_water():
    def loss(hu: float) -> float:
        """Thick over thin: the share of the thin box's attenuation that is left per mm in the thick one."""
        thin, thick = (CLEAN(A, box(hu, half)).max() / A(box(hu, half)).max() for half in (1, 5))
        return float(thick / thin)

    assert loss(BONE_HU) < loss(0.0) - 0.03 < 1 - 0.03


def test_air_reads_zero_with_and_without_scatter():
    for simulate in (CLEAN, replace(CLEAN, scatter=0.3)):
        assert float(simulate(A, torch.zeros(1, 1, 16, 16, 16, dtype=torch.float64)).abs().max()) < 1e-12
    noisy = Polychromatic(air_photons=1e5)(A, torch.zeros(1, 1, 16, 16, 16, dtype=torch.float64))
    assert float(noisy.mean()) == pytest.approx(0, abs=4 * float(noisy.std()) / noisy.numel()**0.5)


@pytest.mark.parametrize("simulate", [
    Polychromatic(air_photons=1e5, readout=0.0), Polychromatic(air_photons=1e4, kvp=70),
    Polychromatic(air_photons=1e5, scatter=0.5), Polychromatic(air_photons=1e5, readout=60)])
def test_noise_is_that_of_the_counts(simulate):
    """Var[-log s] = Var[s] / s^2 with Var[s] = quantum s / n + readout^2, far from starvation."""
    beam = ConeBeam.orbit(1, 1020, 740, (96, 96), 1.0)
    projector, mu = Projector(Grid.cube(16), beam, full_detector=True), box(0.0, 4)
    clean = replace(simulate, air_photons=None)(projector, mu)
    residual = simulate(projector, mu, 3) - clean
    paths = torch.cat([projector(density[None]) for density in partial_densities(mu[0] / MU_WATER * 1000 - 1000)])
    signal, n = clean.neg().exp(), simulate.air_photons
    readout = simulate.readout * float(simulate.primary(torch.zeros(3, dtype=torch.float64))[1]) / n
    expected = float(((simulate.primary(paths)[1] / n * signal + readout**2) / signal**2).mean())
    assert float(residual.square().mean()) == pytest.approx(expected, rel=0.08)


def test_the_quantum_is_the_variance_per_signal():
    """Energy by energy: a photon of E is absorbed with probability a and gives E; so mean E a, variance E^2 a."""
    tube = Spectrum.tube(100)
    energies, weights = np.array(tube.energies), np.array(tube.weights)
    absorbed = 1 - np.exp(-0.45 * attenuation("caesium_iodide", energies))
    passed = weights * absorbed * np.exp(-100 * attenuation("bone", energies))
    air = (weights * absorbed * energies).sum()
    signal, quantum = replace(CLEAN, kvp=100).primary(torch.tensor([0.0, 192.0, 0.0], dtype=torch.float64))
    assert float(signal) == pytest.approx((passed * energies).sum() / air)
    assert float(quantum) == pytest.approx((passed * energies**2).sum() / air**2 / float(signal))


def test_four_times_the_dose_halves_the_noise():
    noise = [float((Polychromatic(air_photons=n, readout=0.0)(A, chest(), 1) - CLEAN(A, chest())).std())
             for n in (1e6, 4e6)]
    assert noise[0] / noise[1] == pytest.approx(2, rel=0.1)


def test_scatter_adds_signal_and_lowers_contrast():
    clear, hazy = CLEAN(A, chest()), replace(CLEAN, scatter=0.3)(A, chest())
    assert (hazy <= clear).all() and float((clear - hazy).max()) > 0.3
    lit = clear > 1
    assert float(hazy[lit].std()) < 0.95 * float(clear[lit].std())


def test_scatter_keeps_its_sum_and_grows_with_its_amplitude():
    beam = ConeBeam.orbit(1, 1020, 740, (65, 65), 4.0)
    primary = torch.ones(1, 65, 65, dtype=torch.float64)
    primary[0, 32, 32] = math.exp(-2)
    once = scatter_of(primary, beam, 0.2, 15.0)
    assert float(once.sum()) == pytest.approx(0.2 * 2 * math.exp(-2), rel=1e-6)
    torch.testing.assert_close(scatter_of(primary, beam, 0.4, 15.0), 2 * once)
    distance = 4.0 * (torch.arange(65) - 32).double()
    spread = (once[0].sum(0) * distance**2).sum() / once.sum()
    assert float(spread) == pytest.approx(15.0**2, rel=1e-3)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("simulate", [
    Polychromatic(air_photons=1.0), Polychromatic(air_photons=None), Polychromatic(metal=1500.0),
    Polychromatic(readout=1e3), Polychromatic(air_photons=None, metal=1500.0, scatter=0.1),
    Polychromatic(air_photons=50.0, saturation=0.5)])
def test_starved_and_saturated_pixels_are_finite(simulate, dtype):
    xrays = simulate(A, 50 * box(2000.0, 3).to(dtype), 3)
    assert xrays.dtype == dtype and xrays.isfinite().all()
    if simulate.air_photons:
        quantum = float(simulate.primary(torch.zeros(3, dtype=torch.float64))[1])
        assert float(xrays.max()) == pytest.approx(-math.log(0.5 * quantum / simulate.air_photons), rel=1e-5)
    if simulate.saturation:
        assert float(xrays.min()) == pytest.approx(math.log(2), rel=1e-5)


def test_metal_shadows_more_than_bone_of_the_same_hu():
    assert replace(CLEAN, metal=1500.0)(A, box(2500.0)).max() > 2 * CLEAN(A, box(2500.0)).max()


class Counted:
    """A projector that counts what is projected."""

    def __init__(self):
        self.beam, self.projections = A.beam, 0

    def __call__(self, mu: torch.Tensor) -> torch.Tensor:
        self.projections += len(mu)
        return A(mu)


@pytest.mark.parametrize("hu, metal, materials", [(-1000.0, None, 0), (0.0, None, 1), (700.0, None, 2),
                                                  (2500.0, 1500.0, 1)])
@pytest.mark.parametrize("kvp", [70, 120])
def test_the_projector_runs_once_per_material_that_is_there(hu, metal, materials, kvp):
    projector = Counted()
    replace(CLEAN, kvp=kvp, metal=metal)(projector, box(hu))
    assert projector.projections == materials


def test_a_case_depends_on_its_seed_alone():
    simulate, mu = Polychromatic(air_photons=1e4), torch.cat([chest(), 0.8 * chest()]).float()
    both = simulate(A, mu, [5, 6])
    assert torch.equal(both, simulate(A, mu, [5, 6]))
    assert torch.equal(both[1:], simulate(A, mu[1:], 6))
    assert not torch.equal(both[1:], simulate(A, mu[1:], 7))


@pytest.mark.parametrize("simulate", [Polychromatic(air_photons=1e4), Polychromatic(air_photons=30.0, readout=0.0)])
def test_rounding_does_not_change_the_draw(simulate):
    """Two devices differ in the last digits; all but a few pixels must read the same, and those by one quantum."""
    single, double = simulate(A, chest().float(), 5).double(), simulate(A, chest(), 5)
    assert float(((single - double).abs() > 1e-4).double().mean()) < 0.01
    quantum = float(simulate.primary(torch.zeros(3, dtype=torch.float64))[1]) / simulate.air_photons
    assert float((single.neg().exp() - double.neg().exp()).abs().max()) < 2 * quantum


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")
def test_a_gpu_reads_the_same():
    mu = chest().float()
    here, there = Polychromatic()(A, mu, 5), Polychromatic()(A, mu.cuda(), 5)
    assert there.is_cuda
    torch.testing.assert_close(there.cpu(), here, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("kvp", [70, 120])
def test_the_stated_attenuation_gives_water_its_hu_back(kvp):
    simulate = replace(CLEAN, kvp=kvp)
    projector = Projector(Grid.cube(16), ConeBeam.orbit(8, 1020, 740, (32, 32), 15.0))
    xrays = simulate(projector, box(0.0, 4).float())[0]
    inside = (slice(6, 10),) * 3

    def error(mu_water: float) -> float:
        volume = SIRT(40).with_mu_water(mu_water).reconstruct(xrays, projector).volume
        return abs(float(volume[inside].mean()))

    assert error(simulate.effective_mu_water) < 25
    assert error(MU_WATER) > 2 * error(simulate.effective_mu_water)


@pytest.mark.parametrize("settings, words", [
    ({"kvp": 90}, "no tube spectrum of 90 kVp"), ({"kvp": None}, "no tube spectrum of None kVp; use one of 70"),
    ({"kvp": "120"}, "no tube spectrum of '120' kVp"), ({"metal": "x"}, "metal must be finite and > 0, but 'x' was"),
    ({"readout": None}, "readout must be finite and >= 0, 0 for none; None was given"),
    ({"ct_energy": None}, "ct_energy must be finite and > 0, but None was given"),
    ({"air_photons": 0}, "photons per pixel must be > 0"), ({"air_photons": "x"}, "photons per pixel must be > 0"),
    ({"readout": -1}, "readout must be finite and >= 0"), ({"scatter": float("nan")}, "scatter must be finite"),
    ({"scintillator": 0}, "scintillator must be finite and > 0"),
    ({"saturation": -1.0}, "saturation must be finite"), ({"scatter_width": math.inf}, "scatter_width must be finite"),
    ({"scatter": 0.3, "scatter_width": None}, "scatter_width must be finite"),
    ({"air_photons": math.inf}, "photons per pixel must be > 0"), ({"ct_energy": 300.0}, "300.0 keV were given"),
    ({"spectrum": Spectrum((5.0, 60.0), (1, 1))}, "from 5.0 to 60.0 keV")])
def test_bad_settings_are_refused(settings, words):
    with pytest.raises(ValueError, match=words):
        Polychromatic(**settings)
