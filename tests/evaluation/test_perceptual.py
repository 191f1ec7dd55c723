"""LPIPS of a volume's slices, by untrained backbones, which the figures of a test do not need."""

from __future__ import annotations

import pytest
import torch

from phydict.evaluation import perceptual
from phydict.evaluation.perceptual import load_networks, lpips_scores
from phydict.runtime import lpips_networks
from phydict.runtime.lpips_networks import load_lpips
from phydict.units import HUWindow


@pytest.fixture
def untrained(monkeypatch):
    monkeypatch.setattr(perceptual, "load_lpips", lambda backbone, *_: load_lpips(backbone, True))


def noise(seed: int) -> torch.Tensor:
    return 300 * torch.randn(34, 34, 34, generator=torch.Generator().manual_seed(seed))


def test_a_volume_is_at_no_distance_of_itself_and_noise_moves_it_away(untrained):
    truth = noise(0)
    same, near, far = (lpips_scores(truth + amount * noise(1), truth) for amount in (0, 0.3, 1.5))
    for name in ("lpips_alex", "lpips_squeeze"):
        assert same[name] == pytest.approx(0, abs=1e-6) and 1e-6 < near[name] < far[name]


def test_what_lies_beyond_the_range_is_not_seen(untrained):
    truth = noise(0)
    truth[:, :, 20:] = 1000
    far = torch.where(truth == 1000, 3000.0, truth)
    assert lpips_scores(far, truth) == pytest.approx({"lpips_alex": 0, "lpips_squeeze": 0}, abs=1e-6)


def test_the_range_is_the_one_that_is_scored(untrained):
    truth = noise(0)
    truth[:, :, 20:] = 1000
    far = torch.where(truth == 1000, 1400.0, truth)
    assert all(score > 1e-6 for score in lpips_scores(far, truth, scored=HUWindow(-1000, 1500)).values())


def test_slices_that_are_too_small_and_a_missing_backbone_are_refused(untrained, monkeypatch, tmp_path):
    small, least = (torch.zeros(perceptual.LEAST_SIDE - lacking, 33, 33) for lacking in (1, 0))
    with pytest.raises(ValueError, match="30 x 33 x 33 voxels are too small .* 31 .* more voxels, or leave lpips out"):
        lpips_scores(small, small)
    assert lpips_scores(least, least) == {"lpips_alex": 0, "lpips_squeeze": 0}
    monkeypatch.undo()

    def offline(*_, **__):
        raise OSError("no network")

    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    monkeypatch.setattr(torch.hub, "download_url_to_file", offline)
    lpips_networks.load_lpips.cache_clear()
    with pytest.raises(FileNotFoundError, match="alexnet-owt-7be5be79.pth .* leave lpips out of the metrics"):
        load_networks()


@pytest.mark.parametrize("content", [b"<!DOCTYPE html><html>Not found</html>", b"PK\x03\x04 and no more", b""],
                         ids=["page", "truncated", "empty"])
def test_a_damaged_backbone_is_one_sentence_that_names_the_file(content, tmp_path, monkeypatch):
    file = tmp_path / "hub" / "checkpoints" / lpips_networks.FILES["alex"]
    file.parent.mkdir(parents=True)
    file.write_bytes(content)
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    load_lpips.cache_clear()
    with pytest.raises(ValueError, match="cannot be read as the trained backbone .* leave lpips out") as error:
        load_networks()
    assert str(file) in str(error.value) and "\n" not in str(error.value)
