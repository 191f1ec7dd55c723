"""X2CT-GAN for K views: views' frames in the grid's, the published case among them, one geometry, separate losses."""

import numpy as np
import pytest
import torch
from scenes import block
from torch.nn.functional import instance_norm, mse_loss

from phydict.grid import Cube, Grid
from phydict.methods import reconstruct
from phydict.prior import save_stage
from phydict.rivals import Rival, RivalAnswer, X2CTNetwork, load_rival
from phydict.rivals.planes import on_planes, plane_places, turned, turned_mean, turns
from phydict.rivals.rival import bound_orbit
from phydict.rivals.x2ct import ConnectionB
from phydict.runtime.shipped import configuration
from phydict.training.rivals import OrbitScenes
from phydict.training.x2ct import Adversary, X2CTTraining
from phydict.units import MU_WATER, HUWindow
from phydict.xray import ConeBeam, Projector, binning
from phydict.xray.geometry_files import read_beam
from rivals.tiny_rivals import GRID, lively, tiny_x2ct


def test_two_views_at_right_angles_are_those_of_the_shipped_biplanar_geometry():
    beam = read_beam(configuration("biplanar", ("geometry",)))
    rival = Rival(tiny_x2ct().network, GRID, HUWindow(), bound_orbit(GRID, 2, 180.0))
    rival.check(GRID, beam.binned(binning(GRID, beam)))


def test_views_at_right_angles_are_turned_by_permuting_axes():
    """At 0 degrees depth runs anterior, columns to the left, rows down; at 90 degrees depth runs right, columns
    anterior."""
    volumes = torch.randn(1, 2, 3, *GRID.shape, generator=torch.Generator().manual_seed(0))
    beam = bound_orbit(GRID, 2, 180.0)
    first, second = turned(volumes, turns(GRID, beam, volumes))[0]
    torch.testing.assert_close(first, volumes[0, 0].permute(0, 3, 1, 2).flip(1, 3), atol=1e-5, rtol=0)
    torch.testing.assert_close(second, volumes[0, 1].permute(0, 1, 3, 2).flip(3), atol=1e-5, rtol=0)


def in_three_dimensions(theta):
    whole = theta.new_zeros(len(theta), 3, 4)
    whole[:, 1, 0], whole[:, ::2, 1:3] = -1, theta
    return whole


def test_upright_views_turned_by_slices_are_those_turned_in_three_dimensions():
    volumes = torch.randn(2, 5, 3, *GRID.shape, generator=torch.Generator().manual_seed(0), requires_grad=True)
    theta = turns(GRID, bound_orbit(GRID, 5), volumes)
    slices, whole = turned(volumes, theta), turned(volumes, in_three_dimensions(theta))
    assert theta.shape == (5, 2, 2)
    torch.testing.assert_close(slices, whole, atol=1e-4, rtol=0)
    torch.testing.assert_close(turned_mean(volumes, theta), whole.mean(1), atol=1e-4, rtol=0)
    weights = torch.randn_like(slices)
    one, other = (torch.autograd.grad(turn, volumes, weights)[0] for turn in (slices, whole))
    torch.testing.assert_close(one, other, atol=1e-4, rtol=0)


def test_maps_of_a_view_repeated_along_its_depth_are_convolved_as_any_volume():
    torch.manual_seed(0)
    connection, h = ConnectionB(6, 5), torch.randn(2, 6, 8, 8, requires_grad=True)
    repeated = connection.flat(h).relu()[:, :, None].expand(-1, -1, 8, -1, -1)
    whole, short = instance_norm(connection.deep(repeated)).relu(), connection(h)
    torch.testing.assert_close(short, whole, atol=1e-5, rtol=0)
    weights, learnt = torch.randn_like(whole), [h, *connection.parameters()]
    # The bias goes with the mean: its gradient is 0 but for rounding.
    for one, other in zip(torch.autograd.grad(short, learnt, weights), torch.autograd.grad(whole, learnt, weights)):
        torch.testing.assert_close(one, other, atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("upright", [True, False])
def test_places_are_not_rounded_to_the_networks_precision(upright):
    volumes = torch.randn(1, 3, 2, *GRID.shape, generator=torch.Generator().manual_seed(0))
    theta = turns(GRID, bound_orbit(GRID, 3), volumes)
    theta = theta if upright else in_three_dimensions(theta)
    plain = turned(volumes, theta)
    with torch.autocast("cpu", torch.bfloat16):
        torch.testing.assert_close(turned(volumes, theta), plain, atol=1e-5, rtol=0)


@pytest.mark.parametrize("voxel", [(8, 7, 8), (6, 9, 7), (9, 8, 10)])
def test_a_point_near_the_isocentre_is_lifted_to_its_place(voxel):
    volume = torch.zeros(1, 1, *GRID.shape)
    volume[(0, 0, *voxel)] = 1
    beam = bound_orbit(GRID, 5)
    y = Projector(GRID, beam, "siddon", full_detector=True)(volume)
    network = X2CTNetwork(8, 4, (2, 2), (4, 8, 8))
    mean = network.lifted(y, *network.geometry(GRID, beam, y)).mean(1)
    assert np.unravel_index(int(mean.argmax()), GRID.shape) == voxel


def test_an_image_on_the_plane_of_the_isocentre_keeps_places_in_mm():
    """A detector whose pixels are voxels magnified is its own image."""
    magnified = GRID.spacing[0] * 1020 / 740
    beam = ConeBeam.orbit(3, 1020, 740, (16, 16), magnified)
    y = torch.randn(2, 3, 16, 16, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(on_planes(y, plane_places(GRID, beam, y)), y, atol=1e-4, rtol=0)


def test_views_in_another_order_give_the_same_ct():
    rival, order = tiny_x2ct(views=3), [2, 0, 1]
    y = 100 + 30 * torch.randn(1, 3, *rival.beam.shape, generator=torch.Generator().manual_seed(0))
    one, other = rival(y, rival.beam), rival(y[:, order], rival.beam.select(order))
    torch.testing.assert_close(one, other, atol=1e-4, rtol=0)
    assert one.std() > 1e-3


def test_another_number_of_views_geometry_or_grid_is_refused(tmp_path):
    save_stage(tiny_x2ct(), tmp_path / "x2ct.safetensors")
    method = RivalAnswer(load_rival(tmp_path / "x2ct.safetensors"))
    for beam, said in ((bound_orbit(GRID, 3), "trained for 2 X-rays, but 3 were given"),
                       (bound_orbit(GRID, 2, 180.0), "one geometry of its 2 views"),
                       (ConeBeam.orbit(2, 1020, 740, (20, 28), 20.0), "28 x 28 pixels, but another")):
        y = Projector(GRID, beam, full_detector=True)(block() + 1)[0] * MU_WATER
        with pytest.raises(ValueError, match=said):
            reconstruct(y, beam, method=method, grid=GRID)
    with pytest.raises(ValueError, match="cube of 16 voxels a side"):
        tiny_x2ct(Grid.cube(32))
    with pytest.raises(ValueError, match="bound to one geometry, but none"):
        Rival(X2CTNetwork(8, 4, (2, 2), (4, 8, 8)), GRID, tiny_x2ct().window)
    with pytest.raises(ValueError, match="one more of channels"):
        X2CTNetwork(blocks=(2, 2))
    with pytest.raises(ValueError, match="adversary.width"):
        Adversary(width=0)


def test_the_discriminator_learns_from_its_own_loss_alone_and_the_generator_from_the_others():
    """One backward pass of the sum gives the gradients of two passes, one for each network."""
    task = X2CTTraining(lively(lambda: X2CTNetwork(8, 4, (2, 2), (4, 8, 8))), OrbitScenes(views=2), Cube(16),
                        (-1000, 600), adversary=Adversary(width=4)).eval().double()
    ct, beam, adversary = block().double(), task.prior.beam, task.discriminator
    water = Projector(GRID, beam, full_detector=True)(ct + 1)
    task.case_loss(ct, water, beam, torch.Generator().manual_seed(0)).backward()
    found = {name: weight.grad.clone() for name, weight in task.named_parameters()}
    task.zero_grad()
    made, real = (task.prior(water, beam) + 1) / 2, (ct + 1) / 2
    lifted = task.prior.network.lifted(water / 200, *task.prior.network.geometry(GRID, beam, water))
    one, zero = adversary(real, lifted), adversary(made.detach(), lifted)
    ((one - 1).square().mean() / 2 + zero.square().mean() / 2).backward()
    expected = {name: weight.grad.clone() for name, weight in adversary.named_parameters()}
    adversary.requires_grad_(False)
    projected = sum((made.mean(axis) - real.mean(axis)).abs().mean() for axis in (2, 3, 4)) / 3
    (0.1 * (adversary(made, lifted) - 1).square().mean() + 10 * mse_loss(made, real) + 10 * projected).backward()
    for name, gradient in found.items():
        part, _, inner = name.partition(".")
        other = expected[inner] if part == "discriminator" else task.get_parameter(name).grad
        torch.testing.assert_close(gradient, other)
