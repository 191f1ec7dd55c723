"""HU to materials: fractions of a whole, mass as published, and attenuation that gives the HU back."""

import pytest
import torch

from phydict.xray.materials import MATERIALS, own_hu, partial_densities, volume_fractions
from phydict.xray.spectrum import DENSITIES, attenuation, mass_attenuation

HU = torch.linspace(-1100, 4000, 2041, dtype=torch.float64)


@pytest.mark.parametrize("metal", [None, 3000.0])
def test_fractions_are_of_one_whole(metal):
    fractions = volume_fractions(HU, metal=metal)
    assert float(fractions.min()) >= 0 and float(fractions.max()) <= 1
    torch.testing.assert_close(fractions.sum(0), torch.ones_like(HU))


@pytest.mark.parametrize("material", ["soft_tissue", "bone"])
def test_a_pure_material_is_found_at_its_own_hu(material):
    hu = torch.tensor(own_hu(material, 70.0), dtype=torch.float64)
    expected = torch.tensor([float(m == material) for m in MATERIALS], dtype=torch.float64)
    torch.testing.assert_close(volume_fractions(hu), expected)
    assert float(partial_densities(hu).sum()) == pytest.approx(DENSITIES[material])


def test_air_is_empty_and_metal_is_titanium():
    assert float(partial_densities(HU[HU <= -1000]).abs().max()) == 0
    metal = partial_densities(HU[HU >= 3000], metal=3000.0)
    assert (metal[2] == DENSITIES["titanium"]).all() and not metal[:2].any()
    assert not partial_densities(HU)[2].any()


@pytest.mark.parametrize("ct_energy", [60.0, 70.0])
def test_at_the_cts_energy_the_hu_come_back(ct_energy):
    table = torch.tensor([float(mass_attenuation(m, ct_energy)) for m in MATERIALS[1:]], dtype=torch.float64)
    mu = 0.1 * torch.einsum("m,mv->v", table, partial_densities(HU, ct_energy))
    expected = float(attenuation("water", ct_energy)) * (1 + HU / 1000).clamp(min=0)
    torch.testing.assert_close(mu, expected)


def test_density_is_the_published_one():
    """Skeletal tissues: 1.017 + 0.000592 HU g/cm^3 between 100 and 1600 HU; lung: in proportion to HU + 1000.

    Schneider, Bortfeld and Schlegel 2000, doi:10.1088/0031-9155/45/2/314, who state 0.04 g/cm^3 of accuracy.
    """
    skeletal = HU[(HU >= 100) & (HU <= 1600)]
    assert float((partial_densities(skeletal).sum(0) - 1.017 - 0.000592 * skeletal).abs().max()) < 0.04
    lung = HU[(HU >= -950) & (HU <= -100)]
    assert float((partial_densities(lung).sum(0) - (lung + 1000) / 1000).abs().max()) < 0.04


def test_mass_never_falls_with_hu():
    assert (partial_densities(HU, metal=3000.0).sum(0).diff() >= -1e-12).all()
