"""The projector as a linear operator: exact adjoint, autograd, norm, batches, bad input."""

import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
from laws import assert_adjoint, assert_gradient_is_adjoint, assert_linear, random_like

from phydict.xray import ConeBeam, Grid, Projector
from phydict.xray.projectors.joseph import Joseph
from phydict.xray.projectors.projector import _engine
from phydict.xray.projectors.separable import Separable
from phydict.xray.projectors.system_matrix import SystemMatrix

pytestmark = pytest.mark.filterwarnings("ignore:the detector's pixels are finer")

METHODS = ("separable", "siddon", "eq4", "joseph", "matrix")
BEAM = ConeBeam.orbit(3, 1020, 740, (14, 18), (31.0, 27.0), start=0.3)

TILTED = ConeBeam([[30, -700, 220]], [[10, 320, -90]], [[-26, 3, 0]], [[3, 26, -40.0]], (14, 18))


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


@pytest.mark.parametrize("spacing", [5.0, 7.5, 12.0])
def test_rays_in_the_faces_between_voxels_meet_the_same_ones_forwards_and_back(spacing):
    """Upright rays through odd columns of even grids, whose step across is rounding alone."""
    for views, pixel in ((1, 13.7), (2, 17.9), (4, 21.3)):
        for distance, start in ((613, 0), (740, 90)):
            beam = ConeBeam.orbit(views, 1000, distance, (15, 21), pixel, start_degrees=start)
            A = Projector(Grid((16, 10, 16), spacing), beam, "siddon", full_detector=True)
            assert_adjoint(A, A.T, (1, 1, *A.grid.shape), torch.float64, 1e-12)


@pytest.mark.parametrize("method", [m for m in METHODS if m != "separable"])
def test_the_transpose_is_the_exact_adjoint_for_tilted_detectors(method):
    A = Projector(GRIDS["turned"], TILTED, method)
    assert_adjoint(A, A.T, (1, 1, *A.grid.shape), torch.float64, 1e-10)


@pytest.mark.parametrize("method", ["siddon", "eq4"])
@pytest.mark.parametrize("beam", [BEAM, TILTED], ids=["upright", "tilted"])
def test_slabs_do_not_show_in_a_tracers_adjoint(method, beam, monkeypatch):
    A, y = Projector(GRIDS["anisotropic"], beam, method), random_like((1, beam.views, *beam.shape))
    whole = A.T(y)
    monkeypatch.setattr("phydict.xray.projectors.tracer.SLAB", 3)
    torch.testing.assert_close(A.T(y), whole, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("grid", GRIDS.values(), ids=GRIDS.keys())
def test_sparse_products_are_the_compiled_separable_operator(grid, monkeypatch):
    monkeypatch.setattr("phydict.xray.projectors.separable_sparse.BLOCK_VALUES", 5000)
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
        sums = 1e-12 if method in ("joseph", "matrix") else 0  # of several views or volumes, in another order
        torch.testing.assert_close(alone, y[k:k + 1, k:k + 1], rtol=0, atol=sums)


@pytest.mark.parametrize("method", METHODS)
def test_a_batch_of_no_case_gives_none(method):
    A = Projector(Grid.cube(8), BEAM, method)
    assert A(torch.zeros(0, 1, 8, 8, 8)).shape == (0, BEAM.views, *BEAM.shape)
    assert A.T(torch.zeros(0, BEAM.views, *BEAM.shape)).shape == (0, 1, 8, 8, 8)


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


def test_the_first_projection_of_a_process_leaves_torch_its_threads():
    code = """if True:
        import torch
        from phydict.xray import ConeBeam, Grid, Projector
        torch.set_num_threads(1)
        project = Projector(Grid.cube(8), ConeBeam.orbit(1, 1020, 740, (4, 4), 100.0), full_detector=True)
        project(torch.rand(1, 1, 8, 8, 8))
        print(torch.get_num_threads())"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=Path(__file__).parents[2])
    assert done.stdout.strip() == "1", done.stderr


@pytest.mark.parametrize("method", METHODS)
def test_norm_is_the_largest_singular_value(method):
    A = Projector(Grid((4, 3, 5), (60.0, 70.0, 50.0)), BEAM, method)
    matrix = torch.stack([A(e.view(1, 1, 4, 3, 5)).flatten() for e in torch.eye(60, dtype=torch.float64)])
    assert A.norm() == pytest.approx(float(torch.linalg.matrix_norm(matrix, 2)), rel=1e-3)


def test_auto_looks_at_pose_size_memory_and_device_and_says_what_it_took():
    upright = Projector(GRIDS["turned"], BEAM, device="cuda")
    assert upright.method == "separable" and "upright" in upright.reason
    small = Projector(GRIDS["turned"], TILTED, device="cuda")
    assert small.method == "matrix" and "budget" in small.reason
    assert Projector(GRIDS["turned"], TILTED, memory=1000).method == "siddon"
    elsewhere = Projector(GRIDS["turned"], TILTED, memory=1000, device="cuda")
    assert elsewhere.method == "joseph" and "cuda" in elsewhere.reason and "1,000" in elsewhere.reason
    assert Projector(GRIDS["turned"], TILTED, "eq4").reason == "it was requested"


def test_impossible_choices_are_refused_with_a_reason():
    with pytest.raises(ValueError, match="the projector separable needs detectors"):
        Projector(GRIDS["turned"], TILTED, "separable")
    with pytest.raises(ValueError, match="no projector method 'fast'; choose one of auto, separable, siddon, eq4"):
        Projector(GRIDS["turned"], BEAM, "fast")
    with pytest.raises(ValueError, match=r"the system matrix needs [\d,]+ bytes in float32, but .* is 1,000 bytes"):
        Projector(GRIDS["turned"], TILTED, "matrix", memory=1000)
    with pytest.raises(ValueError, match="of a Grid and a ConeBeam, in this order, but ConeBeam and Grid were given"):
        Projector(BEAM, GRIDS["turned"])
    with pytest.raises(ValueError, match="memory is a budget in bytes > 0, but 0"):
        Projector(GRIDS["turned"], TILTED, memory=0)


@pytest.mark.parametrize("method", METHODS)
def test_nothing_is_kept_for_the_gradient(method):
    """So that memory does not grow with the samples along a ray."""
    A, kept = Projector(GRIDS["turned"], BEAM, method), []
    mu, y = random_like((2, 1, *A.grid.shape)).requires_grad_(), random_like((2, 3, *BEAM.shape)).requires_grad_()
    with torch.autograd.graph.saved_tensors_hooks(lambda tensor: kept.append(tensor.shape), lambda tensor: tensor):
        nodes = [A(mu).grad_fn, A.T(y).grad_fn]
    assert not kept
    while nodes:
        node = nodes.pop()
        held = [value for value in getattr(node, "__dict__", {}).values() if isinstance(value, torch.Tensor)]
        assert not held, f"{node} holds {[tuple(value.shape) for value in held]}"
        nodes += [parent for parent, _ in node.next_functions if parent]


def test_the_plane_sweep_keeps_as_many_rays_as_its_budget_holds():
    A = Joseph(GRIDS["turned"], TILTED, 10**7)
    for dtype in (torch.float32, torch.float64):
        A.adjoint(torch.zeros(1, 1, *TILTED.shape, dtype=dtype))
    tables = [sweep for sweeps in A._tables.values() for sweep in sweeps]
    held = sum(part.nbytes for sweep in tables for part in sweep[1:] if part is not None)
    assert len(A._tables) == 2 and held > 1000
    A.adjoint(torch.zeros(1, 1, *TILTED.shape))
    again = [sweep for sweeps in A._tables.values() for sweep in sweeps]
    assert all(new is old for new, old in zip(again, tables, strict=True))  # made once
    for memory in (1, held, 2 * held):
        A = Joseph(GRIDS["turned"], TILTED, memory)
        for dtype in (torch.float32, torch.float64):
            A.adjoint(torch.zeros(1, 1, *TILTED.shape, dtype=dtype))
        held_now = sum(sweep.nbytes for sweeps in A._tables.values() for sweep in sweeps)
        assert held_now + A.memory <= memory and (held_now == held) == (memory == 2 * held)


def test_rays_that_miss_are_not_even_stored():
    grid, beam = GRIDS["turned"], BEAM
    wide = ConeBeam(beam.sources, beam.detectors, beam.u, beam.v, tuple(3 * n for n in beam.shape))
    narrow, wider = (Projector(grid, b, "siddon")(torch.ones(1, 1, *grid.shape)) for b in (beam, wide))
    assert (wider > 0).sum() > (narrow > 0).sum() and (wider == 0).double().mean() > 0.5
    crossed = SystemMatrix(grid, wide, 10**8)._crossed
    assert (crossed[(wider == 0)[0].numpy()] <= 1).all()  # a ray may be counted for an edge that it touches
    A = Joseph(grid, wide, 10**8)
    A.adjoint(torch.zeros(1, 3, *wide.shape))
    around = Grid(tuple(n + 2 for n in grid.shape), affine=_padded(grid))
    seen = Projector(around, wide, "siddon")(torch.ones(1, 1, *around.shape))[0].flatten(1) > 0
    for (view, *_), sweeps in A._tables.items():
        assert all(seen[view, sweep.pixels].all() for sweep in sweeps)


def _padded(grid: Grid) -> np.ndarray:
    """The affine of a grid that is one voxel larger on every side."""
    affine = grid.affine.copy()
    affine[:3, 3] -= affine[:3, :3].sum(1)
    return affine


def test_the_matrix_takes_the_bytes_that_it_announces():
    A = SystemMatrix(GRIDS["turned"], TILTED, 10**7)
    for dtype in (torch.float32, torch.float64):
        A.forward(torch.zeros(1, *A.grid.shape, dtype=dtype))
        tables = A._tables[dtype, torch.device("cpu")]
        assert len(A._tables) == (1 if dtype == torch.float32 else 2)
        held = sum(part.nbytes for t in tables for part in (t.values(), t.col_indices(), t.crow_indices()))
        assert held == SystemMatrix.bytes_for(A.grid, TILTED, dtype)
    small = SystemMatrix(A.grid, TILTED, held)  # one precision at a time
    for dtype in (torch.float32, torch.float64, torch.float32):
        small.forward(torch.zeros(1, *A.grid.shape, dtype=dtype))
        assert list(small._tables) == [(dtype, torch.device("cpu"))]
    between = (SystemMatrix.bytes_for(A.grid, TILTED, torch.float32) + held) // 2
    with pytest.raises(ValueError, match=f"{held:,} bytes in float64"):
        Projector(A.grid, TILTED, "matrix", memory=between)(torch.zeros(1, 1, *A.grid.shape, dtype=torch.float64))


@pytest.mark.parametrize("beam", [BEAM, TILTED], ids=["upright", "tilted"])
def test_the_stored_matrix_is_siddon(beam):
    grid = GRIDS["turned"]
    A, B = Projector(grid, beam, "matrix"), Projector(grid, beam, "siddon")
    mu, y = random_like((2, 1, *grid.shape)), random_like((2, beam.views, *beam.shape))
    torch.testing.assert_close(A(mu), B(mu), rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(A.T(y), B.T(y), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("method", METHODS)
def test_projectors_of_the_same_geometry_share_what_they_computed(method):
    grid, beam = GRIDS["anisotropic"], BEAM
    A = Projector(grid, beam, method)
    A.norm()
    again = Projector(Grid(grid.shape, affine=grid.affine.copy()), ConeBeam(**beam.to_dict()), method)
    assert again._engine is A._engine and again._engine.norm == A.norm()
    assert Projector(grid, beam.select([2, 1, 0]), method)._engine is not A._engine
    assert Projector(GRIDS["turned"], beam, method)._engine is not A._engine


def test_whenever_other_threads_make_projectors_one_that_is_made_is_its_own():
    grid, made = Grid.cube(4), []

    def others_run(frame, event, _):
        if frame.f_code is _engine.__code__:
            made.extend(Projector(grid, BEAM.select([k]), full_detector=True) for k in (0, 1))
            return others_run

    beam, before = BEAM.select([2]), sys.gettrace()
    sys.settrace(others_run)
    try:
        again = [Projector(grid, beam, full_detector=True) for _ in range(2)]
    finally:
        sys.settrace(before)
    assert made and all(A._engine.operator.beam.same_as(beam) for A in again)


def test_a_detector_finer_than_the_grid_is_warned_of_with_the_binning_that_helps():
    fine = ConeBeam.orbit(3, 1020, 740, (56, 72), (7.75, 6.75))
    grid = Grid.cube(12)
    with pytest.warns(UserWarning, match=r"finer than this grid can resolve: beam\.binned\(2\)"):
        Projector(grid, fine)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        Projector(grid, fine, full_detector=True)
        Projector(grid, fine.binned(2))


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")
@pytest.mark.parametrize("method", ["separable", "siddon", "eq4", "joseph", "matrix"])
def test_a_tensor_on_another_device_gives_what_the_cpu_gives(method):
    A = Projector(Grid.cube(8), BEAM, method)
    mu, y = torch.rand(1, 1, 8, 8, 8, dtype=torch.float64), torch.rand(1, 3, 14, 18, dtype=torch.float64)
    for found, expected in ((A(mu.cuda()), A(mu)), (A.T(y.cuda()), A.T(y))):
        assert found.is_cuda
        torch.testing.assert_close(found.cpu(), expected)


def test_bad_input_is_told_what_was_expected():
    A = Projector(Grid.cube(8), BEAM, "siddon")
    with pytest.raises(ValueError, match=r"mu must be \(batch, 1, 8, 8, 8\), but shape \(8, 8, 8\)"):
        A(torch.zeros(8, 8, 8))
    with pytest.raises(ValueError, match=r"xrays must be \(batch, 3, 14, 18\)"):
        A.T(torch.zeros(1, 3, 18, 14))
    with pytest.raises(ValueError, match="mu must be a tensor, but a ndarray was given; convert it by torch.as_ten"):
        A(np.zeros((1, 1, 8, 8, 8), np.float32))
    with pytest.raises(ValueError, match="float32 or float64, but torch.float16"):
        A(torch.zeros(1, 1, 8, 8, 8, dtype=torch.float16))
    with pytest.raises(ValueError, match="detector lies inside"):
        Projector(Grid.cube(8, 700), BEAM)
