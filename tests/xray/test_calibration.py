"""Scatter and hardening are found by comparison with a reference, and nothing else is taken for them."""

import pytest
import torch
from laws import random_like

from phydict.xray.calibration import HARDENING, LARGEST_SHARE, UNBENT_PATH, bend, subtract_scatter, without_hardening
from phydict.xray.materials import partial_densities
from phydict.xray.polychromatic import Polychromatic

V, U = 24, 32
DOWN, ALONG = torch.meshgrid(torch.linspace(-1, 1, V), torch.linspace(-1, 1, U), indexing="ij")
CHEST = 3.5 * torch.exp(-2 * ALONG**2 - DOWN**2) * (1 + 0.2 * torch.sin(9 * DOWN))
CLEAN = CHEST[None, None].double().expand(1, 2, -1, -1)
SMOOTH = torch.stack([0.02 + 0 * DOWN, 0.03 + 0.01 * torch.cos(torch.pi * (ALONG + 1) / 2)]).double()


def scattered(clean, scatter):
    return -torch.log(torch.exp(-clean) + scatter)


def test_smooth_scatter_is_subtracted_exactly_where_the_reference_is_right():
    torch.testing.assert_close(subtract_scatter(scattered(CLEAN, SMOOTH), CLEAN), CLEAN, atol=1e-6, rtol=0)


@pytest.mark.parametrize("rows, columns", [(1, 40), (40, 1), (2, 2), (1, 1)])
def test_detectors_of_few_rows_have_their_scatter_subtracted_too(rows, columns):
    clean = CLEAN[..., :rows, :columns].contiguous()
    torch.testing.assert_close(subtract_scatter(clean, clean), clean, atol=1e-5, rtol=0)


def test_a_reference_that_is_wrong_in_detail_spoils_little():
    measured = scattered(CLEAN, SMOOTH)
    reference = CLEAN + 0.1 * random_like(CLEAN.shape, seed=1)
    left = (subtract_scatter(measured, reference) - CLEAN).norm()
    assert left < 0.1 * (measured - CLEAN).norm()


def test_x_rays_without_scatter_are_left_alone_and_x_rays_that_read_too_little_nearly_so():
    torch.testing.assert_close(subtract_scatter(CLEAN, CLEAN), CLEAN)
    too_little = CLEAN + 0.1
    assert (subtract_scatter(too_little, CLEAN) - too_little).abs().mean() < 0.01


def test_each_view_and_each_reference_of_a_batch_has_its_own_scatter():
    measured, two = scattered(CLEAN, SMOOTH), torch.cat([CLEAN, 1.1 * CLEAN])
    both = subtract_scatter(measured, two)
    for row, reference in zip(both, two):
        torch.testing.assert_close(row[None], subtract_scatter(measured, reference[None]))
        for k in range(2):
            alone = subtract_scatter(measured[:, k:k + 1], reference[None, k:k + 1])
            torch.testing.assert_close(row[None, k:k + 1], alone)


@pytest.mark.parametrize("reading", [8.0, 12.0, 16.0, 29.0])
@pytest.mark.parametrize("in_the_reference", [False, True])
def test_a_dead_pixel_changes_nothing_of_the_scatter_found_in_the_others(reading, in_the_reference):
    """In air or behind the patient, whether or not the reference has taken it for something dense."""
    for row, column in ((1, 1), (12, 16)):
        measured, reference = scattered(CLEAN, SMOOTH), CLEAN.clone()
        measured[..., row, column] = reading
        if in_the_reference:
            reference[..., row, column] = reading + 1
        alive = torch.ones(V, U, dtype=torch.bool)
        alive[row, column] = False
        found = subtract_scatter(measured, reference)
        torch.testing.assert_close(found[..., alive], CLEAN[..., alive], atol=2e-3, rtol=0)


def test_x_rays_whose_scatter_no_pixels_tell_are_left_as_they_are():
    measured = torch.zeros(1, 1, 3, 3).double()
    measured[..., 0, :2] = 29.0
    torch.testing.assert_close(subtract_scatter(measured, 0.9 * measured), measured, atol=1e-6, rtol=0)


@pytest.mark.parametrize("reference", [0.0, 50.0])
def test_the_signal_is_never_used_up(reference):
    found = subtract_scatter(CLEAN.float(), torch.full_like(CLEAN, reference).float())
    assert found.isfinite().all() and (found - CLEAN <= -torch.log(torch.tensor(1 - LARGEST_SHARE)) + 1e-4).all()
    assert (found - CLEAN >= -1e-5).all()


@pytest.mark.parametrize("scintillator", [0.45, None])
@pytest.mark.parametrize("kvp", [70, 80, 100, 120])
def test_water_behind_any_tube_is_straight_without_hardening(kvp, scintillator):
    tube = Polychromatic(kvp, scintillator=scintillator)
    thickness, mu = torch.linspace(0, 450, 91, dtype=torch.float64), tube.effective_mu_water
    water = partial_densities(torch.zeros(1, dtype=torch.float64), tube.ct_energy)
    measured = -torch.log(tube.primary(thickness * water)[0])
    straight = without_hardening(measured, mu)
    assert (measured - mu * thickness).abs().max() > 0.4 and (straight - mu * thickness).abs().max() < 0.07
    assert straight[thickness == UNBENT_PATH] == pytest.approx(mu * UNBENT_PATH, abs=1e-9)
    assert bend(measured, mu * thickness, mu) == pytest.approx(HARDENING, rel=0.1)
    assert abs(bend(straight, mu * thickness, mu)) < 0.1 * HARDENING
