"""Total variation: its differences, its proximal step, its smoothed gradient and the quadratic above it."""

from functools import partial

import pytest
import torch
from laws import assert_adjoint, random_like, total_variation

from phydict.linalg.total_variation import (
    UNIT,
    TVQuadraticMajorizer,
    differences,
    differences_adjoint,
    tv_proximal,
)

pytestmark = pytest.mark.smoke

X = random_like((2, 1, 3, 4, 5), seed=1)
OTHER = random_like((2, 1, 3, 4, 5), seed=2)
EDGE = 0.1


def test_of_a_step_it_is_the_area_times_the_height():
    x = torch.zeros(1, 1, 6, 5, 4).double()
    x[:, :, 3:] = 0.7
    assert float(total_variation(x, eps=1e-9)) == pytest.approx(0.7 * 5 * 4, rel=1e-6)


def test_the_majorisers_gradient_where_it_touches_is_the_variations():
    x = X.clone().requires_grad_(True)
    total_variation(x, eps=EDGE).backward()
    torch.testing.assert_close(TVQuadraticMajorizer(X, EDGE).gradient(X), x.grad)


@pytest.mark.parametrize("far", [0.01, 1.0, 30.0])
def test_the_majoriser_lies_above_the_variation(far):
    m, moved = TVQuadraticMajorizer(X, EDGE), X + far * OTHER
    rise = ((m.gradient(moved) * moved).sum() - (m.gradient(X) * X).sum()) / 2
    assert total_variation(moved, eps=EDGE) - total_variation(X, eps=EDGE) <= rise


def test_the_diagonal_is_what_a_voxel_alone_makes_of_itself():
    m, found = TVQuadraticMajorizer(X[:1], EDGE), torch.zeros_like(X[:1])
    for place in range(found.numel()):
        alone = torch.zeros_like(found)
        alone.view(-1)[place] = 1
        found.view(-1)[place] = m.gradient(alone).view(-1)[place]
    torch.testing.assert_close(m.diagonal(), found)


def test_constants_cost_nothing_and_each_state_of_a_batch_is_its_own():
    m = TVQuadraticMajorizer(X, EDGE)
    assert m.gradient(torch.full_like(X, 3.0)).abs().max() < 1e-12
    torch.testing.assert_close(m.gradient(OTHER)[:1], TVQuadraticMajorizer(X[:1], EDGE).gradient(OTHER[:1]))


def test_the_differences_adjoint_is_exact():
    scales = (1.0, 0.5, 0.3)
    assert_adjoint(lambda x: differences(x, scales), lambda p: differences_adjoint(p, scales), (1, 1, 4, 5, 3))


def test_total_variation_is_the_area_of_faces_times_their_step_and_isotropic_at_edges():
    cube = torch.zeros(1, 1, 8, 8, 8).double()
    cube[..., 4:, :, :] = 2.0
    assert total_variation(cube, UNIT) == pytest.approx(2 * 64)
    ramp = torch.arange(8.0).double()
    diagonal = (ramp[:, None, None] + ramp[:, None] + ramp)[None, None]
    assert differences(diagonal, UNIT)[..., :7, :7, :7].square().sum(0).sqrt() == pytest.approx(3**0.5)


def test_the_proximal_step_moves_both_sides_of_a_plane_together_by_weight_over_depth():
    v = torch.zeros(1, 1, 6, 4, 4).double()
    v[..., 2:, :, :] = 1.0
    x, _ = tv_proximal(v, 0.2, UNIT, lambda x: x, 3000, torch.zeros(3, *v.shape).double())
    assert x[..., :2, :, :].numpy() == pytest.approx(0.2 / 2, abs=1e-3)
    assert x[..., 2:, :, :].numpy() == pytest.approx(1 - 0.2 / 4, abs=1e-3)


def test_the_proximal_step_of_a_constant_or_of_no_weight_is_clipping():
    clip, start = partial(torch.clamp, min=0, max=1), torch.zeros(3, 1, 1, 4, 4, 4).double()
    v = torch.full((1, 1, 4, 4, 4), 1.7).double()
    assert torch.equal(tv_proximal(v, 0.5, UNIT, clip, 9, start)[0], torch.ones_like(v))
    v = random_like((1, 1, 4, 4, 4))
    assert torch.equal(tv_proximal(v, 0.0, UNIT, clip, 9, start)[0], v.clamp(0, 1))
