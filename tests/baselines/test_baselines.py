"""What every method without a prior keeps: finite, counted, inside its bounds, indifferent to units and seeds."""

import math
import re
from dataclasses import replace

import pytest
import torch
from laws import random_like

from phydict.baselines import CGLS, FDK, FISTATV, SIRT, DiffVox, Region
from phydict.baselines.baseline import typical_chest
from phydict.grid import Grid
from phydict.units import MU_WATER, HUWindow, hu_to_mu
from phydict.xray import ConeBeam, Projector

GRID = Grid.cube(16)
CHEST = Projector(GRID, ConeBeam.orbit(4, 1020, 740, (24, 24), 22.0))
METHODS = {"fdk": FDK(), "sirt": SIRT(8), "cgls": CGLS(5), "cgls bounded": CGLS(4, 2, HUWindow()), "tv": FISTATV(8),
           "diffvox": DiffVox(8)}
BOUNDED = {name: method for name, method in METHODS.items() if name not in ("sirt", "cgls")}


@pytest.fixture(params=METHODS)
def method(request):
    return METHODS[request.param]


def views() -> torch.Tensor:
    return CHEST(MU_WATER * typical_chest(CHEST))[0]


class Watched:
    """The README's contract of a projector, and nothing more; counts for itself."""

    def __init__(self, projector: Projector):
        self.grid, self.beam, self._projector, self.calls = projector.grid, projector.beam, projector, 0

    def __call__(self, mu):
        self.calls += 1
        return self._projector(mu)

    def T(self, y):
        self.calls += 1
        return self._projector.T(y)


@pytest.mark.parametrize("display", [False, True])
def test_projector_calls_and_steps_are_those_that_happened(method, display):
    watched, steps = Watched(CHEST), []
    result = method.reconstruct(views(), watched, display=display, on_step=lambda: steps.append(1))
    backprojections = isinstance(method, FDK)  # FDK's own, which is not the adjoint
    assert result.projector_calls == watched.calls + backprojections and result.network_calls == 0
    assert len(steps) == method.steps()


@pytest.mark.parametrize("display", [False, True])
def test_projector_calls_of_a_box_are_those_that_happened(method, display, monkeypatch):
    y, box, calls = views(), Grid.box(8, 192.0, (48.0, 0.0, 0.0)), []
    for name in ("__call__", "T"):
        plain = getattr(Projector, name)
        monkeypatch.setattr(Projector, name, lambda self, x, plain=plain: calls.append(1) or plain(self, x))
    result = Region(method, box, GRID).reconstruct(y, Projector(box, CHEST.beam, full_detector=True), display=display)
    backprojections = 2 * isinstance(method, FDK)
    assert result.projector_calls == len(calls) + backprojections


def test_a_box_says_of_its_own_fit_alone_and_once_what_is_doubtful_of_the_xrays():
    unlike = 1e3 * views() * torch.tensor([1.0, 3.0, 1.0, 3.0])[:, None, None]
    box = Grid.box(8, 192.0, (48.0, 0.0, 0.0))
    with pytest.warns(UserWarning) as told:
        Region(SIRT(8), box, GRID).reconstruct(unlike, Projector(box, CHEST.beam, full_detector=True))
    line, fit = [str(warning.message) for warning in told]
    assert "the largest line integral" in line and "no volume was found" in fit


def test_misfit_and_reprojection_are_those_of_the_volume(method):
    y = views()
    result = method.reconstruct(y, CHEST)
    again = CHEST(MU_WATER * (1 + result.volume / 1000)[None, None])[0]
    torch.testing.assert_close(again, result.reprojection, atol=1e-4, rtol=1e-4)
    assert result.misfit == pytest.approx(float((again - y).norm() / y.norm()), rel=1e-3)
    torch.testing.assert_close(result.xrays, y)


def test_what_water_attenuates_does_not_change_hu_once_it_is_stated(method):
    hard = method.with_mu_water(0.85 * MU_WATER).reconstruct(0.85 * views(), CHEST).volume
    torch.testing.assert_close(hard, method.reconstruct(views(), CHEST).volume, rtol=1e-3, atol=0.5)


@pytest.mark.parametrize("seed", [1, 2])
def test_nothing_depends_on_the_seed(method, seed):
    assert torch.equal(method.reconstruct(views(), CHEST, seed=seed).volume, method.reconstruct(views(), CHEST).volume)


@pytest.mark.parametrize("views", [1, 2, 4])
@pytest.mark.parametrize("display", [False, True])
@pytest.mark.parametrize("value", [0.0, 3.0, -1.0, 1e3])
def test_any_number_of_nearly_constant_views_is_finite(method, views, display, value):
    few, y = Projector(GRID, CHEST.beam.select(range(views))), torch.full((views, 24, 24), value)
    y[:, 0, 0] = 1.001 * value or 0.001 * display
    result = method.reconstruct(y, few, display=display)
    assert result.volume.isfinite().all() and result.misfit_per_view and torch.tensor(result.misfit).isfinite()
    if value == 0 and not display:
        assert (result.volume + 1000).abs().max() < 0.5  # vacuum


@pytest.mark.parametrize("name", BOUNDED)
def test_the_window_bounds_the_volume_even_for_impossible_views(name):
    y = 4 * random_like((4, 24, 24), torch.float32)
    for window in (HUWindow(-1000, 200), HUWindow(-800, 1000)):
        volume = replace(BOUNDED[name], window=window).reconstruct(y, CHEST).volume
        assert volume.min() >= window.low - 1e-2 and volume.max() <= window.high + 1e-2
    if name != "diffvox":  # whose densities are never negative
        assert replace(BOUNDED[name], window=None).reconstruct(y, CHEST).volume.min() < -1000


def test_double_precision_agrees_with_single(method):
    double = method.reconstruct(views().double(), CHEST).volume
    assert double.dtype == torch.float64
    assert (double - method.reconstruct(views(), CHEST).volume).square().mean().sqrt() < 2.0  # HU


def test_more_views_come_nearer_to_the_truth(method):
    truth = 1000 * (typical_chest(CHEST)[0, 0] - 1)
    if isinstance(method, DiffVox):
        method = replace(method, iterations=60, learning_rate=0.05)
    elif not isinstance(method, FDK):
        method = replace(method, iterations=15)
    errors = []
    for k in (1, 4, 24):
        projector = Projector(GRID, ConeBeam.orbit(k, 1020, 740, (24, 24), 22.0, start=0.1))
        y = projector(hu_to_mu(truth)[None, None])[0]
        errors.append(float((method.reconstruct(y, projector).volume - truth).norm()))
    assert errors == sorted(errors, reverse=True)


@pytest.mark.parametrize("change", [lambda y: y[:3], lambda y: y[:, :20], lambda y: y / 0])
def test_x_rays_that_do_not_fit_are_refused(method, change):
    with pytest.raises(ValueError, match="match|NaN or infinite"):
        method.reconstruct(change(views()), CHEST)


@pytest.mark.parametrize("kind, settings", [
    (SIRT, {"iterations": 0}), (CGLS, {"iterations": 0}), (CGLS, {"restarts": 0}), (FISTATV, {"iterations": 0}),
    (FISTATV, {"inner": 0}), (FISTATV, {"weight": -1.0}), (FISTATV, {"weight": float("nan")}),
    (DiffVox, {"iterations": 0}), (DiffVox, {"smoothness": -1.0}), (DiffVox, {"learning_rate": 0.0}),
    (DiffVox, {"smoothness": math.inf}), (DiffVox, {"learning_rate": math.inf}), (FISTATV, {"weight": 1e300}),
    (FISTATV, {"iterations": 2.5})])
def test_impossible_settings_are_refused_with_their_value(kind, settings):
    with pytest.raises(ValueError, match=re.escape(str(*settings.values()))):
        kind(**settings)
