"""From Hounsfield units to matter: how much air, soft tissue, bone and metal a voxel holds.

A voxel is a mixture of neighbours on the HU scale, by volume:

    -1000 ... SOFT_HU          air and soft tissue (ICRU-44): lung, and voxels on the body's surface
    SOFT_HU ... MIXED_HU       soft tissue, denser with HU
    MIXED_HU ... BONE_HU       soft tissue and cortical bone (ICRU-44); beyond, bone, denser with HU
    `metal` and more           titanium at its own density, since CT numbers saturate in metal

SOFT_HU and BONE_HU (53 and 1559 at 70 keV) are those materials' own HU at the CT's effective energy; that skeletal
tissues begin at MIXED_HU follows Schneider, Bortfeld and Schlegel 2000, doi:10.1088/0031-9155/45/2/314. The mixture is
then scaled so that at the CT's effective energy it attenuates exactly as its HU say. Air's own attenuation is 0, as the
definition of the Hounsfield scale has it and as normalisation to an exposure without patient makes it.
"""

from __future__ import annotations

import torch

from phydict.xray.spectrum import DENSITIES, attenuation

MATERIALS = ("air", "soft_tissue", "bone", "titanium")

MIXED_HU = 100.0


def own_hu(material: str, ct_energy: float) -> float:
    """HU of a pure material at `ct_energy` in keV."""
    return 1000 * float(attenuation(material, ct_energy) / attenuation("water", ct_energy) - 1)


def volume_fractions(hu: torch.Tensor, ct_energy: float = 70.0, metal: float | None = None) -> torch.Tensor:
    """Volume fractions (4, ...) of MATERIALS in voxels of `hu` (...); they lie in [0, 1] and sum to 1.

    ct_energy: effective energy in keV of the CT that the HU are from; metal: HU from which a voxel is titanium, None
    for never.
    """
    tissue = ((hu + 1000) / (own_hu("soft_tissue", ct_energy) + 1000)).clamp(0, 1)
    bone = ((hu - MIXED_HU) / (own_hu("bone", ct_energy) - MIXED_HU)).clamp(0, 1)
    implant = torch.zeros_like(hu) if metal is None else (hu >= metal).to(hu)
    body = torch.stack([1 - tissue, tissue - bone, bone]) * (1 - implant)
    return torch.cat([body, implant[None]])


def partial_densities(hu: torch.Tensor, ct_energy: float = 70.0, metal: float | None = None) -> torch.Tensor:
    """Densities (3, ...) in g/cm^3 of soft tissue, bone and titanium in voxels of `hu` (...).

    Except in metal, sum of density * mass attenuation at ct_energy = mu_water (1 + HU / 1000), not below 0.
    """
    fractions = volume_fractions(hu, ct_energy, metal)[1:]
    pure = hu.new_tensor([float(attenuation(m, ct_energy)) for m in MATERIALS[1:]])
    mixed = torch.einsum("m,m...->...", pure, fractions)
    meant = float(attenuation("water", ct_energy)) * (1 + hu / 1000).clamp(min=0)
    scale = torch.where((mixed > 0) & (fractions[-1] == 0), meant / mixed, torch.ones_like(hu))
    densities = hu.new_tensor([DENSITIES[m] for m in MATERIALS[1:]])
    return densities.view(-1, *[1] * hu.ndim) * fractions * scale
