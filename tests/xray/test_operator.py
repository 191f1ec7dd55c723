"""The projector as a linear operator: exact adjoint, autograd, norm, batches, bad input."""

import numpy as np
import pytest
import torch
from laws import assert_adjoint, assert_gradient_is_adjoint, assert_linear, random_like

from phydict.xray import ConeBeam, Grid, Projector
from phydict.xray.separable import Separable

METHODS = ("separable", "siddon", "eq4", "joseph", "matrix")
BEAM = ConeBeam.orbit(3, 1020, 740, (14, 18), (31.0, 27.0), start=0.3)


def turned(degrees: float, shape, spacing, centre) -> Grid:
    """A grid turned about the superior axis and moved off the isocentre."""
    cos, sin = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    affine = np.eye(4)
    affine[:3, :3] = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]]) * spacing
    affine[:3, 3] = centre - affine[:3, :3] @ ((np.array(shape) - 1) / 2)
    return Grid(shape, affine=affine)


GRIDS = {
    "cube": Grid.cube(12),
    "anisotropic": Grid((9, 14, 7), (30.0, 17.0, 41.0)),
    "off centre": turned(0, (10, 8, 11), (21, 25, 19), (35, -28, 17)),
    "turned": turned(33, (10, 8, 11), (21, 25, 19), (-15, 8, 37)),
    "patient's left first": Grid((9, 10, 8), affine=np.array(
        [[-30.0, 0, 0, 120], [0, -25, 0, 112.5], [0, 0, 35, -122.5], [0, 0, 0, 1]])),
    "fine slices": Grid((8, 8, 60), (40.0, 40.0, 5.0)),
    "one slice": Grid((8, 8, 1), (40.0, 40.0, 60.0)),
    "one voxel": Grid((1, 1, 1), (90.0, 80.0, 100.0)),
}


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("grid", GRIDS.values(), ids=GRIDS.keys())
def test_the_transpose_is_the_exact_adjoint(method, grid):
    A = Projector(grid, BEAM, method)
    assert_adjoint(A, A.T, (2, 1, *grid.shape), torch.float64, 1e-10)
    assert_adjoint(A, A.T, (2, 1, *grid.shape), torch.float32, 1e-5)


def test_the_transpose_is_the_exact_adjoint_for_tilted_detectors():
    tilted = ConeBeam([[30, -700, 220]], [[10, 320, -90]], [[-26, 3, 0]], [[3, 26, -40.0]], (14, 18))
    A = Projector(GRIDS["turned"], tilted)
    assert A.method == "siddon"
    assert_adjoint(A, A.T, (1, 1, *A.grid.shape), torch.float64, 1e-10)


def test_slabs_do_not_show_in_siddon(monkeypatch):
    grid = GRIDS["anisotropic"]
    A, y = Projector(grid, BEAM, "siddon"), random_like((1, 3, *BEAM.shape))
    whole = A.T(y)
    monkeypatch.setattr("phydict.xray.siddon.SLAB", 3)
    torch.testing.assert_close(A.T(y), whole, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("grid", GRIDS.values(), ids=GRIDS.keys())
def test_sparse_products_are_the_compiled_separable_operator(grid, monkeypatch):
    monkeypatch.setattr("phydict.xray.separable_sparse.BLOCK_VALUES", 5000)
    beam = ConeBeam.orbit(3, 1020, 740, (23, 71), (19.0, 7.0), start=0.3)
    A = Separable(grid, beam)
    mu, y = random_like((2, *grid.shape)), random_like((2, 3, *beam.shape))
    torch.testing.assert_close(A.sparse.forward(mu), A.forward(mu), rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(A.sparse.adjoint(y), A.adjoint(y), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("method", METHODS)
def test_linear_and_differentiable_through_both_directions(method):
    grid = GRIDS["turned"]
    A = Projector(grid, BEAM, method)
    volume, images = (2, 1, *grid.shape), (2, 3, *BEAM.shape)
    assert_linear(A, volume)
    assert_gradient_is_adjoint(A, A.T, volume)
    assert_gradient_is_adjoint(A.T, A, images)


@pytest.mark.parametrize("method", METHODS)
def test_gradcheck(method):
    A = Projector(Grid((3, 2, 3), (60.0, 70.0, 50.0)), ConeBeam.orbit(2, 1020, 740, (3, 4), 60, start=0.2), method)
    assert torch.autograd.gradcheck(A, random_like((1, 1, 3, 2, 3)).requires_grad_())
    assert torch.autograd.gradcheck(A.T, random_like((1, 2, 3, 4)).requires_grad_())


@pytest.mark.parametrize("method", METHODS)
def test_selecting_views_and_batching_change_nothing(method):
    grid = GRIDS["off centre"]
    mu = random_like((3, 1, *grid.shape))
    y = Projector(grid, BEAM, method)(mu)
    for k in range(3):
        alone = Projector(grid, BEAM.select(k), method)(mu[k:k + 1])
        torch.testing.assert_close(alone, y[k:k + 1, k:k + 1], rtol=0, atol=0)


@pytest.mark.parametrize("method", METHODS)
def test_float32_agrees_with_float64(method):
    A = Projector(Grid.cube(16), BEAM, method)
    mu = random_like((1, 1, 16, 16, 16)).abs()
    assert (A(mu.float()).double() - A(mu)).norm() < 1e-6 * A(mu).norm()


@pytest.mark.parametrize("method", METHODS)
def test_threads_change_nothing(method):
    A, threads = Projector(GRIDS["fine slices"], BEAM, method), torch.get_num_threads()
    mu, y = random_like((1, 1, *A.grid.shape), torch.float32), random_like((1, 3, *BEAM.shape), torch.float32)
    try:
        torch.set_num_threads(1)
        one = A(mu), A.T(y)
        torch.set_num_threads(2)
        assert torch.equal(A(mu), one[0])
        assert torch.equal(A.T(y), one[1])
    finally:
        torch.set_num_threads(threads)


@pytest.mark.parametrize("method", METHODS)
def test_norm_is_the_largest_singular_value(method):
    A = Projector(Grid((4, 3, 5), (60.0, 70.0, 50.0)), BEAM, method)
    matrix = torch.stack([A(e.view(1, 1, 4, 3, 5)).flatten() for e in torch.eye(60, dtype=torch.float64)])
    assert A.norm() == pytest.approx(float(torch.linalg.matrix_norm(matrix, 2)), rel=1e-3)


def test_auto_takes_the_fast_method_where_the_poses_permit():
    grid = GRIDS["turned"]
    assert Projector(grid, BEAM).method == "separable"
    lying = Grid((8, 8, 8), affine=np.array([[30.0, 0, 0, -105], [0, 0, 30, -105], [0, 30, 0, -105], [0, 0, 0, 1]]))
    assert Projector(lying, BEAM).method == "siddon"
    with pytest.raises(ValueError, match="'separable' needs detectors"):
        Projector(lying, BEAM, "separable")
    with pytest.raises(ValueError, match="no projector method 'fast'; choose one of auto, separable, siddon"):
        Projector(grid, BEAM, "fast")


def test_bad_input_is_told_what_was_expected():
    A = Projector(Grid.cube(8), BEAM, "siddon")
    with pytest.raises(ValueError, match=r"mu must be \(batch, 1, 8, 8, 8\), but shape \(8, 8, 8\)"):
        A(torch.zeros(8, 8, 8))
    with pytest.raises(ValueError, match=r"xrays must be \(batch, 3, 14, 18\)"):
        A.T(torch.zeros(1, 3, 18, 14))
    with pytest.raises(ValueError, match="float32 or float64, but torch.float16"):
        A(torch.zeros(1, 1, 8, 8, 8, dtype=torch.float16))
    with pytest.raises(ValueError, match="'siddon' runs on the CPU, but a tensor on meta"):
        A(torch.zeros(1, 1, 8, 8, 8, device="meta"))
    with pytest.raises(ValueError, match="detector lies inside"):
        Projector(Grid.cube(8, 700), BEAM)
