"""Laws of the threshold segmentation: it finds what a phantom is built of, and says when there is nothing to find."""

from __future__ import annotations

import numpy as np
import pytest
import scipy
import torch

from phydict.datasets.cts.acquisition import without_table
from phydict.datasets.cts.anatomy import body_mask, grown, lung_box_centre, segment
from phydict.datasets.phantoms.phantom import phantom_case
from phydict.grid import Grid
from phydict.units import HUWindow


def dice(a, b) -> float:
    return 2 * float((a * b).sum()) / float((a + b).sum())


@pytest.fixture(scope="module", params=[3, 11])
def phantom(request):
    grid = Grid.cube(128)
    case = phantom_case(request.param, grid)
    hu = HUWindow().to_hu(case["volume"][0].numpy())
    return grid, hu, case["masks"].numpy() > 0.5, *segment(hu, grid.spacing)


def test_the_lungs_of_a_phantom_are_found(phantom):
    _grid, _hu, truth, masks, known = phantom
    assert known.all()
    assert dice(masks[0] > 0.5, truth[0]) > 0.9


def test_the_trachea_of_a_phantom_is_airway_and_not_lung(phantom):
    _grid, hu, truth, masks, _known = phantom
    x, y, z = np.nonzero(truth[1] & (hu < -980))
    top = z > np.quantile(z, 0.8)
    assert masks[1][x[top], y[top], z[top]].mean() > 0.8
    assert masks[0][x[top], y[top], z[top]].mean() < 0.1


def test_vessels_lie_inside_the_lungs_and_are_bright(phantom):
    _grid, hu, _truth, masks, _known = phantom
    vessel = masks[2] > 0
    assert vessel.any() and (masks[0][vessel] == 1).all() and (hu[vessel] > -500).all()


def test_airway_and_lung_do_not_overlap(phantom):
    assert not (phantom[3][0] * phantom[3][1]).any()


def body(shape=(100, 80, 60), hu=40.0):
    """An elliptic cylinder of water-like tissue in air, 4 mm voxels."""
    x, y, z = np.meshgrid(*[np.arange(n) - (n - 1) / 2 for n in shape], indexing="ij")
    return np.where((x / 42) ** 2 + (y / 30) ** 2 < 1, hu, -1000.0).astype(np.float32), x, y, z


@pytest.mark.parametrize("volume", [np.full((40, 40, 40), -1000.0), np.full((40, 40, 40), 40.0), body()[0]],
                         ids=["air", "water", "solid body"])
def test_without_lungs_masks_are_zero_and_unknown(volume):
    masks, known = segment(volume.astype(np.float32), 4.0)
    assert not known.any() and not masks.any() and masks.shape == (3, *volume.shape)


def test_a_pocket_of_gas_in_the_body_is_not_a_lung():
    hu, x, y, z = body()
    hu[(x / 20) ** 2 + (y / 15) ** 2 + (z / 15) ** 2 < 1] = -1000
    assert not segment(hu, 4.0)[1].any()


def test_a_hollow_table_is_not_a_lung():
    hu, x, y, _z = body()
    hu[(np.abs(x) < 40) & (y < -33)] = -300
    hu[(np.abs(x) < 37) & (y < -34) & (y > -39)] = -850
    assert not segment(hu, 4.0)[1].any()


def test_the_volume_and_place_of_two_plain_lungs_are_right():
    hu, x, y, z = body()
    lungs = (((abs(x) - 18) / 12) ** 2 + ((y - 3) / 18) ** 2 + ((z - 4) / 22) ** 2) < 1
    hu[lungs] = -850
    masks, known = segment(hu, 4.0)
    assert known.tolist() == [True, False, True]
    assert masks[0].sum() == pytest.approx(lungs.sum(), rel=0.05)
    affine = np.diag([4.0, 4.0, 4.0, 1.0])
    affine[:3, 3] = 100, -50, 20
    middle = np.array([49.5, 39.5 + 3, 29.5 + 4]) * 4 + affine[:3, 3]
    np.testing.assert_allclose(lung_box_centre(masks[0], affine), middle, atol=4)


def test_a_lung_beside_a_wall_of_a_voxel_or_two_lies_in_the_body_and_a_hollow_table_does_not():
    hu, x, y, z = body()
    patient = hu > -1000
    lungs = ((abs(x) - 25) / 15.5) ** 2 + (y / 14) ** 2 + (z / 24) ** 2 < 1
    hu[lungs] = -850
    hu[(np.abs(x) < 40) & (y < -33)] = -300
    hu[(np.abs(x) < 37) & (y < -34) & (y > -39)] = -850
    found = body_mask(hu, 4.0)
    assert found[lungs].all() and not found[y < -33].any()
    bare = without_table(torch.from_numpy(hu)[None], Grid(hu.shape, (4.0, 4.0, 4.0)))[0].numpy()
    assert (bare[patient] == hu[patient]).all() and (bare[y < -33] == -1000).all()
    assert segment(hu, 4.0)[0][0].sum() == pytest.approx(lungs.sum(), rel=0.05)


@pytest.mark.parametrize("spacing", [(2.0, 2.0, 2.0), (1.0, 1.5, 3.3), (9.0, 2.0, 2.0)])
def test_a_mask_grows_by_what_lies_within_its_reach(spacing):
    mask = np.random.default_rng(0).random((24, 25, 26)) > 0.999
    for reach in (3.0, 8.0):
        near = scipy.ndimage.distance_transform_edt(~mask, spacing) <= reach
        assert np.array_equal(grown(mask, np.array(spacing), reach), near)


def test_a_lung_open_at_the_first_and_last_slice_is_still_found():
    hu, x, y, _z = body()
    lungs = ((abs(x) - 18) / 12) ** 2 + ((y - 3) / 18) ** 2 < 1
    hu[lungs] = -850
    assert segment(hu, 4.0)[0][0].sum() == pytest.approx(lungs.sum(), rel=0.1)
