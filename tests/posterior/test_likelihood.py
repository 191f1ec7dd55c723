"""The likelihood steps: one solves its normal equations, the other descends the paper's objective."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from laws import random_like, total_variation
from scenes import block
from scipy.optimize import lsq_linear

from phydict.datasets import phantom_case
from phydict.grid import Grid
from phydict.linalg.total_variation import TVQuadraticMajorizer
from phydict.posterior import GradientSteps, Measurement, ProximalCG, Reward
from phydict.posterior.likelihood.likelihood import MOST_SMOOTHING
from phydict.units import HUWindow
from phydict.xray import ConeBeam, Projector
from posterior.dense import SHAPE, DenseMeasurement, N, measurement
from posterior.hollow import measured

X0 = 0.3 * random_like((1, *SHAPE), seed=20)


def solved(m, x0, weight):
    """The minimiser of |P z - y|^2 + weight |z - x0|^2."""
    normal = m.matrix.T @ m.matrix + weight * torch.eye(N).double()
    right = m.matrix.T @ (m.y[0] - m.background) + weight * x0.flatten()
    return torch.linalg.solve(normal, right).view_as(x0)


@pytest.mark.parametrize("rows", [1, 4, 9])
@pytest.mark.parametrize("noise, spread", [(0.3, 0.2), (0.02, 0.5), (1.0, 0.01)])
def test_conjugate_gradients_solve_the_normal_equations(rows, noise, spread):
    m = measurement(rows)
    z = ProximalCG(40, noise=noise, tolerance=1e-13)(m, X0, spread)
    torch.testing.assert_close(z, solved(m, X0, (noise / spread) ** 2), atol=1e-8, rtol=0)


def test_what_no_volume_explains_counts_as_noise():
    """The same of every ray is more noise of the step, of one ray alone nearly that ray left out."""
    m, step = measurement(4), ProximalCG(40, noise=0.3, tolerance=1e-13)
    m.model_variance = torch.full((4,), 0.5**2 - 0.3**2).double()
    torch.testing.assert_close(step(m, X0, 0.2), solved(m, X0, (0.5 / 0.2) ** 2), atol=1e-8, rtol=0)
    m.model_variance = torch.tensor([0.0, 0, 1e9, 0]).double()
    without = DenseMeasurement(m.matrix[[0, 1, 3]], m.y[0, [0, 1, 3]], m.background)
    torch.testing.assert_close(step(m, X0, 0.2), step(without, X0, 0.2), atol=1e-8, rtol=0)


@pytest.mark.parametrize("bend, raised", [(0.0, False), (0.1, True), (0.3, True)])
def test_model_error_raises_the_total_variation_and_noise_does_not(bend, raised):
    """Of X-rays of a spectrum's curvature, by the squared normalised residual, up to a bound."""
    m, x0, plain = measured(noise=0.01), 0.9 * block(), ProximalCG(10, 6, tv_weight=0.2)
    m.y = m.y - bend * m.y * (m.y.max() - m.y)
    excess = float(m.normalised_residual(plain(m, x0, 0.3))) ** 2
    found = replace(plain, discrepancy=True)(m, x0, 0.3)
    smoother = replace(plain, tv_weight=0.2 * min(excess, MOST_SMOOTHING))(m, x0, 0.3)
    assert (excess > 1) == raised and torch.equal(found, smoother if raised else plain(m, x0, 0.3))
    assert (total_variation(found) < total_variation(plain(m, x0, 0.3))) == raised


def test_each_iteration_lowers_the_objective_and_as_many_as_unknowns_suffice():
    m, noise, spread = measurement(9), 0.1, 0.5

    def objective(z):
        return float((m.project(z) - m.y).square().sum() / noise**2 + (z - X0).square().sum() / spread**2)

    values = [objective(ProximalCG(k, 1, noise, 0.0)(m, X0, spread)) for k in range(N + 1)]
    assert all(later < earlier for earlier, later in itertools.pairwise(values))
    assert values[-1] == pytest.approx(objective(solved(m, X0, (noise / spread) ** 2)), rel=1e-9)
    assert ProximalCG(0)(m, X0, spread).equal(X0)


def test_where_the_bounds_act_on_a_determined_problem_the_restarts_reach_the_bounded_least_squares_solution():
    matrix, weight = random_like((9, N), seed=4).abs(), 0.25  # rays have no negative lengths
    m = DenseMeasurement(matrix, 3 * random_like((9,), seed=5))
    stacked = np.concatenate([matrix, weight**0.5 * np.eye(N)])
    expected = lsq_linear(stacked, np.concatenate([m.y[0], weight**0.5 * X0.flatten()]), (-1, 1), tol=1e-14).x
    assert (abs(expected) > 0.999).any() and (abs(expected) < 0.9).any()
    z = ProximalCG(30, 20, 0.25, 1e-13)(m, X0, 0.5)
    np.testing.assert_allclose(z.flatten(), expected, atol=1e-5)


@pytest.mark.parametrize("start", [-0.5, 0.3])
def test_on_x_rays_every_restart_lowers_the_objective_inside_the_range(start):
    grid, window = Grid.cube(12), HUWindow()
    projector = Projector(grid, ConeBeam.orbit(4, 1020, 740, (28, 28), 20.0))
    truth = torch.full((1, 1, *grid.shape), -1.0)
    truth[:, :, 2:10, 3:9] = 0.04
    truth[:, :, 4:7, 5:8, 3:9] = -0.8
    m = Measurement(projector, projector(window.to_mu(truth))[0], window)
    x0 = torch.full_like(truth, start)

    def objective(z):
        return float((m.project(z) - m.y).square().sum() / 0.02**2 + (z - x0).square().sum() / 0.5**2)

    steps = [ProximalCG(restarts=k)(m, x0, 0.5) for k in range(5)]
    values = [objective(z) for z in steps]
    assert all(z.abs().max() <= 1 for z in steps) and steps[2].min() == -1  # air is reached and not passed
    assert all(later < earlier for earlier, later in itertools.pairwise(values)) and values[2] < 0.01 * values[0]


@pytest.mark.parametrize("noise", [0.02, 0.0])
def test_a_singular_operator_gives_a_finite_fit_and_leaves_what_it_cannot_see(noise):
    matrix = torch.zeros(3, N).double()
    matrix[0, 0] = matrix[1, 0] = 1.0  # one voxel seen twice, a ray that meets nothing, five voxels unseen
    for dtype in (torch.float32, torch.float64):
        m = DenseMeasurement(matrix, torch.tensor([0.4, 0.4, 0.9]).to(dtype))
        z = ProximalCG(30, noise=noise)(m, X0.to(dtype), 0.5)
        assert z.isfinite().all() and z.flatten()[1:].equal(X0.to(dtype).flatten()[1:])
        assert float(z.flatten()[0]) == pytest.approx(0.4, abs=0.01)


def test_an_operator_that_sees_nothing_changes_nothing():
    m = DenseMeasurement(torch.zeros(3, N).double(), torch.ones(3).double())
    assert ProximalCG(30)(m, X0, 0.5).equal(X0)


def test_data_that_already_fit_change_nothing():
    m = measurement()
    m.y = m.project(X0)
    assert ProximalCG(30)(m, X0, 0.5).equal(X0)


def test_the_weight_of_the_data_runs_from_none_to_all():
    m = measurement(4)
    assert (ProximalCG(30, noise=1e6)(m, X0, 0.5) - X0).abs().max() < 1e-9
    trusted = ProximalCG(30, noise=1e-6, tolerance=1e-13)(m, X0, 0.5)
    torch.testing.assert_close(m.project(trusted), m.y, atol=1e-8, rtol=0)
    null = torch.linalg.svd(m.matrix)[2][4:]  # directions that the data do not see stay the estimate's
    torch.testing.assert_close(null @ trusted.flatten(), null @ X0.flatten(), atol=1e-8, rtol=0)


def test_only_the_ratio_of_noise_and_spread_matters():
    m = measurement(4)
    torch.testing.assert_close(ProximalCG(6, noise=0.1)(m, X0, 0.5), ProximalCG(6, noise=0.2)(m, X0, 1.0))


class Squares:
    """-|P z - y|^2: the reward's data term for a measurement without views."""

    def __call__(self, m, x):
        return -(m.project(x) - m.y).square().sum(-1)


@pytest.mark.parametrize("rate", [0.1, 0.02])
def test_gradient_steps_lower_their_objective_and_move_a_voxel_by_at_most_the_rate_per_step(rate):
    m, x0 = measurement(4), X0 + 0.8

    def objective(z):
        return float((m.project(z) - m.y).square().sum() + (z - x0).square().sum())

    z = GradientSteps(2, rate, reward=Squares())(m, x0, 0.5)
    assert objective(z) < objective(x0)
    assert 0 < (z - x0).abs().max() <= 2 * rate * 1.001
    torch.testing.assert_close((GradientSteps(1, rate, reward=Squares())(m, x0, 0.5) - x0).abs(),
                               torch.full_like(x0, rate), rtol=1e-4, atol=0)  # Adam's first step is the sign


def test_many_small_gradient_steps_reach_the_minimiser_that_rho_sets():
    m, rho = measurement(4), 0.5
    z = GradientSteps(3000, 0.003, rho, Squares())(m, X0, 0.5)
    assert (z - solved(m, X0, 1 / rho)).abs().max() < 0.01


def test_gradient_steps_leave_no_graph_and_work_where_gradients_are_off():
    m = measurement(4)
    with torch.no_grad():
        z = GradientSteps(reward=Squares())(m, X0, 0.5)
    assert not z.requires_grad and not torch.equal(z, X0) and not X0.requires_grad


def test_the_default_is_the_papers_two_steps_without_lpips():
    step = GradientSteps()
    assert (step.steps, step.learning_rate, step.rho, step.reward) == (2, 0.1, 1.0, Reward(lpips=0.0))


def chest_measurement(share, noise=None, seed=0):
    """X-rays of a small phantom with Gaussian noise of a share of their largest value, and the truth."""
    grid, window = Grid.cube(24), HUWindow()
    projector = Projector(grid, ConeBeam.orbit(6, 1020, 740, (48, 48), 11.5), full_detector=True)
    truth = phantom_case(7, grid, window)["volume"][None]
    y = projector(window.to_mu(truth))[0]
    error = share * y.max() * random_like(y.shape, torch.float32, seed=seed)
    m = Measurement(projector, y + error, window, noise=noise)
    return m, float(share * y.max()), truth


def test_with_total_variation_every_restart_lowers_the_objective_and_they_end_where_its_gradient_is_none():
    m, noise, spread, variation, edge = measurement(4), 0.3, 0.5, 2.0, 0.05

    def objective(z):
        return float((m.project(z) - m.y).square().sum() / noise**2 + (z - X0).square().sum() / spread**2
                     + 2 * variation * total_variation(z, eps=edge))

    def after(restarts):
        return ProximalCG(20, restarts, noise, 1e-13, tv_weight=variation, tv_eps=edge)(m, X0, spread)

    values = [objective(X0), *(objective(after(n)) for n in range(1, 8))]
    assert all(later < earlier for earlier, later in itertools.pairwise(values))
    z = after(300)
    gradient = (m.adjoint(m.project(z) - m.y) / noise**2 + (z - X0) / spread**2
                + variation * TVQuadraticMajorizer(z, edge).gradient(z))
    assert gradient.abs().max() < 1e-6


def test_preconditioned_by_the_x_rays_too_it_ends_at_the_same_minimum_and_nearer_to_it_after_as_many_iterations():
    m, level, truth = chest_measurement(0.005)
    x0, step = 0.8 * truth, ProximalCG(10, 4, level, tv_weight=10.0, tv_eps=0.003)

    def objective(z):
        return float((m.project(z) - m.y).square().sum() / level**2 + (z - x0).square().sum() / 0.2**2
                     + 2 * step.tv_weight * total_variation(z, m.scales, step.tv_eps))

    plain, both = step(m, x0, 0.2), replace(step, precondition_data=True)(m, x0, 0.2)
    assert objective(both) < objective(plain)
    dense = replace(step, iterations=20, restarts=300, noise=0.3, tolerance=1e-13, tv_weight=2.0, tv_eps=0.05)
    torch.testing.assert_close(replace(dense, precondition_data=True)(measurement(4), X0, 0.5),
                               dense(measurement(4), X0, 0.5), atol=1e-6, rtol=0)
    without = replace(step, tv_weight=0.0)
    assert replace(without, precondition_data=True)(m, x0, 0.2).equal(without(m, x0, 0.2))


def test_much_total_variation_leaves_a_constant():
    z = ProximalCG(20, 50, 0.3, 1e-13, tv_weight=1e4, tv_eps=0.01)(measurement(4), X0, 0.5)
    assert z.max() - z.min() < 1e-3


@pytest.mark.parametrize("step, wrong", [
    (ProximalCG, {"iterations": -1}), (ProximalCG, {"restarts": -1}), (ProximalCG, {"noise": -0.02}),
    (ProximalCG, {"noise": math.nan}), (ProximalCG, {"tolerance": -1e-6}), (ProximalCG, {"tolerance": 2.0}),
    (ProximalCG, {"tv_weight": -1.0}), (ProximalCG, {"tv_eps": 0.0}), (GradientSteps, {"steps": 0}),
    (GradientSteps, {"learning_rate": 0.0}), (GradientSteps, {"rho": 0.0}), (GradientSteps, {"rho": -1.0})])
def test_impossible_settings_are_refused_by_name(step, wrong):
    [(name, value)] = wrong.items()
    with pytest.raises(ValueError, match=rf"^{step.__name__}\.{name} .*, but {value} was given$"):
        step(**wrong)


def test_without_noise_nothing_can_be_weighed_against_the_data():
    for beside in ({"tv_weight": 1.0}, {"weighted_least_squares": True}):
        with pytest.raises(ValueError, match="a noise of 0 was given: give one above 0"):
            ProximalCG(noise=0.0, **beside)
    m = measurement(4)
    m.model_variance = torch.tensor([0.0, 0, 1, 0]).double()
    with pytest.raises(ValueError, match="a noise of 0 was given: give one above 0"):
        ProximalCG(noise=0.0)(m, X0, 0.5)


def test_refitting_the_scatter_comes_nearer_to_the_truth_and_without_scatter_goes_little_astray():
    for scatter in (0.05, 0.0):
        errors = []
        for refit in (False, True):
            m, _, truth = chest_measurement(0.0, 0.0)
            y = -torch.log(torch.exp(-m.y[0]) + scatter) if scatter else m.y[0]
            m = Measurement(m.projector, y, HUWindow(), noise=0.0)
            m.reset_scatter(True)
            z = ProximalCG(10, 5, refit_scatter=refit, tv_weight=15.0)(m, truth * 0.9 - 0.1, 0.3)
            errors.append(float((z - truth).norm()))
        assert errors[1] < (0.8 if scatter else 1.1) * errors[0]


def test_weighted_each_pixel_counts_by_its_own_noise():
    m, noise, spread = measurement(4), 0.3, 0.5
    m.noise_variance = torch.tensor([0.0, 0.01, 0.3, 100.0]).double()
    precision = 1 / (noise**2 + m.noise_variance)
    normal = m.matrix.T * precision @ m.matrix + torch.eye(N).double() / spread**2
    right = m.matrix.T * precision @ (m.y[0] - m.background) + X0.flatten() / spread**2
    z = ProximalCG(40, noise=noise, tolerance=1e-13, weighted_least_squares=True)(m, X0, spread)
    torch.testing.assert_close(z.flatten(), torch.linalg.solve(normal, right), atol=1e-8, rtol=0)


def test_weighting_comes_nearer_to_the_truth_where_few_photons_arrive_and_without_noise_changes_nothing():
    for photons, given in ((1e3, None), (None, 0.0)):
        errors = []
        for weighted in (False, True):
            m, _, truth = chest_measurement(0.0)
            y = m.y[0]
            if photons:
                y = y + (y.exp() / photons).sqrt() * random_like(y.shape, torch.float32, seed=3)
            m = Measurement(m.projector, y, HUWindow(), noise=given)
            z = ProximalCG(10, 5, weighted_least_squares=weighted, tv_weight=10.0)(m, truth * 0.9 - 0.1, 0.3)
            errors.append(float((z - truth).norm()))
        assert errors[1] < 0.5 * errors[0] if photons else errors[1] == errors[0]
