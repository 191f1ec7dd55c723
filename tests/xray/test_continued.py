"""Volumes that go on above and below their voxels where rays meet them."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import yaml
from laws import random_like
from torch.nn.functional import avg_pool3d, pad

from phydict import ConeBeam, Projector, reconstruct
from phydict.baselines import CGLS, FISTATV, Region
from phydict.datasets import load_xrays, phantom_case, save_xrays
from phydict.evaluation import volume_metrics
from phydict.grid import Grid
from phydict.inference.data import ReconstructionData
from phydict.units import HUWindow
from phydict.xray import Ideal, Polychromatic, Simulator
from phydict.xray.beyond import Remainders, with_continuation
from phydict.xray.projectors.continued import reach_beyond

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
        tall = Projector(GRID.grown(0, 0, more), beam, method, full_detector=True)
        torch.testing.assert_close(continued(mu), tall(pad(mu, (more, more, 0, 0, 0, 0), mode="replicate")))
    assert 0 < slices < 16 and not torch.allclose(continued(mu), Projector(GRID, beam, method, full_detector=True)(mu))


@pytest.mark.parametrize("beam", [ConeBeam.orbit(1, 1020, 740, (40, 30), 14.0), SWEEP], ids=["frontal", "sweep"])
def test_a_patient_continues_upwards_whatever_way_the_rows_of_the_detector_run(beam):
    mu = random_like((1, 1, *GRID.shape), torch.float64).abs()
    upright = replace(beam, continued=True)
    lying = replace(upright, u=beam.v, v=beam.u, shape=beam.shape[::-1])
    seen, turned = (Projector(GRID, other, "joseph", full_detector=True)(mu) for other in (upright, lying))
    torch.testing.assert_close(turned, seen.mT)
    assert Projector(GRID, lying, full_detector=True).method == "matrix"


@pytest.mark.parametrize("method", ["separable", "siddon"])
def test_the_adjoint_is_exact(method):
    A = Projector(GRID, replace(ORBIT, continued=True), method, full_detector=True)
    mu = random_like((1, 1, *GRID.shape), torch.float64)
    y = random_like((1, 3, 40, 40), torch.float64, seed=1)
    assert float((A(mu) * y).sum()) == pytest.approx(float((mu * A.T(y)).sum()), rel=1e-10)


@pytest.mark.parametrize("rows, degrees", [(40, 0), (40, 15), (40, 30), (40, 45), (40, -30), (8, 30)])
def test_no_ray_leaves_the_columns_beyond_the_slices_that_are_repeated(rows, degrees):
    grid = Grid.cube(16, 320.0)
    beam = ConeBeam.at_angles([3.0, 40.0], 1500, 900, (rows, 40), (20.0, 20.0)).tilted(degrees)
    rays = beam.pixels() - beam.sources[:, None, None]
    faces = [(side - beam.sources[:, None, None, :2]) / rays[..., :2] for side in (-160, 160)]
    inside = np.minimum(np.maximum(*faces).min(-1), 1) - np.minimum(*faces).max(-1)
    A = Projector(grid, replace(beam, continued=True), "siddon")
    found = A(torch.ones(1, 1, *grid.shape, dtype=torch.float64))[0].numpy()
    np.testing.assert_allclose(found, inside.clip(0) * np.linalg.norm(rays, axis=-1), atol=1e-9)


def test_a_small_detector_meets_nothing_beyond():
    beam = replace(ConeBeam.orbit(2, 1020, 740, (20, 40), 5.0), continued=True)
    mu = random_like((1, 1, *GRID.shape), torch.float64)
    assert reach_beyond(beam, GRID) == 0
    plain = Projector(GRID, replace(beam, continued=False), full_detector=True)
    assert torch.equal(Projector(GRID, beam, full_detector=True)(mu), plain(mu))


def test_a_box_beside_rays_that_run_along_its_axes_is_reached_as_far_as_without_them():
    beside = Grid.box(16, 100, (150, 0, 20))
    odd, even = (ConeBeam.orbit(1, 1020, 740, (n, n), 600 / n) for n in (21, 22))
    slices, mu = reach_beyond(odd, beside), random_like((1, 1, *beside.shape), torch.float64).abs()
    assert slices == reach_beyond(even, beside) > 0
    continued = Projector(beside, replace(odd, continued=True), "siddon", full_detector=True)
    tall = Projector(beside.grown(0, 0, slices + 3), odd, "siddon", full_detector=True)
    torch.testing.assert_close(continued(mu), tall(pad(mu, (slices + 3, slices + 3, 0, 0, 0, 0), mode="replicate")))


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


def test_x_rays_made_of_a_ct_go_on_beyond_it_where_the_geometry_file_says_so(tmp_path):
    path, more = tmp_path / "geometry.yaml", reach_beyond(ORBIT, GRID) + 3
    volume = random_like((1, *GRID.shape)).clamp(-1, 1)
    tall = pad(volume[None], (more, more, 0, 0, 0, 0), mode="replicate")
    ends = pad(volume[None], (more, more, 0, 0, 0, 0), value=-1.0)
    for said, whole in ((True, tall), (False, ends), (None, ends)):
        path.write_text(yaml.safe_dump({"beam": ORBIT.to_dict(), "continued": said}))
        data = ReconstructionData(cts="phantom", geometry=str(path), simulator=Ideal(noise=0))
        y = data.simulate({"volume": volume}, 0, GRID, WINDOW, torch.device("cpu"))
        expected = Projector(GRID.grown(0, 0, more), ORBIT, full_detector=True)(WINDOW.to_mu(whole))[0]
        torch.testing.assert_close(y, expected)


CHEST, ROWS, WINDOW = Grid.cube(64), 16, HUWindow()
HALF, TV = Grid.cube(32), FISTATV(iterations=40)
WIDE = ConeBeam.at_angles([90, 0], 1800, 1500, (112, 112), 5.0)


@pytest.fixture(scope="module")
def patients() -> dict[str, torch.Tensor]:
    """A phantom on 96 slices: as it is, and with its 13th last slices repeated, at both ends or below."""
    case = phantom_case(3, CHEST, WINDOW)["volume"][None]
    ends = pad(case, (ROWS, ROWS, 0, 0, 0, 0), value=-1.0)
    goes_on = pad(case[..., 12:52], (28, 28, 0, 0, 0, 0), mode="replicate")
    return {"ends": ends, "continues": goes_on, "continues below": torch.where(torch.arange(96) < 68, goes_on, -1.0),
            "lies lower": ends.roll(-ROWS, -1)}


def xrays_of(mu: torch.Tensor, beam: ConeBeam, simulator: Simulator = Ideal()) -> torch.Tensor:
    return simulator(Projector(CHEST.grown(0, 0, ROWS), beam, full_detector=True), mu, 0)[0]


def inside(volume: torch.Tensor, grid: Grid) -> torch.Tensor:
    return WINDOW.to_hu(avg_pool3d(volume[..., ROWS:-ROWS], CHEST.shape[0] // grid.shape[0]).contiguous())


@pytest.mark.filterwarnings("ignore:the X-rays show")
@pytest.mark.parametrize("simulator", [Ideal(), Polychromatic()])
@pytest.mark.parametrize("beam", [ConeBeam.orbit(k, 1020, 740, (112, 112), 5.0) for k in (1, 2, 8)] + [WIDE])
def test_x_rays_tell_whether_a_patient_goes_on(patients, beam, simulator):
    for scene, volume in patients.items():
        y = xrays_of(WINDOW.to_mu(volume), beam, simulator)
        gains = torch.linspace(0.3, 3, beam.views)[:, None, None]
        for xrays, display in ((y, False), (gains * y - 2 + gains, True)):
            left = Remainders(xrays, beam, display)
            assert left.continues(CHEST) == (scene != "ends")
            assert scene != "ends" or not left.needs_taller(CHEST)


def test_what_is_stated_is_not_asked(patients):
    beam = ConeBeam.orbit(2, 1020, 740, (112, 112), 5.0)
    y = xrays_of(WINDOW.to_mu(patients["continues"]), beam)
    for stated in (True, False):
        assert with_continuation(y, replace(beam, continued=stated), CHEST, False).continued is stated
    assert with_continuation(torch.zeros_like(y), beam, CHEST, False).continued is False
    assert with_continuation(torch.zeros_like(y), beam, CHEST, True).continued is False


@pytest.mark.filterwarnings("ignore:no volume explains", "ignore:the X-rays show")
@pytest.mark.parametrize("method, voxels", [
    pytest.param("phydict_learned", CHEST, marks=pytest.mark.slow), (CGLS(8), HALF)])
def test_a_patient_who_goes_on_is_found_better_where_the_rays_do(patients, method, voxels):
    beam = ConeBeam.orbit(8, 1020, 740, (112, 112), 5.0)
    y = xrays_of(WINDOW.to_mu(patients["continues"]), beam)
    truth = inside(patients["continues"], voxels)
    of_box, told, found = (reconstruct(y, replace(beam, continued=given), method=method, grid=voxels).volume
                           for given in (False, True, None))
    gains = [volume_metrics(volume[None, None], truth)["psnr"] - volume_metrics(of_box[None, None], truth)["psnr"]
             for volume in (told, found)]
    assert min(gains) > 3 and abs(gains[0] - gains[1]) < 1


UPPER = (0.0, 0.0, 96.0)


@pytest.mark.filterwarnings("ignore:no volume explains", "ignore:the X-rays show")
@pytest.mark.parametrize("method, in_box, voxels", [
    pytest.param("phydict_learned", "phydict_learned", CHEST, marks=pytest.mark.slow),
    (TV, Region(TV, Grid.box(16, 192.0, UPPER), HALF), HALF)])
def test_a_box_in_a_patient_who_goes_on_is_as_the_whole_volume_shows_it(patients, method, in_box, voxels):
    beam, n = ConeBeam.orbit(8, 1020, 740, (112, 112), 5.0), voxels.shape[0] // 4
    y, box, middle = xrays_of(WINDOW.to_mu(patients["continues"]), beam), Grid.box(2 * n, 192.0, UPPER), slice(n, 3 * n)
    truth = inside(patients["continues"], voxels)[0, 0, middle, middle, 2 * n:]
    whole = reconstruct(y, beam, method=method, grid=voxels).volume[middle, middle, 2 * n:]
    of_box, ending = (reconstruct(y, replace(beam, continued=given), method=in_box, grid=box).volume
                      for given in (None, False))
    rms = [float((volume - truth).square().mean().sqrt()) for volume in (whole, of_box, ending)]
    assert rms[1] < 1.1 * rms[0] and rms[1] < 0.5 * rms[2]


@pytest.mark.parametrize("beam", [{"beam": ORBIT.to_dict()}, ORBIT.to_dict()])
def test_a_folder_of_xrays_says_that_the_patient_goes_on(beam, tmp_path):
    save_xrays(tmp_path / "scan", torch.rand(3, 40, 40), ORBIT)
    for said in (True, False, None):
        (tmp_path / "scan" / "geometry.yaml").write_text(yaml.safe_dump(beam | {"continued": said}))
        assert load_xrays(tmp_path / "scan")["beam"].continued == said
    (tmp_path / "scan" / "geometry.yaml").write_text(yaml.safe_dump(beam | {"continued": 1}))
    with pytest.raises(ValueError, match="true or false"):
        load_xrays(tmp_path / "scan")


@pytest.mark.parametrize("order", [(2, 0, 1), (0, 2, 1), (2, 1, 0)])
@pytest.mark.parametrize("beam", [ORBIT, TILTED])
def test_whichever_axis_runs_upwards_the_same_rays_meet_the_same_and_go_on_above_and_below(order, beam):
    grid = Grid((16, 14, 12), (24.0, 27.0, 30.0))
    affine = grid.affine.copy()
    affine[:3, :3] = affine[:3, order]
    other = Grid(tuple(grid.shape[axis] for axis in order), affine=affine)
    mu, places = random_like((1, 1, *grid.shape), torch.float64), [0, 1, *(2 + axis for axis in order)]
    for continued in (False, True):
        A, B = (Projector(g, replace(beam, continued=continued), full_detector=True) for g in (grid, other))
        assert A.method == B.method
        y = A(mu)
        torch.testing.assert_close(B(mu.permute(places)), y, rtol=0, atol=1e-12)
        torch.testing.assert_close(B.T(y), A.T(y).permute(places), rtol=0, atol=1e-9)
    found = [CGLS(3).reconstruct(y[0].float(), projector).volume for projector in (A, B)]
    torch.testing.assert_close(found[1], found[0].permute(order), rtol=0, atol=0.1)
