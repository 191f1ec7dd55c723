"""The reward is -J of Eq. 5; LPIPS is loaded when it has weight and its absence is told in one sentence."""

import sys
from urllib.error import URLError

import pytest
import torch
from laws import random_like

from phydict.grid import Grid
from phydict.posterior import GradientSteps, Measurement, Reward
from phydict.posterior.likelihood.reward import load_lpips
from phydict.units import HUWindow
from phydict.xray import ConeBeam, Projector

WINDOW = HUWindow(-1000, 600)
PROJECTOR = Projector(Grid.cube(6), ConeBeam.orbit(3, 1020, 740, (7, 9), 60.0))
TRUTH = (0.5 * random_like((1, 1, 6, 6, 6), seed=1)).clamp(-1, 1)
Y = PROJECTOR(WINDOW.to_mu(TRUTH))[0]
X = (0.5 * random_like((2, 1, 6, 6, 6), seed=2)).clamp(-1, 1)


@pytest.fixture(autouse=True)
def forget_networks():
    load_lpips.cache_clear()
    yield
    load_lpips.cache_clear()


def pictures(size=64):
    """A measurement whose views are large enough for LPIPS."""
    grid = Grid.cube(8)
    projector = Projector(grid, ConeBeam.orbit(2, 1020, 740, (size, size), 8.0))
    truth = (0.5 * random_like((1, 1, 8, 8, 8), torch.float32, seed=3)).clamp(-1, 1)
    return Measurement(projector, projector(WINDOW.to_mu(truth))[0], WINDOW), truth


def test_the_reward_is_minus_the_mean_over_views_of_the_squared_error():
    expected = []
    for x in X:
        difference = PROJECTOR(WINDOW.to_mu(x[None]))[0] - Y
        expected.append(-sum(float((view**2).sum()) for view in difference) / 3)
    assert Reward()(Measurement(PROJECTOR, Y, WINDOW), X).tolist() == pytest.approx(expected)


@pytest.mark.parametrize("reward", [Reward(renderer="separable"), Reward(upsampling=1, renderer="auto")])
def test_another_renderer_sees_what_lies_outside_as_well(reward):
    outside = 0.1 * random_like(Y.shape, seed=4).abs()
    m = Measurement(PROJECTOR, Y + outside, WINDOW, outside=outside)
    assert reward(m, X).tolist() == pytest.approx(Reward()(m, X).tolist())
    before = m.calls
    reward(m, X)
    assert m.calls == before + len(X)


def test_the_truth_has_the_highest_reward_and_its_gradient_vanishes():
    m, x = Measurement(PROJECTOR, Y, WINDOW), TRUTH.clone().requires_grad_()
    reward = Reward()(m, x)
    (gradient,) = torch.autograd.grad(reward.sum(), x)
    assert float(reward.detach()) == pytest.approx(0, abs=1e-15) and gradient.abs().max() < 1e-9
    assert (Reward()(m, X) < -0.01).all()


def test_the_gradient_is_the_adjoint_of_the_residual():
    m, x = Measurement(PROJECTOR, Y, WINDOW), X[:1].clone().requires_grad_()
    (gradient,) = torch.autograd.grad(Reward()(m, x).sum(), x)
    torch.testing.assert_close(gradient, -2 / 3 * m.adjoint(m.project(X[:1]) - m.y))


def test_gradient_steps_raise_the_reward():
    m = Measurement(PROJECTOR, Y, WINDOW)
    z = GradientSteps(learning_rate=0.02)(m, X[:1], 0.5)
    assert Reward()(m, z) > Reward()(m, X[:1])


def test_without_weight_lpips_is_not_even_imported(monkeypatch):
    monkeypatch.setitem(sys.modules, "lpips", None)  # importing it now fails
    assert Reward(lpips=0.0)(Measurement(PROJECTOR, Y, WINDOW), X).isfinite().all()
    with pytest.raises(ImportError):
        Reward(lpips=1.0, random_backbone=True)(Measurement(PROJECTOR, Y, WINDOW), X)


@pytest.mark.parametrize("backbone", ["squeeze", "alex", "vgg"])
def test_a_missing_backbone_names_the_file_the_folder_and_the_switch(monkeypatch, tmp_path, backbone):
    asked = []

    def offline(url, *_, **__):
        asked.append(url)
        raise URLError("no network")

    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    monkeypatch.setattr(torch.hub, "download_url_to_file", offline)
    with pytest.raises(FileNotFoundError) as error:
        load_lpips(backbone, False)
    file = asked[0].rsplit("/", 1)[1]
    for part in (file, str(tmp_path), "lpips weight to 0", "random_backbone: true"):
        assert part in str(error.value)


def test_an_unknown_backbone_is_refused_with_the_known_ones():
    with pytest.raises(ValueError, match="alex, vgg, squeeze"):
        load_lpips("resnet", True)


def test_lpips_is_nothing_between_equal_views_and_something_between_others():
    m, truth = pictures()
    plain, perceptual = Reward(), Reward(lpips=1.0, backbone="squeeze", random_backbone=True)
    assert float(perceptual(m, truth)) == pytest.approx(0, abs=1e-5)
    other = truth.flip(2)
    distance = float(plain(m, other) - perceptual(m, other))
    assert distance > 1e-3
    twice = Reward(lpips=2.0, backbone="squeeze", random_backbone=True)
    assert float(plain(m, other) - twice(m, other)) == pytest.approx(2 * distance, rel=1e-3)


def test_lpips_has_a_gradient_for_the_volume_and_none_for_itself():
    m, truth = pictures()
    x = truth.flip(2).requires_grad_()
    Reward(lpips=1e4, backbone="squeeze", random_backbone=True)(m, x).sum().backward()
    assert x.grad.isfinite().all() and x.grad.abs().max() > 0
    assert not any(w.requires_grad for w in load_lpips("squeeze", True).parameters())


def test_the_untrained_backbone_is_the_same_whatever_was_drawn_before_and_disturbs_no_other_draw():
    distances, m, truth = [], *pictures()
    for seed in (1, 2):
        load_lpips.cache_clear()
        torch.manual_seed(seed)
        distances.append(float(Reward(1.0, "squeeze", True)(m, truth.flip(2))))
        after = torch.rand(1)
        torch.manual_seed(seed)
        assert torch.equal(after, torch.rand(1))
    assert distances[0] == distances[1]
