"""Simulated X-rays: the requested noise, and the same noise for the same seed."""

import numpy as np
import pytest
import torch

from phydict.xray import ConeBeam, Grid, Ideal, Projector

A = Projector(Grid.cube(12), ConeBeam.orbit(2, 1020, 740, (40, 40), 12.0), full_detector=True)
MU = 0.02 * torch.rand(2, 1, 12, 12, 12, generator=torch.Generator().manual_seed(0))


def test_without_noise_it_is_the_projection():
    torch.testing.assert_close(Ideal(noise=0)(A, MU, [1, 2]), A(MU), rtol=1e-6, atol=1e-6)


def test_noise_has_the_stated_size_relative_to_each_case():
    mu = MU * torch.tensor([1.0, 0.1]).view(2, 1, 1, 1, 1)
    residual = Ideal(noise=0.03)(A, mu, [1, 2]) - A(mu)
    for case in range(2):
        assert float(residual[case].std()) == pytest.approx(0.03 * float(A(mu)[case].max()), rel=0.06)


@pytest.mark.parametrize("simulate", [Ideal(noise=0.03), Ideal(noise=0.0, photons=1e4)])
def test_a_case_depends_on_its_seed_alone(simulate):
    both = simulate(A, MU, [5, 6])
    assert torch.equal(both, simulate(A, MU, [5, 6]))
    assert torch.equal(both[1:], simulate(A, MU[1:], 6))
    assert not torch.equal(both[1:], simulate(A, MU[1:], 7))
    for seeds in (np.array([5, 6]), torch.tensor([5, 6]), range(5, 7)):
        assert torch.equal(both, simulate(A, MU, seeds))
    assert torch.equal(both[1:], simulate(A, MU[1:], np.int64(6)))


def test_counting_noise_follows_the_photons():
    p, photons = A(MU[:1]), 1e4
    residual = Ideal(noise=0, photons=photons)(A, MU[:1], 3) - p
    assert float(residual.square().mean()) == pytest.approx(float((p.exp() / photons).mean()), rel=0.15)
    starved = Ideal(noise=0, photons=1.0)(A, 50 * MU[:1], 3)
    assert torch.isfinite(starved).all()


def test_bad_settings_are_refused():
    with pytest.raises(ValueError, match="2 cases need one seed each, but 1 were given"):
        Ideal()(A, MU, 3)
    for noise in (-1, "0.005"):
        with pytest.raises(ValueError, match=f"noise is a fraction >= 0 .* but {noise!r} was given"):
            Ideal(noise=noise)
    for photons in (0, "many"):
        with pytest.raises(ValueError, match="photons per pixel must be > 0"):
            Ideal(photons=photons)
