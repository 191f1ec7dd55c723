"""What holds of the published samplers alike: randomness by the seed alone, masks, and refused settings."""

import re

import pytest
import torch
from laws import random_like

from phydict.posterior import DAPS, DDS, DPS, DiffPIR, ExactDraw, Langevin, PnPDM
from posterior.dense import SHAPE, V, WithMask, measurement, sample

EXACT = {"likelihood": ExactDraw(20, 1e-12), "noise": 0.3}


@pytest.mark.parametrize("settings", [
    DAPS(3, noise=0.3, likelihood=ExactDraw()), DAPS(3, noise=0.3, likelihood=Langevin(5)), DDS(5),
    DiffPIR(5, noise=0.3), DPS(5), PnPDM(4, levels=10, burn_in=3, thinning=1, **EXACT)],
    ids=lambda settings: type(settings).__name__)
def test_the_result_depends_on_the_seed_alone(settings):
    torch.manual_seed(1)
    one = sample(settings, seed=3)
    torch.manual_seed(2)
    assert torch.equal(one, sample(settings, seed=3)) and not torch.allclose(one, sample(settings, seed=4))


@pytest.mark.parametrize("alike", [0.0, 0.9])
@pytest.mark.parametrize("settings, share", [
    (DAPS(60, sigma_min=0.001, flow_end=0.001, flow_steps=1, prior_std=V**0.5, **EXACT), 0.08),
    (PnPDM(20, rho_max=0.2, rho_min=0.05, levels=150, burn_in=19, thinning=1, **EXACT), 0.12)], ids=["DAPS", "PnPDM"])
def test_a_ct_and_a_mask_that_no_x_ray_measures_have_the_spread_of_their_posterior(settings, share, alike):
    prior = WithMask(V, alike)
    states = sample(settings, random_like((1500, 2, *SHAPE[1:]), seed=11), prior=prior)
    found = [float(states[:, i].flatten(1).T.cov().trace()) for i in (0, 1)]
    assert found == pytest.approx(prior.spreads(measurement(), 0.3), rel=share)


@pytest.mark.parametrize("kind, settings", [
    *((DAPS, settings) for settings in (
        {"levels": 0}, {"flow_steps": 0}, {"sigma_min": 200.0}, {"noise": -1.0}, {"prior_std": 0.0}, {"noise": 1e-200},
        {"noise": float("inf")}, {"sigma_max": float("inf")})),
    *((DiffPIR, settings) for settings in (
        {"iterations": 0}, {"prior_weight": 0.0}, {"spacing": -1.0}, {"zeta": 1.5}, {"noise": 0.0}, {"noise": 1e200},
        {"cg_iterations": 0}, {"cg_iterations": -1}, {"prior_weight": float("inf")})),
    *((DPS, settings) for settings in ({"iterations": 0}, {"scale": -1.0}, {"scale": float("inf")})),
    *((PnPDM, settings) for settings in (
        {"rho_min": 20.0}, {"decay": 1.5}, {"levels": 0}, {"noise": 0.0}, {"burn_in": 98}, {"thinning": 0},
        {"noise": 1e-200}))])
def test_impossible_settings_are_refused(kind, settings):
    with pytest.raises(ValueError, match=re.escape(str(next(iter(settings.values()))))):
        kind(**settings)
