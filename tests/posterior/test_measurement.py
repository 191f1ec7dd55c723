"""X-rays as a linear problem in the prior's range."""

import pytest
import torch
from laws import assert_adjoint, assert_linear, random_like

from phydict.grid import Grid
from phydict.posterior import Measurement
from phydict.posterior.hardening import with_hardening
from phydict.posterior.scatter import with_scatter
from phydict.units import HUWindow
from phydict.xray import ConeBeam, Projector
from phydict.xray.calibration import UNBENT_PATH, without_hardening
from posterior.hollow import measured

GRID = Grid.cube(6)
BEAM = ConeBeam.orbit(3, 1020, 740, (7, 9), 60.0)
PROJECTOR = Projector(GRID, BEAM)
Y = random_like((3, 7, 9), seed=1).abs()
SHAPE = (1, 1, 6, 6, 6)


@pytest.mark.parametrize("window", [HUWindow(), HUWindow(-1000, 600)])
def test_projecting_the_range_is_projecting_its_attenuation(window):
    x = random_like(SHAPE, seed=2).clamp(-1, 1)
    torch.testing.assert_close(Measurement(PROJECTOR, Y, window).project(x), PROJECTOR(window.to_mu(x)))
    torch.testing.assert_close(Measurement(PROJECTOR, Y, window, mu_water=0.019).project(x),
                               PROJECTOR(window.to_mu(x, 0.019)))


def test_the_linear_part_is_linear_and_its_adjoint_exact():
    m = Measurement(PROJECTOR, Y, HUWindow(-1000, 600))
    assert_linear(m.linear, SHAPE)
    assert_adjoint(m.linear, m.adjoint, SHAPE)
    x, d = random_like(SHAPE, seed=3), random_like(SHAPE, seed=4)
    torch.testing.assert_close(m.project(x + d) - m.project(x), m.linear(d))


@pytest.mark.parametrize("weights", [1.0, torch.linspace(0, 2, 3).double()[:, None, None]])
def test_the_mean_diagonal_is_that_of_the_operators_matrix(weights):
    m = Measurement(PROJECTOR, Y, HUWindow())
    columns = m.linear(torch.eye(6**3).double().view(6**3, *SHAPE[1:]))
    exact = float((weights * columns.square()).sum()) / 6**3
    assert m.mean_diagonal(weights) == pytest.approx(exact, rel=0.3)  # a few voxels share each ray
    flipped = Measurement(PROJECTOR, Y, HUWindow(-1000, 3000))  # twice the attenuation per unit of the range
    assert flipped.mean_diagonal(weights) == pytest.approx(4 * m.mean_diagonal(weights))


def test_air_projects_to_nothing():
    m = Measurement(PROJECTOR, Y, HUWindow())
    assert m.project(torch.full(SHAPE, -1.0).double()).abs().max() < 1e-12


def test_line_integrals_are_left_alone_and_display_values_take_the_references_contrast_view_by_view():
    x = random_like(SHAPE, seed=5).clamp(-1, 1)
    kept = Measurement(PROJECTOR, Y, HUWindow())
    kept.match_gain_offset(x)
    assert torch.equal(kept.y[0], Y)
    gains, offsets = torch.tensor([0.2, 3.0, 90.0]).view(3, 1, 1), torch.tensor([-7.0, 0.5, 100.0]).view(3, 1, 1)
    truth = kept.project(x)[0]
    shown = Measurement(PROJECTOR, gains * truth + offsets, HUWindow(), display=True)
    shown.match_gain_offset(x)
    torch.testing.assert_close(shown.y[0], truth)
    shown.match_gain_offset(0.5 * x)  # always from the display values, never from the last guess
    shown.match_gain_offset(x)
    torch.testing.assert_close(shown.y[0], truth)


def test_a_nearly_flat_display_view_stays_finite():
    flat = torch.full((3, 7, 9), 0.4).double()
    flat[:, 0, 0] += 1e-14
    m = Measurement(PROJECTOR, flat, HUWindow(), display=True)
    m.match_gain_offset(torch.zeros(SHAPE).double())
    assert m.y.isfinite().all()


@pytest.mark.parametrize("y", [Y[:2], Y[:, :6], Y[None]])
def test_x_rays_that_do_not_fit_the_geometry_are_refused(y):
    with pytest.raises(ValueError, match="3 views of 7 x 9"):
        Measurement(PROJECTOR, y, HUWindow())


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_x_rays_that_are_not_finite_are_refused(bad):
    y = Y.clone()
    y[1, 2, 3] = bad
    with pytest.raises(ValueError, match="NaN or infinite"):
        Measurement(PROJECTOR, y, HUWindow())


def test_every_use_of_the_operator_is_counted():
    m = Measurement(PROJECTOR, Y, HUWindow())
    before, d = m.calls, torch.zeros(SHAPE).double()
    m.project(d), m.linear(d), m.adjoint(Y[None])
    assert m.calls == before + 3


def chest_views():
    """X-rays like a chest's, of a detector fine enough to tell scatter from anatomy, and their Measurement."""
    beam = ConeBeam.orbit(3, 1020, 740, (24, 32), 17.0)
    down, along = torch.meshgrid(torch.linspace(-1, 1, 24), torch.linspace(-1, 1, 32), indexing="ij")
    clean = (3.5 * torch.exp(-2 * along**2 - down**2) * (1 + 0.2 * torch.sin(9 * down))).expand(3, -1, -1)
    return clean, lambda y, **more: Measurement(Projector(GRID, beam), y, HUWindow(), **more)


@pytest.mark.filterwarnings("ignore:air is not the same across")  # of views that are all alike
@pytest.mark.parametrize("scatter", [0.0, 0.002, 0.03])
def test_scatter_is_subtracted_where_it_is_sought_and_what_was_measured_can_be_had_back(scatter):
    clean, measurement = chest_views()
    measured = -torch.log(torch.exp(-clean) + scatter)
    m = measurement(measured)
    m.subtract_scatter(clean[None])  # not sought
    assert torch.equal(m.y[0], measured)
    m.reset_scatter(True)
    for _ in range(2):  # always from what was measured
        m.subtract_scatter(clean[None])
        torch.testing.assert_close(m.y[0], clean, atol=1e-3, rtol=0)
    assert m.scatter == pytest.approx(float((scatter * torch.exp(measured)).mean()), abs=1e-3)
    m.reset_scatter(False)
    assert torch.equal(m.y[0], measured) and m.scatter == 0


@pytest.mark.parametrize("missed, believed", [((9.0, 5.0), True), ((9.0, 6.0), False), ((2.0, 0.5), False)])
def test_scatter_is_believed_where_xrays_are_missed_and_it_explains_much_of_that(missed, believed):
    m = chest_views()[1](chest_views()[0])
    m.normalised_residual = lambda z: torch.as_tensor(missed)[z.long()]  # the results 0 and 1 miss by these

    def run(number: int) -> torch.Tensor:
        m.subgrid = m.model_variance = number  # what finer voxels add, and what contradicts, sought anew by each run
        m.y = m.measured - 0.5 * number  # and what of the X-rays is scatter
        return torch.full((1, 1, 1, 1, 1), number)

    result = with_scatter(m, lambda: run(0), lambda: run(1))
    assert torch.equal(m.y, m.measured - 0.5 * believed)
    assert bool(result) == believed == m.scatter_enabled == m.subgrid == m.model_variance


@pytest.mark.parametrize("curvature, missed, believed", [
    (1e-3, (2.0, 1.0), True), (1e-3, (2.0, 1.95), False), (1e-3, (1.0, 0.5), False), (0.0, (2.0, 1.0), False)])
def test_hardening_is_believed_where_line_integrals_bend_and_straight_ones_are_missed_by_less(
        curvature, missed, believed):
    m = chest_views()[1](chest_views()[0])
    bent = m.y + curvature * m.y * (m.y - UNBENT_PATH * m.mu_water)
    m.project = lambda z: bent
    m.normalised_error = lambda projection: torch.tensor(missed[0])
    m.normalised_residual = lambda z: torch.tensor(missed[1])
    runs = []

    def run() -> torch.Tensor:
        runs.append(m.hardened)
        return torch.full((1, 1, 1, 1, 1), len(runs))

    assert with_hardening(m, run, run) == (2 if believed else 1)
    assert m.hardened == believed and torch.equal(
        m.y[0], without_hardening(chest_views()[0], m.mu_water) if believed else chest_views()[0])
    m.reset_scatter(False)
    assert m.hardened == believed == (not torch.equal(m.y[0], chest_views()[0]))
    if believed:  # what is straight stays so, and is asked no more
        assert with_hardening(m, run, run) == 3


def test_display_values_have_no_scatter_to_subtract():
    clean, measurement = chest_views()
    m = measurement(-torch.log(torch.exp(-clean) + 0.05), display=True)
    before = m.y
    m.reset_scatter(True)
    m.subtract_scatter(clean[None])
    assert not m.can_estimate_scatter and torch.equal(m.y, before)


def test_the_truth_is_missed_by_the_noise_and_each_state_of_a_batch_by_its_own():
    truth, level = random_like((1, 1, *GRID.shape), seed=3).clamp(-1, 1), 0.01
    clean = Measurement(PROJECTOR, Y, HUWindow()).project(truth)[0]
    noisy = clean + level * random_like(clean.shape, seed=4)
    m = Measurement(PROJECTOR, noisy, HUWindow(), noise=level / float(noisy.max()))
    missed = m.normalised_residual(torch.cat([truth, truth + 0.1]))
    assert float(missed[0]) == pytest.approx(1, abs=0.15) and float(missed[1]) > 3
    torch.testing.assert_close(missed, torch.cat([m.normalised_residual(truth), m.normalised_residual(truth + 0.1)]))


def test_the_noise_is_that_of_the_xrays_as_they_are_now():
    m = measured(noise=0.01)
    before = m.noise_variance
    assert m.noise_variance is before
    m.y = 2 * m.y
    torch.testing.assert_close(m.noise_variance, 4 * before)
