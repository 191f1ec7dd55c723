"""The noise of X-rays is read off them, whatever they show."""

import pytest
import torch
from laws import random_like

from phydict.datasets import phantom_case
from phydict.grid import Grid
from phydict.units import HUWindow
from phydict.xray import ConeBeam, Projector
from phydict.xray.noise_level import BINS, noise_level


@pytest.fixture(scope="module")
def chest():
    """Noiseless X-rays of a phantom."""
    grid, window = Grid.cube(48), HUWindow()
    beam = ConeBeam.orbit(4, 1020, 740, (96, 96), 5.8)
    return Projector(grid, beam, full_detector=True)(window.to_mu(phantom_case(3, grid, window)["volume"])[None])[0]


def noise(like, seed=1):
    return random_like(like.shape, torch.float32, seed=seed)


@pytest.mark.parametrize("share", [0.005, 0.01, 0.05])
def test_the_noise_of_a_chests_views_is_found_to_a_fifth(chest, share):
    level = share * float(chest.max())
    found = noise_level(chest + level * noise(chest))
    torch.testing.assert_close(found.square().mean((1, 2)).sqrt(), torch.full((4,), level), rtol=0.2, atol=0)


def test_a_chest_without_noise_has_next_to_none(chest):
    assert noise_level(chest).square().mean().sqrt() < 0.001 * chest.max()


def test_each_view_has_its_own_and_it_grows_with_the_values():
    y = noise(torch.empty(3, 64, 64)) * torch.tensor([0.1, 1.0, 5.0]).view(3, 1, 1)
    torch.testing.assert_close(noise_level(y).square().mean((1, 2)).sqrt(), torch.tensor([0.1, 1.0, 5.0]), rtol=0.1,
                               atol=0)
    torch.testing.assert_close(noise_level(7 * y), 7 * noise_level(y))


def test_bilinear_ramps_and_few_edges_are_no_noise():
    v, u = torch.meshgrid(torch.linspace(0, 1, 40), torch.linspace(-1, 1, 50), indexing="ij")
    ramp = (3 + 2 * u - v + 4 * u * v)[None].double()
    assert noise_level(ramp).max() < 1e-6
    ramp[:, 10:30, 12:40] += 5
    assert noise_level(ramp).max() < 1e-6


def test_views_too_small_to_tell_have_none():
    assert noise_level(noise(torch.empty(2, 2, 1))).equal(torch.zeros(2, 2, 1))


@pytest.mark.parametrize("shape", [(3, 1, 400), (3, 2, 200), (3, 400, 1)])
def test_the_noise_of_a_few_rows_or_columns_is_found_along_them(shape):
    ramp = torch.linspace(0, 5, max(shape)).view(1, *(n if n == max(shape) else 1 for n in shape[1:])).expand(shape)
    stds = torch.tensor([0.01, 0.02, 0.05])
    found = noise_level(ramp + stds[:, None, None] * noise(torch.empty(shape)))
    assert found.shape == shape and found.amax((1, 2)) == pytest.approx(stds, rel=0.2)


@pytest.mark.parametrize("photons", [1e3, 1e4, 1e5])
def test_the_noise_of_counted_photons_is_found_in_every_part_of_a_chests_views(chest, photons):
    level = (chest.exp() / photons).sqrt()
    found = noise_level(chest + level * noise(chest))
    order = chest.flatten().argsort()
    for part in order.tensor_split(4):
        assert found.flatten()[part].norm() == pytest.approx(float(level.flatten()[part].norm()), rel=0.3)


def test_noise_that_is_the_same_everywhere_reads_the_same_in_every_group_of_pixels():
    y = 0.3 * noise(torch.empty(2, 200, 200)) + torch.linspace(0, 5, 200)
    found = noise_level(y)
    torch.testing.assert_close(found, torch.full_like(found, 0.3), rtol=0.15, atol=0)
    torch.testing.assert_close(noise_level(7 * y), 7 * found)
    assert all(len(view.unique()) <= BINS for view in found)
