"""HU, attenuation and the prior's range are one scale written three ways."""

import numpy as np
import pytest
import torch

from phydict.units import MU_WATER, HUWindow, hu_to_mu, mu_to_hu

pytestmark = pytest.mark.smoke

WINDOWS = [HUWindow(), HUWindow(-1000, 600), HUWindow(-500, 1500)]


def test_air_and_water_define_the_hounsfield_scale():
    assert hu_to_mu(np.array([-1000.0, 0.0, 1000.0])) == pytest.approx([0, MU_WATER, 2 * MU_WATER])
    assert mu_to_hu(0.0) == -1000 and mu_to_hu(0.03, mu_water=0.03) == 0


@pytest.mark.parametrize("array", [np.array, lambda v: torch.tensor(v, dtype=torch.float64)])
def test_hu_to_mu_and_back_is_the_identity_above_vacuum(array):
    hu = array([-1000.0, -350.0, 0.0, 40.0, 3071.0])
    np.testing.assert_allclose(np.asarray(mu_to_hu(hu_to_mu(hu, 0.019), 0.019)), np.asarray(hu), atol=1e-9)


def test_attenuation_is_never_negative():
    assert hu_to_mu(np.array([-3024.0, -1001.0])).tolist() == [0, 0]  # the padding of scanner files
    assert hu_to_mu(torch.tensor([-2000.0])).tolist() == [0]


@pytest.mark.parametrize("window", WINDOWS)
def test_the_windows_ends_map_to_the_ranges_ends(window):
    hu = np.array([window.low, window.centre, window.high])
    np.testing.assert_allclose(window.to_range(hu), [-1, 0, 1])
    np.testing.assert_allclose(window.to_hu(np.array([-1.0, 0.0, 1.0])), hu)


@pytest.mark.parametrize("window", WINDOWS)
def test_round_trips_through_every_pair_of_scales(window):
    x = torch.linspace(-1, 1, 41, dtype=torch.float64)
    torch.testing.assert_close(window.to_range(window.to_hu(x)), x)
    torch.testing.assert_close(window.to_range(mu_to_hu(window.to_mu(x, 0.021), 0.021)), x)
    hu = window.to_hu(x)
    torch.testing.assert_close(mu_to_hu(window.to_mu(x)), hu)
    solid = hu >= -1000
    torch.testing.assert_close(hu_to_mu(hu)[solid], window.to_mu(x)[solid])


def test_values_outside_the_window_are_clipped_to_its_ends():
    assert HUWindow(-1000, 600).to_range(np.array([-3000.0, 601.0, 3000.0])).tolist() == [-1, 1, 1]


@pytest.mark.parametrize("window", WINDOWS)
def test_mu_is_affine_in_the_range(window):
    a, b = window.mu_affine(0.018)
    x = torch.linspace(-1.5, 1.5, 7, dtype=torch.float64)
    torch.testing.assert_close(window.to_mu(x, 0.018), a * x + b)
    assert window.to_mu(1.0, 0.018) == pytest.approx(float(hu_to_mu(np.array(window.high), 0.018)))


def test_a_window_from_air_up_has_no_negative_attenuation():
    assert HUWindow(-1000, 600).to_mu(-1.0) == pytest.approx(0)
    assert HUWindow(-1100, 600).to_mu(-1.0) < 0


@pytest.mark.parametrize("ends", [(100, 100), (400, -400), (float("nan"), 100)])
def test_a_window_without_width_is_refused(ends):
    with pytest.raises(ValueError, match="low < high"):
        HUWindow(*ends)
