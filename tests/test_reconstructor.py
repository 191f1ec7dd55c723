"""Laws of what a reconstruction reports."""

import json
from dataclasses import dataclass, field
from pathlib import Path

import pytest
import torch

from phydict.reconstruction import describe
from phydict.xray.residuals import misfits, shared_norms

Y = torch.rand(3, 5, 4, generator=torch.Generator().manual_seed(0)) + 0.1


def test_misfit_is_zero_for_the_truth_one_for_nothing_and_proportional_between():
    assert misfits(Y, Y) == {"misfit": 0, "misfit_per_view": [0, 0, 0]}
    assert misfits(0 * Y, Y)["misfit"] == pytest.approx(1)
    assert misfits(1.1 * Y, Y)["misfit"] == pytest.approx(0.1, rel=1e-4)


def test_misfits_of_views_combine_to_the_whole():
    scaled = Y * torch.tensor([1.0, 1.3, 0.9])[:, None, None]
    said = misfits(Y, scaled)
    assert said["misfit_per_view"] == pytest.approx([0, 0.3 / 1.3, 0.1 / 0.9], abs=1e-6, rel=1e-4)
    sizes = scaled.flatten(1).norm(dim=1)
    residuals = torch.tensor(said["misfit_per_view"]) * sizes
    assert said["misfit"] == pytest.approx(float(residuals.norm() / sizes.norm()), rel=1e-5)


def test_what_neighbours_share_is_all_of_smooth_views_and_nothing_of_noise():
    smooth = torch.ones(2, 60, 50).cumsum(1) * torch.tensor([1.0, 3.0])[:, None, None]
    noise = torch.randn(2, 60, 50, generator=torch.Generator().manual_seed(0)) * smooth.mean()
    assert shared_norms(smooth) == pytest.approx(smooth.flatten(1).norm(dim=1), rel=0.02)
    assert (shared_norms(noise) < 0.15 * noise.flatten(1).norm(dim=1)).all()
    assert shared_norms(smooth + noise) == pytest.approx(shared_norms(smooth), rel=0.05)


def test_settings_of_any_kind_are_plain_json():
    @dataclass(frozen=True)
    class Mine:
        weights: Path = Path("a.safetensors")
        levels: tuple = (1, (Path("b"), 2.0))
        named: dict = field(default_factory=lambda: {"c": Path("d")})

    assert json.loads(json.dumps(describe(Mine()))) == {
        "class": "Mine", "weights": "a.safetensors", "levels": [1, ["b", 2.0]], "named": {"c": "d"}}
