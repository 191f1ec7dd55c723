"""Lifting: a voxel reads the X-rays where it projects, views in any order, geometry of any kind."""

import numpy as np
import pytest
import torch
from scenes import block, voxel_centres
from torch.nn.functional import avg_pool2d

from phydict.grid import Grid
from phydict.rivals import LiftedNetwork
from phydict.rivals.sampling import all_places, pooled
from phydict.units import MU_WATER
from phydict.xray import ConeBeam, Projector
from phydict.xray.boxes import halved
from rivals.tiny_rivals import GRID, tilted, tiny_lifted

ORBIT = ConeBeam.orbit(3, 1020, 740, (28, 28), 20.0)
BEAMS = {"orbit": ORBIT, "tilted": tilted(4)}
WIDE = {"orbit": ConeBeam.orbit(3, 1020, 740, (60, 60), 20.0), "tilted": tilted(4, (63, 60))}


@pytest.mark.parametrize("beam", WIDE.values(), ids=WIDE)
@pytest.mark.parametrize("voxel", [(3, 12, 8), (8, 5, 2), (13, 9, 11)])
def test_a_point_of_the_volume_is_read_at_its_projection(beam, voxel):
    """The shadow of one voxel, smoothed, is largest in the mean over the views at that voxel."""
    volume = torch.zeros(1, 1, *GRID.shape)
    volume[(0, 0, *voxel)] = 1
    y = Projector(GRID, beam, "siddon", full_detector=True)(volume)
    mean, largest = pooled(avg_pool2d(y, 3, 1, 1)[:, :, None], all_places(GRID, beam, y), beam.shape)
    assert np.unravel_index(int(mean.argmax()), GRID.shape) == voxel
    assert largest[(0, 0, *voxel)] >= mean[(0, 0, *voxel)] > 0


@pytest.mark.parametrize("shape", [(28, 28), (27, 31)])
def test_coarse_features_lie_where_their_pixels_are(shape):
    """A linear image averaged over 2^2 pixels is read as the image itself."""
    beam = ConeBeam.orbit(2, 1020, 740, shape, 40.0)
    y = torch.arange(shape[0])[:, None] + 3.0 * torch.arange(shape[1])
    y = y.expand(1, 2, 1, *shape)
    places = all_places(GRID, beam, y)
    fine = pooled(y, places, beam.shape)[0]
    coarse = pooled(avg_pool2d(y[0], 2, ceil_mode=True)[None], places, beam.shape, 2)[0]
    torch.testing.assert_close(coarse, fine, atol=1e-3, rtol=0)


def test_blocks_of_voxels_lie_at_the_mean_of_their_voxels():
    grid = Grid((8, 6, 4), affine=np.array([[0, 5.0, 0, 3], [4, 0, 0, -9], [0, 0, 6, 1], [0, 0, 0, 1]]))
    blocks = torch.nn.functional.avg_pool3d(torch.from_numpy(voxel_centres(grid)).movedim(-1, 0)[None], 2)[0]
    np.testing.assert_allclose(voxel_centres(halved(grid)), blocks.movedim(0, -1))


def test_a_voxel_that_no_view_sees_reads_nothing_and_one_view_is_enough():
    beam = ConeBeam.orbit(2, 1020, 740, (6, 6), 20.0)
    y = torch.ones(1, 2, 1, 6, 6)
    mean, largest = pooled(y, all_places(GRID, beam, y), beam.shape)
    assert set(mean.round(decimals=5).unique().tolist()) == {0.0, 1.0}
    torch.testing.assert_close(mean, largest)


@pytest.mark.parametrize("beam", BEAMS.values(), ids=BEAMS)
def test_views_in_another_order_give_the_same_ct(beam):
    order = list(range(beam.views))[::-1]
    y = 100 + 20 * torch.randn(1, beam.views, *beam.shape, generator=torch.Generator().manual_seed(0))
    rival = tiny_lifted()
    one, other = rival(y, beam), rival(y[:, order], beam.select(order))
    torch.testing.assert_close(one, other, atol=1e-5, rtol=0)
    assert one.std() > 1e-3 and not torch.allclose(one, rival(y[:, order], beam), atol=1e-3)


@pytest.mark.parametrize("views", [1, 2, 5])
def test_any_number_of_views_is_taken_and_each_counts(views):
    beam, rival = tilted(views), tiny_lifted()
    y = Projector(GRID, beam, full_detector=True)(block() + 1) / MU_WATER / 100
    found = rival(y, beam)
    changed = y.clone()
    changed[:, -1] += 50
    assert found.isfinite().all() and not torch.allclose(found, rival(changed, beam), atol=1e-3)


@pytest.mark.parametrize("settings", [{"channels": (8, 8)}, {"image_channels": (8,)}, {"fine": 0}])
def test_networks_that_cannot_be_are_refused(settings):
    with pytest.raises(ValueError, match="network"):
        LiftedNetwork(**settings)
