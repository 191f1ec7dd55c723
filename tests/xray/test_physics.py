"""What the line integrals must be: chords, volumes, positions, orientation, equivariance."""

import numpy as np
import pytest
import torch
from laws import random_like
from scenes import voxel_centres

from phydict.xray import ConeBeam, Grid, Projector

pytestmark = pytest.mark.filterwarnings("ignore:the detector's pixels are finer")

METHODS = ("separable", "siddon", "eq4", "joseph", "matrix")
BEAM = ConeBeam.orbit(4, 1020, 740, (56, 56), 10.0, start=0.3)


def volume(values: np.ndarray) -> torch.Tensor:
    return torch.as_tensor(np.ascontiguousarray(values), dtype=torch.float64)[None, None]


def blob(grid: Grid, position, width=14.0) -> torch.Tensor:
    return volume(np.exp(-((voxel_centres(grid) - position) ** 2).sum(-1) / (2 * width**2)))


def chords(beam: ConeBeam, low, high) -> np.ndarray:
    """Exact lengths (K, V, U) of the rays' stretch inside the axis-aligned box [low, high]."""
    ray = beam.pixels() - beam.sources[:, None, None]
    with np.errstate(divide="ignore"):
        ends = np.stack([(end - beam.sources[:, None, None]) / ray for end in (low, high)])
    enter, leave = ends.min(0).max(-1), ends.max(0).min(-1)
    return np.clip(leave - enter, 0, None) * np.linalg.norm(ray, axis=-1)


def centroid(images: torch.Tensor) -> np.ndarray:
    """(row, column) centroids (K, 2) in pixels."""
    y = images[0].numpy()
    rows, columns = y.sum(2) / y.sum((1, 2))[:, None], y.sum(1) / y.sum((1, 2))[:, None]
    return np.stack([rows @ np.arange(y.shape[1]), columns @ np.arange(y.shape[2])], 1)


def landing(beam: ConeBeam, position) -> np.ndarray:
    """(row, column) (K, 2) where the ray through a world position meets the detectors."""
    ray = position - beam.sources
    hit = beam.sources + ray * (beam.distances / (ray * beam.normals).sum(1))[:, None] - beam.detectors
    steps = [(hit * axis).sum(1) / (axis**2).sum(1) for axis in (beam.v, beam.u)]
    return np.stack(steps, 1) + (np.array(beam.shape) - 1) / 2


@pytest.mark.parametrize("start", [0.0, 0.3, np.pi / 4])
def test_siddon_measures_the_exact_chords_of_a_box(start):
    grid = Grid((7, 9, 8), (40.0, 30.0, 35.0))
    for size in ((31, 31), (32, 32)):  # rays on voxel faces, edges and the axes as well as beside them
        beam = ConeBeam.orbit(4, 1020, 740, size, 17.0, start=start)
        y = Projector(grid, beam, "siddon")(torch.ones(1, 1, *grid.shape, dtype=torch.float64))
        np.testing.assert_allclose(y[0].numpy(), chords(beam, -grid.extent / 2, grid.extent / 2), rtol=1e-9, atol=1e-9)


def test_separable_measures_a_box_as_long_as_its_voxels():
    grid = Grid((16, 16, 16), (20.0, 20.0, 20.0))
    beam = ConeBeam.orbit(1, 1020, 740, (2, 2), 10.0)
    y = Projector(grid, beam, "separable")(torch.ones(1, 1, 16, 16, 16, dtype=torch.float64))
    np.testing.assert_allclose(y[0].numpy(), chords(beam, -grid.extent / 2, grid.extent / 2), rtol=1e-6)


@pytest.mark.parametrize("method", METHODS)
def test_the_chord_of_a_sphere(method):
    grid, radius, centre = Grid.cube(48), 110.0, np.array([30.0, -20.0, 25.0])
    mu = 0.02 * volume(np.clip((radius - np.linalg.norm(voxel_centres(grid) - centre, axis=-1)) / 8 + 0.5, 0, 1))
    y = Projector(grid, BEAM, method)(mu)[0].numpy()
    ray = BEAM.pixels() - BEAM.sources[:, None, None]
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    away = np.linalg.norm(np.cross(centre - BEAM.sources[:, None, None], ray), axis=-1)
    expected = 0.02 * 2 * np.sqrt(np.clip(radius**2 - away**2, 0, None))
    inner = away < 0.8 * radius  # nearer the rim the chord falls steeply within one voxel
    assert np.linalg.norm((y - expected)[inner]) < 0.015 * np.linalg.norm(expected[inner])
    assert abs((y - expected)[inner].mean()) < 0.005 * expected.max()
    assert np.linalg.norm(y - expected) < 0.04 * np.linalg.norm(expected)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("index", [(4, 4, 4), (7, 1, 6), (0, 8, 0)])
def test_a_voxel_sums_to_its_volume_over_the_pixel_area_at_its_magnification(method, index):
    grid, beam = Grid((9, 9, 9), (30.0, 28.0, 26.0)), ConeBeam.orbit(3, 1020, 740, (500, 450), (1.2, 1.0), start=0.3)
    if method == "eq4":  # its sum ends at the grid's faces: a border of zeros lets it reach where the voxel ends
        grid, index = Grid((11, 11, 11), grid.spacing), tuple(i + 1 for i in index)
    mu = torch.zeros(1, 1, *grid.shape, dtype=torch.float64)
    mu[0, 0][index] = 1
    total = Projector(grid, beam, method)(mu)[0].sum((1, 2)).numpy()
    ray = voxel_centres(grid)[index] - beam.sources
    depth = (ray * beam.normals).sum(1)
    slant = np.linalg.norm(ray, axis=1) / depth  # 1 / cos of the ray's angle on the detector
    np.testing.assert_allclose(total, 30 * 28 * 26 * (beam.distances / depth) ** 2 * slant / 1.2, rtol=0.01)


@pytest.mark.parametrize("method", METHODS)
def test_a_blob_lands_where_its_ray_meets_the_detector(method):
    affine = np.diag([8.0, 7.0, 6.0, 1.0])
    affine[:3, 3] = -120, -90, -100
    grid = Grid((31, 29, 32), affine=affine)  # centre off the isocentre
    beam = ConeBeam.orbit(4, 1020, 740, (300, 150), (1.5, 3.0), start=0.3)
    for position in ([3.0, 5, -7], [55, -34, 31], [-48, 52, -45]):
        found = centroid(Projector(grid, beam, method)(blob(grid, np.array(position))))
        off = (found - landing(beam, np.array(position))) * (1.5, 3.0)
        assert np.abs(off).max() < 0.3, f"{off} mm on the detector; half a voxel would show as 4 mm"


@pytest.mark.parametrize("method", METHODS)
def test_orientation(method):
    grid, beam = Grid.cube(32), ConeBeam.orbit(4, 1020, 740, (56, 56), 10.0)
    A = Projector(grid, beam, method)
    middle = 55 / 2
    right, superior = A(blob(grid, [100, 0, 0])), A(blob(grid, [0, 0, 100]))
    anterior, left = A(blob(grid, [0, 100, 0])), A(blob(grid, [-100, 0, 0]))
    assert centroid(right)[0, 1] < middle - 10 and centroid(left)[0, 1] > middle + 10  # PA: the right is on the left
    assert centroid(right)[2, 1] > middle + 10  # AP seen from the front plate: mirrored
    assert (centroid(superior)[:, 0] < middle - 10).all()
    assert centroid(anterior)[1, 1] > middle + 10  # from the left: anterior is on the right
    assert left[0, 1].sum() > 1.2 * right[0, 1].sum()  # nearer to the source, larger
    assert right[0, 3].sum() > 1.2 * left[0, 3].sum()
    assert anterior[0, 2].sum() > 1.2 * anterior[0, 0].sum()


@pytest.mark.parametrize("method", METHODS)
def test_a_quarter_turn_of_patient_and_beam_changes_nothing(method):
    grid = Grid((10, 10, 7), (30.0, 30.0, 40.0))
    mu = random_like((1, 1, 10, 10, 7))
    turned = mu.transpose(2, 3).flip(3)  # (x, y) -> (y, -x), as from PA to the patient's left
    there = Projector(grid, ConeBeam.orbit(3, 1020, 740, (20, 20), 22, start=0.2 + np.pi / 2), method)(turned)
    here = Projector(grid, ConeBeam.orbit(3, 1020, 740, (20, 20), 22, start=0.2), method)(mu)
    torch.testing.assert_close(there, here, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("method", METHODS)
def test_a_rigid_move_of_patient_and_beam_changes_nothing(method):
    rotation, _ = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))
    rotation *= np.linalg.det(rotation)
    move = np.eye(4)
    move[:3, :3], move[:3, 3] = rotation, (40, -700, 12)
    grid = Grid((9, 8, 10), (30.0, 35.0, 26.0))
    moved_grid = Grid(grid.shape, affine=move @ grid.affine)
    moved_beam = ConeBeam(*[p @ rotation.T + move[:3, 3] for p in (BEAM.sources, BEAM.detectors)],
                          BEAM.u @ rotation.T, BEAM.v @ rotation.T, BEAM.shape)
    mu = random_like((1, 1, *grid.shape))
    torch.testing.assert_close(Projector(moved_grid, moved_beam, method)(mu), Projector(grid, BEAM, method)(mu),
                               rtol=1e-7, atol=1e-7)


@pytest.mark.parametrize("method", METHODS)
def test_storing_the_volume_the_other_way_round_changes_nothing(method):
    grid = Grid((9, 8, 10), (30.0, 35.0, 26.0))
    affine = grid.affine @ np.array([[-1.0, 0, 0, 8], [0, -1, 0, 7], [0, 0, -1, 9], [0, 0, 0, 1]])
    mu = random_like((1, 1, *grid.shape))
    other = Projector(Grid(grid.shape, affine=affine), BEAM, method)(mu.flip(2, 3, 4))
    torch.testing.assert_close(other, Projector(grid, BEAM, method)(mu), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("method", [m for m in METHODS if m != "siddon"])
def test_all_methods_agree_on_a_smooth_body(method):
    grid = Grid.cube(40)
    mu = blob(grid, [20, 10, -30], 50) + 0.5 * blob(grid, [-60, 40, 20], 25) - 0.3 * blob(grid, [0, -40, 60], 20)
    found, exact = (Projector(grid, BEAM, m)(mu) for m in (method, "siddon"))
    assert (found - exact).norm() < 0.02 * exact.norm()
