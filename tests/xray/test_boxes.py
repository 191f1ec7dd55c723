"""Boxes of voxels over and inside one another."""

import numpy as np
import pytest
import torch
from laws import random_like
from scenes import voxel_centres
from torch.nn.functional import avg_pool3d

from phydict.grid import Box, Grid
from phydict.xray import ConeBeam, Projector
from phydict.xray.boxes import (
    averaged,
    covers,
    divided,
    halved,
    interpolated,
    no_finer,
    outside_projection,
    refinements,
)

BASE = Grid.cube(16)
BEAM = ConeBeam.orbit(3, 1020, 740, (28, 28), 20.0)


def linear(grid: Grid) -> torch.Tensor:
    """A volume that is affine in the world's coordinates, at a grid's voxels."""
    return torch.from_numpy(voxel_centres(grid) @ [1.0, -2.0, 0.5] + 7.0)


@pytest.mark.parametrize("voxels, side, centre", [
    (16, 384.0, (0, 0, 0)), ((31, 17, 8), (310.0, 170.0, 160.0), (5.0, -10.0, 20.0)), ([9, 9, 9], 90, [0, 0, -60])])
def test_a_box_has_the_sides_and_the_centre_that_were_given(voxels, side, centre):
    grid = Box(voxels, side, centre).grid()
    np.testing.assert_allclose(grid.extent, np.broadcast_to(side, 3))
    np.testing.assert_allclose(grid.centre, centre, atol=1e-9)
    assert grid.shape == tuple(np.broadcast_to(voxels, 3))


def test_a_box_of_one_slice_is_one_as_long_as_its_voxels_are_short():
    assert Box((64, 64, 1), (192, 192, 3)).grid().shape == (64, 64, 1) and Box(8).grid().spacing == (48.0,) * 3


@pytest.mark.parametrize("box, words", [
    (Box(), "give model.grid.voxels"), (Box((4, 4)), "whole number of voxels"), (Box(0), "whole number of voxels"),
    (Box(4, -1.0), "length in mm"), (Box(4, 10.0, (0, float("nan"), 0)), "three numbers in mm"),
    (Box(100_000), "GiB of memory"), (Box(1), "384 mm long.* give more voxels"), (Box(7), "54.8571 mm long"),
    (Box((64, 64, 1)), "384 mm long")])
def test_a_box_that_cannot_be_is_refused(box, words):
    with pytest.raises(ValueError, match=words):
        box.grid()


@pytest.mark.parametrize("onto", [Grid.cube(32), Grid.box((13, 8, 21), (200, 150, 230), (20, -30, 10))])
def test_interpolation_keeps_what_is_linear_and_fills_what_lies_outside(onto):
    found = interpolated(linear(BASE), BASE, onto, -5.0)
    inner = BASE.index(voxel_centres(onto))
    inner = torch.from_numpy(((inner >= 0) & (inner <= 15)).all(-1))
    assert inner.float().mean() > 0.7
    torch.testing.assert_close(found[inner], linear(onto)[inner])
    beyond = interpolated(linear(BASE), BASE, Grid.box(4, 40.0, (400.0, 0.0, 0.0)), -5.0)
    assert (beyond == -5).all()


def test_averages_over_voxels_keep_the_mean_and_over_whole_ones_what_is_linear():
    x = random_like((2, *BASE.shape))
    torch.testing.assert_close(averaged(x, BASE, Grid((8, 4, 16), (48.0, 96.0, 24.0))), avg_pool3d(x, (2, 4, 1)))
    assert averaged(x, BASE, Grid.box(8, 192.0)).equal(x[:, 4:12, 4:12, 4:12])
    torch.testing.assert_close(averaged(x, BASE, Grid.cube(7)).mean(), x.mean())
    onto = Grid.box((5, 4, 3), (240.0, 192.0, 216.0), (24.0, 0.0, -12.0))  # whose faces are those of voxels
    torch.testing.assert_close(averaged(linear(BASE), BASE, onto), linear(onto))


@pytest.mark.parametrize("grid, expected", [
    (Grid.cube(8), True), (Grid.box(8, 192.0), True), (Grid((16, 16, 8), (24.0, 24.0, 48.0)), True),
    (Grid((32, 8, 8), (12.0, 48.0, 48.0)), False), (Grid.cube(16, 383.0), False),
    (Grid((18, 16, 16), 24.0), False), (Grid.box(8, 192.0, (120.0, 0, 0)), False)])
def test_no_finer_are_voxels_that_are_along_no_axis_shorter_and_lie_in_the_box(grid, expected):
    assert no_finer(grid, BASE) is expected


def test_what_lies_inside_and_outside_a_box_projects_to_the_whole():
    box = Grid.box(8, (192.0, 192.0, 192.0))  # whose faces are those of voxels
    mu = random_like(BASE.shape).abs()
    inner = mu[4:12, 4:12, 4:12]
    projector = Projector(box, BEAM, "siddon", full_detector=True)
    whole = Projector(BASE, BEAM, "siddon", full_detector=True)(mu[None, None])[0]
    found = outside_projection(mu, BASE, projector) + projector(inner[None, None].contiguous())[0]
    torch.testing.assert_close(found, whole)


def test_faces_that_cut_voxels_leave_no_part_of_them_twice_or_out():
    box = Grid.box((16, 2, 16), (192.0, 24.0, 192.0), (0.0, 6.0, 0.0))  # a slab of half a coarse voxel to each side
    mu = random_like(BASE.shape).abs()
    projector = Projector(box, BEAM, "siddon", full_detector=True)
    whole = Projector(BASE, BEAM, "siddon", full_detector=True)(mu[None, None])[0]
    inner = interpolated(mu, BASE, box, 0.0)
    torch.testing.assert_close(outside_projection(mu, BASE, projector) + projector(inner[None, None])[0], whole)


def test_a_box_covers_itself_and_what_lies_inside_alone():
    assert covers(BASE, BASE) and covers(BASE, Grid.box(3, 100.0)) and covers(Grid.cube(7, 400.0), BASE)
    assert not covers(BASE, Grid.box(3, 100.0, (150.0, 0.0, 0.0))) and not covers(Grid.cube(64, 300.0), BASE)


def test_voxels_halve_from_level_to_level_up_to_the_target():
    assert refinements(BASE, Grid.cube(16)) == []
    target = Grid.box((96, 50, 65), (360.0, 200.0, 384.0), (0.0, 10.0, 0.0))  # 3.75, 4 and 5.9 mm of 24 mm
    levels = refinements(BASE, target)
    assert [level.shape for level in levels] == [(24, 13, 17), (48, 25, 33), (96, 50, 65)]
    for level in levels:
        np.testing.assert_allclose(level.extent, target.extent)
        np.testing.assert_allclose(level.centre, target.centre, atol=1e-9)
    assert [level.shape[0] for level in refinements(Grid.cube(64), Grid.cube(256))] == [128, 256]


def test_no_level_is_coarser_than_where_it_starts_unless_the_target_is():
    for target, shapes in ((Grid.box((256, 256, 64), 384.0), [(128, 128, 64), (256, 256, 64)]),
                           (Grid.box((64, 16, 8), 384.0), [(32, 16, 8), (64, 16, 8)])):
        start = Grid.cube(target.shape[1] // 4 if target.shape[1] > 16 else 16)
        assert [level.shape for level in refinements(start, target)] == shapes


def test_turned_axes_are_refused():
    turned = Grid((4, 4, 4), affine=np.array([[0.0, -9, 0, 0], [9, 0, 0, 0], [0, 0, 9, 0], [0, 0, 0, 1]]))
    with pytest.raises(ValueError, match="give a box along the same axes"):
        refinements(BASE, turned)


@pytest.mark.parametrize("n", [2, 3])
def test_a_finer_grid_fills_the_same_place(n):
    grid = Grid((4, 5, 6), (3.0, 2.0, 1.0))
    assert divided(grid, n).same_as(Grid((4 * n, 5 * n, 6 * n), (3 / n, 2 / n, 1 / n)))


def test_half_as_many_voxels_fill_the_same_box():
    grid = Grid((8, 6, 5), affine=Grid.cube(8).affine)
    np.testing.assert_allclose(halved(grid).corners(), grid.corners())
    assert halved(grid).shape == (4, 3, 2)
