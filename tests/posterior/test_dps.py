"""DPS on a Gaussian prior: its push is the misfit's gradient through the denoiser, and without it the prior is left."""

import itertools

import pytest
import torch
from laws import random_like
from prior.tiny import tiny_prior

from phydict.grid import Grid
from phydict.posterior import DPS, Posterior
from phydict.xray import ConeBeam, Projector
from posterior.dense import FINE, SHAPE, N, V, X, assert_moments, denoiser, measurement, sample


def test_one_level_is_the_denoisers_estimate_pushed_along_the_gradient_of_the_unsquared_misfit():
    m, prior, scale = measurement(), denoiser(), 0.2
    a, s = (float(w) for w in FINE.scales(1.0))
    x0 = prior.denoise(X, 1.0)
    residual = m.project(x0) - m.y
    slope = a * V / (a**2 * V + s**2)
    gradient = slope * m.adjoint(residual / residual.norm()) / m.norm()
    found = sample(DPS(1, scale / slope))  # the denoiser's slope is small at pure noise
    torch.testing.assert_close(found, x0 - scale / slope * gradient, atol=1e-7, rtol=0)
    assert (found - x0).norm() > 0.05


def test_without_a_push_it_samples_the_prior():
    samples = sample(DPS(800, 0.0), random_like((4000, *SHAPE), seed=11))
    assert_moments(samples, denoiser().mean, V * torch.eye(N).double(), 0.015, 0.08)


def test_a_longer_push_and_more_levels_never_raise_the_misfit_of_exact_data():
    m = measurement()
    m.y = m.project(denoiser().mean + V**0.5 * X)
    starts = random_like((500, *SHAPE), seed=12)

    def misfit(n, scale):
        return float((m.project(sample(DPS(n, scale), starts, m)) - m.y).norm())

    pushed, levels = [misfit(50, scale) for scale in (0.0, 0.01, 0.02, 0.04)], [misfit(n, 0.02) for n in (20, 60, 180)]
    for misfits in (pushed, levels):
        assert all(after < before for before, after in itertools.pairwise(misfits)), misfits


def test_cases_of_a_batch_do_not_mix():
    starts = random_like((3, *SHAPE), seed=12)
    together = sample(DPS(1, 50.0), starts)
    alone = torch.cat([sample(DPS(1, 50.0), x[None]) for x in starts])
    torch.testing.assert_close(together, alone, atol=1e-9, rtol=0)


def test_it_goes_through_a_network_and_keeps_no_gradients_of_it():
    beam = ConeBeam.orbit(4, 1020, 740, (14, 14), 40.0)
    projector = Projector(Grid.cube(16), beam)
    prior = tiny_prior()
    mu = torch.zeros(1, 1, 16, 16, 16)
    mu[:, :, 3:13, 4:12] = 0.02
    free, pushed, again = (Posterior(prior, DPS(5, scale)).reconstruct(projector(mu)[0], projector, seed=3)
                           for scale in (0.0, 5.0, 5.0))
    assert pushed.misfit < free.misfit and torch.equal(pushed.volume, again.volume)
    assert not pushed.volume.requires_grad and all(w.grad is None for w in prior.parameters())


def test_a_denoiser_without_gradients_is_refused():
    class Opaque:
        schedule = FINE

        @torch.no_grad()
        def denoise(self, x, t):
            return 0 * x

    with pytest.raises(ValueError, match="can be differentiated"):
        sample(DPS(1), prior=Opaque())
