"""Where the voxels are: index and world are inverse maps, and a grid that contradicts itself is refused."""

import json

import numpy as np
import pytest

from phydict.grid import Grid

pytestmark = pytest.mark.smoke

TURNED = np.array([[0.0, -3.0, 0, 40], [2.0, 0, 0, -15], [0, 0, 5.0, 7], [0, 0, 0, 1]])
LEFT_FIRST = np.array([[-3.0, 0, 0, 120], [0, -3.0, 0, 112], [0, 0, 5.0, -122], [0, 0, 0, 1]])
GRIDS = [Grid.cube(8), Grid((4, 5, 6), (2.0, 3.0, 4.0)), Grid((4, 5, 6), affine=TURNED),
         Grid((7, 1, 3), affine=LEFT_FIRST)]


def centres(grid):
    """Indices and world positions (N, 3) of all voxels."""
    index = np.stack(np.meshgrid(*map(np.arange, grid.shape), indexing="ij"), -1).reshape(-1, 3)
    return index, index @ grid.affine[:3, :3].T + grid.affine[:3, 3]


@pytest.mark.parametrize("grid", GRIDS)
def test_index_undoes_the_affine(grid):
    index, world = centres(grid)
    np.testing.assert_allclose(grid.index(world), index, atol=1e-9)


@pytest.mark.parametrize("grid", GRIDS)
def test_the_centre_is_the_mean_of_the_voxels_and_of_the_corners(grid):
    np.testing.assert_allclose(grid.centre, centres(grid)[1].mean(0), atol=1e-9)
    np.testing.assert_allclose(grid.centre, grid.corners().mean(0), atol=1e-9)


@pytest.mark.parametrize("grid", GRIDS)
def test_the_corners_are_half_a_voxel_outside_the_outermost_centres(grid):
    corners = grid.index(grid.corners())
    np.testing.assert_allclose(corners.min(0), -0.5, atol=1e-9)
    np.testing.assert_allclose(corners.max(0), np.array(grid.shape) - 0.5, atol=1e-9)
    assert len(np.unique(corners.round(6), axis=0)) == 8
    np.testing.assert_allclose(grid.extent, np.array(grid.shape) * grid.spacing)


def test_a_grid_without_affine_is_centred_and_grows_to_right_anterior_superior():
    grid = Grid((4, 5, 6), (2.0, 3.0, 4.0))
    np.testing.assert_allclose(grid.centre, 0, atol=1e-12)
    np.testing.assert_allclose(grid.affine[:3, :3], np.diag([2.0, 3.0, 4.0]))


@pytest.mark.parametrize("voxels, side", [(64, 384.0), (16, 384.0), (5, 100.0)])
def test_a_cube_spans_its_side_whatever_its_resolution(voxels, side):
    grid = Grid.cube(voxels, side)
    np.testing.assert_allclose(grid.extent, side)
    np.testing.assert_allclose(abs(grid.corners()), side / 2)


def test_spacing_is_read_from_the_affine():
    assert Grid((4, 5, 6), affine=TURNED).spacing == pytest.approx((2, 3, 5))
    assert Grid((4, 5, 6), (2.0, 3.0, 5.0), TURNED).same_as(Grid((4, 5, 6), affine=TURNED))


def test_a_spacing_that_contradicts_the_affine_is_refused():
    with pytest.raises(ValueError, match="contradicts"):
        Grid((4, 5, 6), (2.0, 3.0, 4.0), TURNED)


def test_shear_is_refused():
    sheared = TURNED.copy()
    sheared[2, 1] = 0.3  # a tilted gantry
    with pytest.raises(ValueError, match=r"shear: axes 1 and 2 meet at 84\.3 degrees.*resample"):
        Grid((4, 5, 6), affine=sheared)


@pytest.mark.parametrize("change, message", [
    ({"shape": (4, 5)}, "three positive sizes"), ({"shape": (4, 5, 0)}, "three positive sizes"),
    ({"spacing": None}, "either its spacing"), ({"spacing": (1.0, -1.0, 1.0)}, "positive and finite"),
    ({"spacing": (1.0, 0.0, 1.0)}, "positive and finite"),
    ({"spacing": (1.0, float("inf"), 1.0)}, "positive and finite"),
    ({"spacing": None, "affine": np.eye(3)}, "4x4"), ({"spacing": None, "affine": np.full((4, 4), np.nan)}, "finite"),
    ({"spacing": (6, 6)}, "length in mm, one for all axes or three"), ({"spacing": "a"}, "but 'a' was given"),
    ({"spacing": None, "affine": [[1, 2], [3]]}, "4x4"),
    ({"spacing": None, "affine": TURNED.T}, "last row 0 0 0 1, but .* was given: transpose it"),
    ({"spacing": None, "affine": np.diag([1.0, 1, 1, 2])}, r"but \[0.0, 0.0, 0.0, 2.0\] was given")])
def test_impossible_grids_are_refused(change, message):
    with np.errstate(all="ignore"), pytest.raises(ValueError, match=message):
        Grid(**{"shape": (4, 5, 6), "spacing": (1.0, 1.0, 1.0)} | change)


@pytest.mark.parametrize("make, words", [
    (lambda: Grid.cube((64, 64, 64)), "one whole number .* Grid.box takes three"),
    (lambda: Grid.cube([[1, 2], [3]]), "one whole number"),
    (lambda: Grid.cube(64, (384, 384, 300)), "one length in mm.* Grid.box takes three"),
    (lambda: Grid.cube(64, "384"), "one length in mm, but '384' was given"),
    (lambda: Grid.box(64, "384"), "a length in mm, one for all or three, but '384' was given"),
    (lambda: Grid.box(64, centre="here"), "three numbers in mm")])
def test_sizes_of_another_kind_are_refused_in_a_sentence(make, words):
    with pytest.raises(ValueError, match=words):
        make()


@pytest.mark.parametrize("grid", GRIDS)
def test_a_grid_survives_plain_json(grid):
    again = Grid(**json.loads(json.dumps(grid.to_dict())))
    assert again.same_as(grid) and again.spacing == pytest.approx(grid.spacing)


def test_same_as_sees_a_shift_a_turn_and_a_size():
    grid = Grid((4, 5, 6), affine=TURNED)
    shifted = TURNED.copy()
    shifted[0, 3] += 0.1
    assert not grid.same_as(Grid((4, 5, 6), affine=shifted))
    assert not grid.same_as(Grid((4, 5, 6), (2.0, 3.0, 5.0)))
    assert not grid.same_as(Grid((4, 5, 7), affine=TURNED))


@pytest.mark.parametrize("stretch, same", [(1e-6, True), (1e-5, False), (1e-3, False)])
def test_same_as_holds_to_a_thousandth_of_a_voxel_at_the_far_corner_too(stretch, same):
    one, other = (Grid((512,) * 3, affine=np.diag([length, length, length, 1.0]))
                  for length in (0.75, 0.75 * (1 + stretch)))
    assert one.same_as(other) == other.same_as(one) == same


def test_a_grid_cannot_be_changed_afterwards_nor_through_the_array_it_was_made_of():
    given = TURNED.copy()
    grid = Grid((4, 5, 6), affine=given)
    given[0, 3] = 999
    assert grid.affine[0, 3] == 40
    with pytest.raises(ValueError):
        grid.affine[0, 3] = 1
