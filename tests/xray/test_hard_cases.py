"""Where projectors break: rays on faces and edges, grazing sources, thin and anisotropic volumes, precision, metal."""

import numpy as np
import pytest
import torch
from laws import assert_adjoint, random_like
from scenes import voxel_centres
from scipy.ndimage import gaussian_filter, map_coordinates

from phydict.xray import ConeBeam, Grid, Projector
from phydict.xray.projectors.separable import Separable

pytestmark = pytest.mark.filterwarnings("ignore:the detector's pixels are finer")

METHODS = ("separable", "siddon", "eq4", "joseph", "matrix")
TRILINEAR = ("separable", "eq4", "joseph")
ANY_POSE = ("siddon", "eq4", "joseph", "matrix")
BOXES = ("siddon", "matrix")
BEAM = ConeBeam.orbit(3, 1020, 740, (24, 22), (21.0, 23.0), start=0.3)
TILTED = ConeBeam([[30, -700, 220], [400, 500, 250]], [[20, 480, -150], [-200, -260, -100]],
                  [[-26, 3, 0], [13, -10.4, 0]], [[3, 26, -40.0], [7.28, 9.1, -17.2653]], (14, 18))
VIEWED = [*(pytest.param(m, BEAM, id=f"{m} upright") for m in METHODS),
          *(pytest.param(m, TILTED, id=f"{m} tilted") for m in ANY_POSE)]


def stretches(grid: Grid, beam: ConeBeam, first: float, count: int) -> tuple[np.ndarray, np.ndarray]:
    """The ways (K, V, U, T) from source to pixel at which rays cross the planes `first`, `first` + 1, ... of every
    axis (voxels + `count` planes), sorted and clipped to the box that they make; and the rays (2, K, V, U, 1, 3) as
    starts and steps in voxel indices."""
    start = np.broadcast_to(grid.index(beam.sources)[:, None, None], (beam.views, *beam.shape, 3))
    step = grid.index(beam.pixels()) - start
    with np.errstate(divide="ignore", invalid="ignore"):
        crossings = [(first + np.arange(n + count) - start[..., a, None]) / step[..., a, None]
                     for a, n in enumerate(grid.shape)]
    enter = np.max([np.fmin(c[..., 0], c[..., -1]) for c in crossings], 0).clip(0, 1)
    leave = np.min([np.fmax(c[..., 0], c[..., -1]) for c in crossings], 0).clip(0, 1)
    ways = np.concatenate(crossings, -1).clip(enter[..., None], np.maximum(enter, leave)[..., None])
    return np.sort(np.nan_to_num(ways), -1), np.stack([start, step])[..., None, :]


def interpolate(mu: torch.Tensor, rays: np.ndarray, ways: np.ndarray) -> np.ndarray:
    """The trilinear value, 0 outside the grid, `ways` (K, V, U, T) along the rays."""
    at = rays[0] + ways[..., None] * rays[1]
    return map_coordinates(mu[0, 0].double().numpy(), np.moveaxis(at, -1, 0), order=1, mode="grid-constant")


def trilinear_integral(mu: torch.Tensor, grid: Grid, beam: ConeBeam) -> torch.Tensor:
    """Exact line integrals (1, K, V, U) of the trilinear interpolant with 0 outside the grid, in float64.

    Between the planes of voxel centres the interpolant is cubic along a ray, so two Gauss points per stretch suffice.
    """
    ways, rays = stretches(grid, beam, -1, 2)
    middle, half = (ways[..., 1:] + ways[..., :-1]) / 2, np.diff(ways) / 2
    total = sum((interpolate(mu, rays, middle + side * half / np.sqrt(3)) * half).sum(-1) for side in (-1, 1))
    return torch.as_tensor(total * np.linalg.norm(beam.pixels() - beam.sources[:, None, None], axis=-1))[None]


def equation_4(mu: torch.Tensor, grid: Grid, beam: ConeBeam) -> torch.Tensor:
    """The paper's Eq. 4 as it is written: the sorted crossings with the faces between voxels, values at midpoints."""
    ways, rays = stretches(grid, beam, -0.5, 1)
    total = (interpolate(mu, rays, (ways[..., 1:] + ways[..., :-1]) / 2) * np.diff(ways)).sum(-1)
    return torch.as_tensor(total * np.linalg.norm(beam.pixels() - beam.sources[:, None, None], axis=-1))[None]


def error(found: torch.Tensor, expected: torch.Tensor) -> float:
    return float((found - expected).norm() / expected.norm())


def body(grid: Grid) -> torch.Tensor:
    """A textured trunk with two lungs and a spine, in 1/mm, as the benchmarks of the projectors use."""
    at = (voxel_centres(grid) - grid.centre) / grid.extent * 2
    trunk, left, right, spine = ((((at - centre) / radii) ** 2).sum(-1) < 1 for centre, radii in (
        ((0, 0, 0), (0.9, 0.65, 2.0)), ((0.4, 0, 0.1), (0.32, 0.45, 0.75)), ((-0.4, 0, 0.1), (0.3, 0.45, 0.7)),
        ((0, -0.45, 0), (0.12, 0.12, 2.0))))
    texture = gaussian_filter(np.random.default_rng(0).normal(size=grid.shape), 1.0)
    mu = (0.02 * trunk - 0.016 * (left | right) + 0.012 * spine) * (1 + texture) * trunk
    return torch.as_tensor(mu).clamp_min(0)[None, None]


def smooth(shape, seed: int = 0) -> torch.Tensor:
    """Positive random mu (1, 1, X, Y, Z) that varies over a few voxels."""
    noise = gaussian_filter(np.random.default_rng(seed).normal(size=shape), 1.5)
    return torch.as_tensor(0.02 + 0.005 * noise / noise.std())[None, None]


def bordered(shape) -> torch.Tensor:
    """The same with a border of two voxels of 0: where mu ends inside the grid, all trilinear models end it alike."""
    inside = torch.zeros(1, 1, *shape, dtype=torch.float64)
    inside[:, :, 2:-2, 2:-2, 2:-2] = 1
    return smooth(shape) * inside


def straight(index, axis: int, grid: Grid) -> ConeBeam:
    """One ray parallel to axis 0 or 1 through voxel index `index` (whatever it holds for the axis itself)."""
    index = np.array(index, float)
    ends = np.repeat(index[None], 2, 0)
    ends[:, axis] = -50, 60
    source, pixel = ends @ grid.affine[:3, :3].T + grid.affine[:3, 3]
    return ConeBeam([source], [pixel], [np.eye(3)[1 - axis]], [np.eye(3)[2]], (1, 1))


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("offset", [(0, 0), (0.5, 0), (0, 0.5), (0.5, 0.5)], ids=["centre", "face", "face 2", "edge"])
def test_a_ray_along_an_axis_reads_its_voxels_or_the_mean_of_its_neighbours(method, axis, offset):
    grid = Grid((6, 5, 4), (20.0, 25.0, 30.0))
    mu = smooth(grid.shape)
    other = 1 - axis
    index = np.zeros(3)
    index[other], index[2] = 2 + offset[0], 1 + offset[1]
    found = Projector(grid, straight(index, axis, grid), method)(mu).item()
    lines = mu[0, 0].sum(axis) * grid.spacing[axis]  # (other, z)
    near, above = (2, 3 if offset[0] else 2), (1, 2 if offset[1] else 1)
    mean = float(np.mean([lines[i, k] for i in near for k in above]))
    upper = float(lines[near[1], above[1]])  # boxes are half-open: a face belongs to the higher index
    assert found == pytest.approx(upper if method in BOXES else mean, rel=1e-12)


@pytest.mark.parametrize("method", ANY_POSE)
def test_a_ray_through_corners_alone_reads_the_diagonal(method):
    grid = Grid((6, 6, 6), (20.0, 20.0, 20.0))
    mu = smooth(grid.shape)
    diagonal = np.ones(3) / np.sqrt(3)
    u, v = np.array([1.0, -1, 0]), np.array([1.0, 1, -2])
    found = Projector(grid, ConeBeam([-900 * diagonal], [700 * diagonal], [u], [v], (1, 1)), method)(mu).item()
    assert found == pytest.approx(float(sum(mu[0, 0, i, i, i] for i in range(6))) * 20 * np.sqrt(3), rel=1e-9)


@pytest.mark.parametrize("method", ANY_POSE)
def test_a_ray_through_upright_edges_reads_the_diagonal_of_its_slice(method):
    grid = Grid((6, 6, 5), (20.0, 20.0, 20.0))
    mu = smooth(grid.shape)
    beam = ConeBeam.orbit(1, 1020, 740, (1, 1), 1.0, start=np.pi / 4)
    found = Projector(grid, beam, method)(mu).item()
    assert found == pytest.approx(float(sum(mu[0, 0, i, i, 2] for i in range(6))) * 20 * np.sqrt(2), rel=1e-9)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("start", [0.0, np.pi / 4, 1e-9, np.pi / 4 - 1e-9])
@pytest.mark.parametrize("voxels, pixels", [(16, (15, 17)), (15, (16, 16))], ids=["odd on even", "even on odd"])
def test_axis_and_45_degree_views(method, start, voxels, pixels):
    grid, beam = Grid.cube(voxels), ConeBeam.orbit(4, 1020, 740, pixels, 34.0, start=start)
    mu = bordered(grid.shape)
    y = Projector(grid, beam, method)(mu)
    tolerance = {"separable": 5e-3, "joseph": 0.015, "eq4": 0.02}.get(method, 0.06)
    assert error(y, trilinear_integral(mu, grid, beam)) < tolerance
    nearby = Projector(grid, ConeBeam.orbit(4, 1020, 740, pixels, 34.0, start=start + 1e-7), method)(mu)
    assert error(y, nearby) < (0.02 if method in BOXES else 1e-6)  # trilinear models are continuous, boxes are not


def grazing(gap: float) -> tuple[Grid, ConeBeam]:
    """A source `gap` mm before the middle of the volume's posterior face, with rays up to 60 degrees off."""
    grid = Grid((16, 16, 16), (10.0, 10.0, 10.0))
    return grid, ConeBeam.orbit(1, 400, 80 + gap, (21, 21), 65.0)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("gap", [0.01, 3.0])
def test_a_source_that_touches_the_volume(method, gap):
    grid, beam = grazing(gap)
    mu = smooth(grid.shape)
    A = Projector(grid, beam, method)
    y = A(mu)
    assert y.isfinite().all() and y.min() > 0
    # Off the outermost centres the models differ: trilinear mu falls to 0, boxes do not. The source is in that skin.
    assert error(y, trilinear_integral(mu, grid, beam)) < {"separable": 0.01, "joseph": 0.02}.get(method, 0.04)
    assert_adjoint(A, A.T, mu.shape)


@pytest.mark.parametrize("method, limit", [("separable", 1), ("joseph", 1), ("siddon", 1), ("matrix", 1), ("eq4", 1.2)])
def test_nothing_behind_the_source_is_seen(method, limit):
    grid, beam = grazing(0.01)
    mu = torch.zeros(1, 1, 16, 16, 16, dtype=torch.float64)
    mu[:, :, :, 0] = 1  # the skin that the source touches: at most one voxel thick, but for slanting midpoints of eq4
    ray = np.linalg.norm(beam.pixels() - beam.sources[:, None, None], axis=-1) / beam.distances[0]
    assert (Projector(grid, beam, method)(mu)[0].numpy() / (10 * ray)).max() < limit + 1e-6


def test_nothing_behind_the_detector_is_seen():
    grid, beam = Grid((16, 16, 16), (10.0, 10.0, 10.0)), ConeBeam.orbit(1, 340.01, 260, (31, 31), 26.0)
    mu = torch.zeros(1, 1, 16, 16, 16, dtype=torch.float64)
    mu[:, :, :, -1] = 1  # the skin that the detector touches: an eighth of its interpolant lies behind
    assert error(Projector(grid, beam, "separable")(mu), trilinear_integral(mu, grid, beam)) < 0.05


@pytest.mark.parametrize("method", METHODS)
def test_rays_that_miss_read_and_give_exactly_nothing(method):
    grid, beam = Grid((10, 12, 8), (10.0, 9.0, 12.0)), ConeBeam.orbit(4, 1020, 740, (40, 41), 14.0, start=0.3)
    A = Projector(grid, beam, method)
    wider = Grid((12, 14, 10), grid.spacing)
    misses = Projector(wider, beam, "siddon")(torch.ones(1, 1, 12, 14, 10, dtype=torch.float64)) == 0
    assert 0.3 < misses.double().mean() < 0.95
    assert (A(smooth(grid.shape))[misses] == 0).all()
    assert (A.T(random_like((1, 4, 40, 41)) * misses) == 0).all()
    beside = ConeBeam(beam.sources, beam.detectors + 60 * beam.u, beam.u, beam.v, beam.shape)
    assert (Projector(grid, beside, method)(smooth(grid.shape)) == 0).all()


@pytest.mark.parametrize("method, beam", VIEWED)
def test_empty_borders_columns_and_slices_are_passed_over_without_a_trace(method, beam):
    grid = Grid((14, 12, 13), (24.0, 26.0, 22.0))
    whole, part = smooth(grid.shape), torch.zeros(1, 1, *grid.shape, dtype=torch.float64)
    part[:, :, 3:9, 2:10, 4:8] = whole[:, :, 3:9, 2:10, 4:8]
    part[:, :, 5, 4] = part[:, :, 6, 5:8] = 0  # holes
    A = Projector(grid, beam, method)
    torch.testing.assert_close(A(part) + A(whole - part), A(whole), rtol=1e-11, atol=1e-11)
    assert A(part).norm() > 0.1 * A(whole).norm()


def test_the_compiled_loops_pass_over_what_the_sparse_products_multiply_by_zero():
    grid = Grid((14, 12, 13), (24.0, 26.0, 22.0))
    mu = torch.zeros(3, *grid.shape, dtype=torch.float64)
    mu[0, 3:9, 2:10, 4:8] = smooth((6, 8, 4))[0, 0]
    mu[1, 13, 0, 12] = mu[1, 0, 11, 0] = 1.0
    A = Separable(grid, BEAM)
    torch.testing.assert_close(A.forward(mu), A.sparse.forward(mu), rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("shape", [(1, 16, 16), (16, 1, 16), (16, 16, 1), (1, 1, 16), (1, 1, 1)])
def test_volumes_of_one_voxels_thickness(method, shape):
    grid = Grid(shape, (20.0, 20.0, 20.0))
    beam = ConeBeam.orbit(2, 1020, 740, (200, 220), (2.5, 4.0), start=np.radians(20))
    A = Projector(grid, beam, method)
    y = A(torch.ones(1, 1, *shape, dtype=torch.float64))
    # All matter is seen: each voxel sums to its volume over the pixel area at its magnification.
    ways = voxel_centres(grid).reshape(-1, 1, 3) - beam.sources
    depth = np.einsum("nka,ka->nk", ways, beam.normals)
    slant = np.linalg.norm(ways, axis=2) / depth
    expected = (20**3 * (beam.distances / depth) ** 2 * slant / (2.5 * 4)).sum(0)
    if method == "eq4":  # its sum ends at the faces, where the interpolant is half of mu
        assert (y[0].sum((1, 2)).numpy() < 1.001 * expected).all()
    else:
        np.testing.assert_allclose(y[0].sum((1, 2)).numpy(), expected, rtol=0.02)
    assert_adjoint(A, A.T, (1, 1, *shape))


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("spacing", [0.1, 10.0])
def test_a_scene_of_another_size_measures_as_much_longer(method, spacing):
    mu = smooth((12, 12, 12))
    there = Projector(Grid((12, 12, 12), (spacing,) * 3), _scaled(BEAM, spacing / 24), method)
    here = Projector(Grid((12, 12, 12), (24.0,) * 3), BEAM, method)
    torch.testing.assert_close(there(mu) * (24 / spacing), here(mu), rtol=1e-7, atol=1e-7)
    assert error(there(mu.float()).double(), there(mu)) < 1e-6


def _scaled(beam: ConeBeam, factor: float) -> ConeBeam:
    return ConeBeam(*[factor * part for part in (beam.sources, beam.detectors, beam.u, beam.v)], beam.shape)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("shape, spacing", [((40, 40, 4), (1.0, 1.0, 20.0)), ((4, 40, 40), (20.0, 1.0, 1.0)),
                                            ((40, 4, 40), (1.0, 20.0, 1.0))])
def test_voxels_twenty_times_longer_one_way(method, shape, spacing):
    grid, beam = Grid(shape, spacing), ConeBeam.orbit(3, 1020, 740, (20, 20), 3.0, start=0.3)
    mu, A = smooth(shape), Projector(grid, beam, method)
    limit = {"separable": 3e-3, "joseph": 2e-3, "eq4": 0.08}.get(method, 0.04)
    assert error(A(mu), trilinear_integral(mu, grid, beam)) < limit
    assert_adjoint(A, A.T, mu.shape)
    assert error(A(mu.float()).double(), A(mu)) < 2e-6


def test_fine_voxels_far_away():
    grid, beam = Grid((24, 24, 24), (0.3,) * 3), ConeBeam.orbit(3, 5010, 5000, (20, 20), 0.4, start=0.3)
    mu = smooth(grid.shape)
    for method in METHODS:
        assert error(Projector(grid, beam, method)(mu.float()).double(), Projector(grid, beam, method)(mu)) < 2e-6


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("voxels, pixels, memory", [
    (64, 64, 2**29), pytest.param(256, 448, 2**33, marks=pytest.mark.slow)], ids=["64", "256"])
def test_float32_is_float64_to_1e_5(voxels, pixels, memory, method):
    grid, beam = Grid.cube(voxels, 250), ConeBeam.orbit(1, 1020, 800, (pixels, pixels), 448 / pixels, start=0.3)
    mu, y = body(grid), random_like((1, 1, pixels, pixels)).abs()
    A = Projector(grid, beam, method, memory)
    assert max(error(A(mu.float()).double(), A(mu)), error(A.T(y.float()).double(), A.T(y))) < 1e-5


@pytest.mark.parametrize("method", METHODS)
def test_metal_is_fifty_times_its_voxels(method):
    grid = Grid.cube(20)
    A, mu = Projector(grid, BEAM, method), smooth(grid.shape)
    metal = torch.zeros_like(mu)
    metal[:, :, 9:11, 8:10, 10:12] = mu[:, :, 9:11, 8:10, 10:12]
    torch.testing.assert_close(A(mu + 49 * metal), A(mu) + 49 * A(metal), rtol=1e-11, atol=1e-11)
    strong = (mu + 49 * metal).float()
    assert error(A(strong).double(), A(strong.double())) < 1e-6 and A(metal).max() > 10 * 0.02


@pytest.mark.parametrize("method", METHODS)
def test_an_empty_volume_gives_zeros_and_a_constant_one_its_chords(method):
    grid = Grid((12, 12, 12), (20.0, 20.0, 20.0))
    A = Projector(grid, BEAM, method)
    assert (A(torch.zeros(2, 1, 12, 12, 12)) == 0).all() and (A.T(torch.zeros(1, 3, *BEAM.shape)) == 0).all()
    ones = torch.ones(1, 1, 12, 12, 12, dtype=torch.float64)
    chords = Projector(grid, BEAM, "siddon")(ones)
    middle = (slice(None), slice(None), slice(9, -9), slice(9, -9))  # rays that leave by opposite faces
    assert error(A(ones)[middle], chords[middle]) < {"eq4": 0.02, "separable": 0.008, "joseph": 0.005}.get(method, 1e-9)


@pytest.mark.parametrize("method", METHODS)
def test_one_view_and_sixty_four(method):
    grid, beam = Grid.cube(10), ConeBeam.orbit(64, 1020, 740, (9, 8), 55.0, start=0.1)
    mu = smooth(grid.shape)
    A = Projector(grid, beam, method)
    y = A(mu)
    for k in (0, 33, 63):
        one = Projector(grid, beam.select([k]), method)
        torch.testing.assert_close(one(mu), y[:, k:k + 1], rtol=1e-12, atol=1e-12)
    apart = sum(Projector(grid, beam.select([k]), method).T(y[:, k:k + 1]) for k in range(64))
    torch.testing.assert_close(A.T(y), apart, rtol=1e-11, atol=1e-11)


@pytest.mark.parametrize("method", METHODS)
def test_the_order_of_views_is_the_order_of_images(method):
    grid, order = Grid.cube(12), [2, 0, 1]
    mu, y = smooth(grid.shape), random_like((1, 3, *BEAM.shape))
    A, B = Projector(grid, BEAM, method), Projector(grid, BEAM.select(order), method)
    torch.testing.assert_close(B(mu), A(mu)[:, order], rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(B.T(y[:, order]), A.T(y), rtol=1e-11, atol=1e-11)


@pytest.mark.parametrize("beam", [BEAM, TILTED], ids=["upright", "tilted"])
def test_the_memory_budget_does_not_show_in_the_plane_sweep(beam):
    grid = Grid((14, 12, 13), (24.0, 26.0, 22.0))
    mu, y = torch.cat([smooth(grid.shape), smooth(grid.shape, 1)]), random_like((2, beam.views, *beam.shape))
    whole = Projector(grid, beam, "joseph")
    for memory in (1, 30_000, 300_000):
        A = Projector(grid, beam, "joseph", memory=memory)
        torch.testing.assert_close(A(mu), whole(mu), rtol=1e-12, atol=1e-12)
        torch.testing.assert_close(A.T(y), whole.T(y), rtol=1e-11, atol=1e-11)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("scene", ["axis views", "grazing", "thin"])
def test_gradients_are_finite_and_what_finite_differences_say(method, scene):
    grid, beam = {"axis views": (Grid.cube(12), ConeBeam.orbit(4, 1020, 740, (12, 13), 40.0)),
                  "grazing": grazing(0.01), "thin": (Grid((1, 12, 9), (30.0, 30.0, 30.0)), BEAM)}[scene]
    A, mu = Projector(grid, beam, method), smooth(grid.shape).requires_grad_()
    measured = A(smooth(grid.shape, 1)).detach()

    def loss(at):
        return (A(at) - measured).square().mean()

    (gradient,) = torch.autograd.grad(loss(mu), mu)
    assert gradient.isfinite().all()
    direction = random_like(mu.shape)
    with torch.no_grad():  # the loss is quadratic: central differences are exact
        difference = (loss(mu + 1e-3 * direction) - loss(mu - 1e-3 * direction)) / 2e-3
    assert float((gradient * direction).sum()) == pytest.approx(float(difference), rel=1e-8)


@pytest.mark.parametrize("beam", [BEAM, TILTED, ConeBeam.orbit(4, 1020, 740, (15, 16), 30.0)],
                         ids=["upright", "tilted", "axis views"])
def test_eq4_is_equation_4(beam):
    grid = Grid((14, 12, 13), (24.0, 26.0, 22.0))
    mu = smooth(grid.shape)
    torch.testing.assert_close(Projector(grid, beam, "eq4")(mu), equation_4(mu, grid, beam), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("method, limit", [("separable", 2e-3), ("joseph", 6e-3), ("eq4", 1.2e-2), ("siddon", 2e-2),
                                           ("matrix", 2e-2)])
def test_distance_to_the_exact_integral_of_the_trilinear_body(method, limit):
    grid, beam = Grid.cube(64, 250), ConeBeam.orbit(3, 1020, 800, (24, 24), 14.0, start=0.3)
    mu = body(grid)
    assert error(Projector(grid, beam, method)(mu), trilinear_integral(mu, grid, beam)) < limit


@pytest.mark.parametrize("method, beam", VIEWED)
def test_blobs_are_met_the_better_the_finer_the_grid(method, beam):
    beam = ConeBeam(beam.sources, beam.detectors, beam.u / 4, beam.v / 4, (64, 64))
    ray = beam.pixels() - beam.sources[:, None, None]
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    position, width = np.array([25.0, -30.0, 20.0]), 40.0
    away = np.linalg.norm(np.cross(position - beam.sources[:, None, None], ray), axis=-1)
    expected = torch.as_tensor(np.sqrt(2 * np.pi) * width * np.exp(-(away / width) ** 2 / 2))[None]
    errors = []
    for voxels in (12, 24, 48):
        grid = Grid.cube(voxels, 360)
        mu = np.exp(-((voxel_centres(grid) - position) ** 2).sum(-1) / (2 * width**2))
        errors.append(error(Projector(grid, beam, method)(torch.as_tensor(mu)[None, None]), expected))
    order = 1.6 if method in TRILINEAR else 0.9  # second order, against first
    assert np.log2(errors[0] / errors[1]) > order and np.log2(errors[1] / errors[2]) > order, errors
