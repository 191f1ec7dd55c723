"""The release's differences from the paper: what each switch does, on its own."""

import pytest
import torch
from laws import random_like
from prior.tiny import tiny_prior

from phydict.diffusion import GaussianDenoiser
from phydict.grid import Grid
from phydict.methods import METHODS
from phydict.posterior import GradientSteps, Measurement, Posterior, Reward, SplitGibbs
from phydict.units import HUWindow
from phydict.xray import ConeBeam, Projector
from posterior.dense import FINE, SHAPE, denoiser, measurement

WINDOW = HUWindow(-1000, 600)
BEAM = ConeBeam.orbit(3, 1020, 740, (7, 9), 60.0)
PROJECTOR = Projector(Grid.cube(6), BEAM)
TRUTH = (0.5 * random_like((1, 1, 6, 6, 6), seed=1)).clamp(-1, 1)
X = (0.5 * random_like((2, 1, 6, 6, 6), seed=2)).clamp(-1, 1)


def data():
    return Measurement(PROJECTOR, PROJECTOR(WINDOW.to_mu(TRUTH))[0], WINDOW)


def test_the_weights_and_means_of_the_squared_error_are_factors():
    plain = Reward()(data(), X)
    torch.testing.assert_close(Reward(squared=0.1)(data(), X), 0.1 * plain)
    torch.testing.assert_close(Reward(pixel_mean=True)(data(), X), plain / 63)
    torch.testing.assert_close(Reward(view_sum=True)(data(), X), 3 * plain)


def test_standardised_views_count_only_up_to_gain_and_offset():
    m, reward = data(), Reward(standardise=True)
    m.y = 3.7 * m.y + 2 * torch.arange(3.0).view(3, 1, 1)
    assert reward(m, TRUTH).abs() < 1e-20 and (reward(m, X) < -1).all()


def test_the_bare_range_is_what_is_projected():
    m = data()
    torch.testing.assert_close(Reward(raw_range=True).project(m, X), PROJECTOR(X))
    same = Reward(renderer=PROJECTOR.method).project(m, X)
    torch.testing.assert_close(same, m.project(X))


def test_nearest_upsampling_changes_nothing_under_siddon_and_linear_upsampling_little_where_the_volume_is_smooth():
    settings = {"raw_range": True, "renderer": "siddon"}
    native, nearest, linear = (Reward(**settings, upsampling=n, nearest=flag).project(data(), X)
                               for n, flag in ((1, False), (4, True), (4, False)))
    torch.testing.assert_close(nearest, native, atol=1e-9, rtol=1e-6)
    assert (linear - native).norm() > 0.05 * native.norm()
    bell = torch.hann_window(8, periodic=False)[1:-1].double()
    smooth = torch.einsum("x, y, z -> xyz", bell, bell, bell)[None, None]
    fine, plain = (Reward(raw_range=True, upsampling=n).project(data(), smooth) for n in (4, 1))
    assert 0 < (fine - plain).norm() < 0.1 * plain.norm()


def test_dropout_makes_each_call_another_and_every_run_the_same_and_disturbs_no_other_draw():
    grid = Grid.cube(8)
    projector = Projector(grid, ConeBeam.orbit(2, 1020, 740, (64, 64), 8.0), full_detector=True)
    truth = (0.5 * random_like((1, 1, 8, 8, 8), torch.float32, seed=3)).clamp(-1, 1)
    xrays = projector(WINDOW.to_mu(truth))[0]
    reward = Reward(1e3, "squeeze", True, dropout=True)

    def run():
        m = Measurement(projector, xrays, WINDOW)
        return [float(reward(m, truth.flip(2))) for _ in range(2)]

    torch.manual_seed(1)
    one = run()
    after = torch.rand(1)
    torch.manual_seed(1)
    assert torch.equal(after, torch.rand(1)) and run() == one and one[0] != one[1]
    still = Reward(1e3, "squeeze", True)
    m = Measurement(projector, xrays, WINDOW)
    assert float(still(m, truth.flip(2))) == float(still(m, truth.flip(2)))  # dropout was not left on


class Squares:
    """-|P z - y|^2 for a measurement without views."""

    def __call__(self, m, x):
        return -(m.project(x) - m.y).square().sum(-1)


def test_plain_descent_takes_the_gradient_times_the_rate():
    m, x0 = measurement(), 0.3 * random_like((1, *SHAPE), seed=20)
    step = GradientSteps(1, 0.01, adam=False, reward=Squares())
    torch.testing.assert_close(step(m, x0, 0.5), x0 - 0.02 * m.adjoint(m.project(x0) - m.y))


def test_the_mean_over_voxels_weakens_the_prior_term_by_their_number():
    x0 = 0.3 * random_like((1, *SHAPE), seed=20)
    mean, summed = (GradientSteps(3, 0.01, rho, adam=False, prior_mean=flag, reward=Squares())(measurement(), x0, 0.5)
                    for rho, flag in ((0.1, True), (0.6, False)))
    torch.testing.assert_close(mean, summed)


def test_the_last_call_is_the_denoisers_at_time_zero():
    settings = {"iterations": 4, "likelihood": GradientSteps(1, 0.01, reward=Squares())}
    calls = []

    class Watched(GaussianDenoiser):
        def denoise(self, x, t):
            calls.append((t, x, out := super().denoise(x, t)))
            return out

    prior = Watched(denoiser().mean, denoiser().variance, FINE)
    x = random_like((1, *SHAPE), seed=10)
    found = SplitGibbs(**settings, final_denoise=True, ec_delta=0.6, ec_steps=3).sample(
        prior, measurement(), x, torch.Generator().manual_seed(0))
    assert [t for t, _, _ in calls] == pytest.approx([1.0, 0.75, 0.5, 0.25, 0.0, 0.6, 0.4, 0.2, 0.0])
    assert torch.equal(found, calls[-1][2])


def test_an_estimate_that_is_not_clipped_reaches_the_likelihood_step_as_it_is():
    seen = []

    class Note(Squares):
        def __call__(self, m, x):
            seen.append(x.detach().clone())
            return super().__call__(m, x)

    prior = GaussianDenoiser(torch.full((1, *SHAPE), 3.0).double(), torch.tensor(0.01).double(), FINE)
    for clip, highest in ((True, 1.0), (False, 3.0)):
        steps = GradientSteps(1, 0.01, reward=Note())
        found = SplitGibbs(2, steps, steps, clip=clip).sample(
            prior, measurement(), random_like((1, *SHAPE), seed=10), torch.Generator())
        assert float(seen[-2].max()) == pytest.approx(highest, abs=0.1) and found.max() <= 1


def test_the_release_calls_the_network_51_and_41_times_and_the_prior_with_a_report_twice_as_often():
    assert METHODS["phydict_released"].steps() == 51 + 41
    assert METHODS["phydict_released"].likelihood.reward.lpips == 0.5


def test_the_released_settings_run_and_answer_to_the_views():
    beam = ConeBeam.orbit(2, 1020, 740, (48, 48), 12.0)
    projector = Projector(Grid.cube(16), beam, full_detector=True)
    settings = METHODS["phydict_released"]
    mu = torch.zeros(1, 1, 16, 16, 16)
    mu[:, :, 3:13, 4:12] = 0.02
    short = SplitGibbs(3, settings.likelihood, settings.final_likelihood, ec_delta=0.8, ec_steps=2,
                       clip=False, final_denoise=True)
    results = [Posterior(tiny_prior(), short).reconstruct(xrays, projector, seed=3).volume
               for xrays in (projector(mu)[0], projector(mu)[0], projector(mu.flip(2, 3, 4))[0] ** 2)]
    assert torch.equal(results[0], results[1]) and not torch.allclose(results[0], results[2])
