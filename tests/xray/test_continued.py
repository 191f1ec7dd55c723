"""Volumes that go on above and below their voxels where rays meet them."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import yaml
from laws import random_like
from torch.nn.functional import pad

from phydict import ConeBeam, Projector, reconstruct
from phydict.datasets import load_xrays, phantom_case, save_xrays
from phydict.evaluation import volume_metrics
from phydict.grid import Grid
from phydict.units import HUWindow
from phydict.xray import Ideal
from phydict.xray.projectors.continued import reach_beyond, with_slices

GRID = Grid.cube(16)
ORBIT = ConeBeam.orbit(3, 1020, 740, (40, 40), 14.0, start=0.2)
TILTED = ConeBeam.orbit(3, 1020, 600, (40, 40), 14.0, start=0.2).tilted(7)
SWEEP = ConeBeam.sweep(3, 1020, 740, (40, 40), 14.0, 40)


@pytest.mark.parametrize("beam, method", [
    (ORBIT, "separable"), (ORBIT, "siddon"), (ORBIT, "joseph"), (SWEEP, "joseph"),
    (TILTED, "siddon"), (TILTED, "matrix")])
def test_rays_meet_the_last_slices_as_far_as_they_meet_anything(beam, method):
    mu = random_like((1, 1, *GRID.shape), torch.float64).abs()
    continued = Projector(GRID, replace(beam, continued=True), method, full_detector=True)
    slices = reach_beyond(beam, GRID)
    for more in (slices, slices + 3):
        tall = Projector(with_slices(GRID, more), beam, method, full_detector=True)
        torch.testing.assert_close(continued(mu), tall(pad(mu, (more, more, 0, 0, 0, 0), mode="replicate")))
    assert 0 < slices < 16 and not torch.allclose(continued(mu), Projector(GRID, beam, method, full_detector=True)(mu))


@pytest.mark.parametrize("method", ["separable", "siddon"])
def test_the_adjoint_is_exact(method):
    A = Projector(GRID, replace(ORBIT, continued=True), method, full_detector=True)
    mu = random_like((1, 1, *GRID.shape), torch.float64)
    y = random_like((1, 3, 40, 40), torch.float64, seed=1)
    assert float((A(mu) * y).sum()) == pytest.approx(float((mu * A.T(y)).sum()), rel=1e-10)


def test_a_small_detector_meets_nothing_beyond():
    beam = replace(ConeBeam.orbit(2, 1020, 740, (20, 40), 5.0), continued=True)
    mu = random_like((1, 1, *GRID.shape), torch.float64)
    assert reach_beyond(beam, GRID) == 0
    plain = Projector(GRID, replace(beam, continued=False), full_detector=True)
    assert torch.equal(Projector(GRID, beam, full_detector=True)(mu), plain(mu))


def test_other_poses_pixels_and_views_stay_continued_and_a_file_keeps_it(tmp_path):
    beam = replace(ORBIT, continued=True)
    for other in (beam.binned(2), beam.divided(2), beam.select([0, 2]), beam.shifted(3, 4), beam.tilted(5)):
        assert other.continued
    beam.save(tmp_path / "beam.yaml")
    assert ConeBeam.load(tmp_path / "beam.yaml").continued and not ConeBeam.from_dict(ORBIT.to_dict()).continued
    orbit = {"views": 3, "source_to_detector": 1020, "source_to_isocentre": 740, "shape": [40, 40], "pixel": 14.0}
    assert ConeBeam.from_dict({"orbit": orbit, "continued": True}).continued
    with pytest.raises(ValueError, match="true or false"):
        ConeBeam.from_dict({"orbit": orbit, "continued": "yes"})


@pytest.mark.filterwarnings("ignore:no volume explains")
@pytest.mark.parametrize("method", ["phydict_learned", "phydict_fast", "cgls"])
def test_a_patient_who_goes_on_is_found_better_where_the_geometry_says_so(method):
    grid, window = Grid.cube(64), HUWindow()
    case = phantom_case(3, grid, window)["volume"][None]
    tall = pad(case[..., 12:52], (28, 28, 0, 0, 0, 0), mode="replicate")
    truth = tall[..., 16:80].contiguous()
    beam = ConeBeam.orbit(8, 1020, 740, (112, 112), 5.0)
    y = Ideal()(Projector(with_slices(grid, 16), beam, full_detector=True), window.to_mu(tall), 0)[0]
    plain, continued = (volume_metrics(reconstruct(y, given, method=method, grid=grid).volume[None, None],
                                       window.to_hu(truth))["psnr"]
                        for given in (beam, replace(beam, continued=True)))
    assert continued > plain + 3


def test_a_smaller_box_is_refused():
    beam = replace(ConeBeam.orbit(2, 1020, 740, (112, 112), 5.0), continued=True)
    with pytest.raises(ValueError, match="a smaller box was given"):
        reconstruct(np.random.default_rng(0).random((2, 112, 112)), beam, method="tv", grid=Grid.box(16, 100.0))


@pytest.mark.parametrize("beam", [{"beam": ORBIT.to_dict()}, ORBIT.to_dict()])
def test_a_folder_of_xrays_says_that_the_patient_goes_on(beam, tmp_path):
    save_xrays(tmp_path / "scan", torch.rand(3, 40, 40), ORBIT)
    for said in (True, False):
        (tmp_path / "scan" / "geometry.yaml").write_text(yaml.safe_dump(beam | {"continued": said}))
        assert load_xrays(tmp_path / "scan")["beam"].continued == said
    (tmp_path / "scan" / "geometry.yaml").write_text(yaml.safe_dump(beam | {"continued": 1}))
    with pytest.raises(ValueError, match="true or false"):
        load_xrays(tmp_path / "scan")
