"""The smoothed total variation, its gradient and the quadratic above it."""

import pytest
import torch
from laws import random_like

from phydict.linalg.total_variation import TVQuadraticMajorizer, differences, differences_adjoint, smoothed_tv

X = random_like((2, 1, 3, 4, 5), seed=1)
OTHER = random_like((2, 1, 3, 4, 5), seed=2)
EDGE = 0.1


def test_the_adjoint_is_the_adjoint():
    d = [random_like(one.shape, seed=3 + i) for i, one in enumerate(differences(X))]
    left = sum((a * b).sum() for a, b in zip(differences(X), d))
    torch.testing.assert_close(left, (X * differences_adjoint(d)).sum())


def test_of_a_step_it_is_the_area_times_the_height():
    x = torch.zeros(1, 1, 6, 5, 4).double()
    x[:, :, 3:] = 0.7
    assert float(smoothed_tv(x, 1e-9)) == pytest.approx(0.7 * 5 * 4, rel=1e-6)


def test_the_majorisers_gradient_where_it_touches_is_the_variations():
    x = X.clone().requires_grad_(True)
    smoothed_tv(x, EDGE).backward()
    torch.testing.assert_close(TVQuadraticMajorizer(X, EDGE).gradient(X), x.grad)


@pytest.mark.parametrize("far", [0.01, 1.0, 30.0])
def test_the_majoriser_lies_above_the_variation(far):
    m, moved = TVQuadraticMajorizer(X, EDGE), X + far * OTHER
    rise = ((m.gradient(moved) * moved).sum() - (m.gradient(X) * X).sum()) / 2
    assert smoothed_tv(moved, EDGE) - smoothed_tv(X, EDGE) <= rise


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
