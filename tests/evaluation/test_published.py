"""Scores as publications take them, against figures computed by hand and by their definitions."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
import torch

from phydict.evaluation.published import psnr_slices, ssim_slices, ssim_uniform
from phydict.units import HUWindow

X2CT = HUWindow(-1000.0, 1500.0)


def volumes(shape=(9, 10, 11)) -> tuple[torch.Tensor, torch.Tensor]:
    make = torch.Generator().manual_seed(0)
    truth = 300 * torch.randn(shape, generator=make)
    return truth + 100 * torch.randn(shape, generator=make), truth


def test_an_offset_has_one_psnr_in_every_slice_and_the_peak_is_the_range():
    truth = torch.zeros(4, 5, 6)
    assert psnr_slices(truth + 25, truth, X2CT) == pytest.approx(20 * math.log10(2500 / 25))
    trap = 20 * math.log10(4095 / 25)
    assert trap - psnr_slices(truth + 25, truth, X2CT) == pytest.approx(4.286, abs=1e-3)


def test_slices_and_volume_have_other_psnrs_where_the_error_is_in_one_slice():
    truth = torch.zeros(4, 4, 4)
    wrong = truth.clone()
    wrong[:, :, 0] = 250
    volume = 10 * math.log10(2500**2 / (250**2 / 4))
    across, along = (3 * 100 + 20) / 4, volume
    assert psnr_slices(wrong, truth, X2CT) == pytest.approx((across + 2 * along) / 3)
    assert psnr_slices(wrong, truth, X2CT) > volume + 10


def test_psnr_of_slices_is_the_mean_over_slices_and_planes_and_clips():
    hu, truth = volumes()
    x, y = (v.double().clamp(-1000, 1500).numpy() for v in (hu, truth))
    wanted = np.mean([np.mean([10 * np.log10(2500**2 / np.mean((a - b) ** 2))
                               for a, b in zip(*(np.moveaxis(v, axis, 0) for v in (x, y)))]) for axis in range(3)])
    assert psnr_slices(hu, truth, X2CT) == pytest.approx(wanted)
    high = torch.full((3, 3, 3), 1500.0)
    assert psnr_slices(high + 500, high, X2CT) == 100


def by_windows(x: np.ndarray, y: np.ndarray) -> float:
    """SSIM of arrays in [0, 1], window by window of 7 along each axis."""
    found = []
    for start in itertools.product(*(range(n - 6) for n in x.shape)):
        a, b = (v[tuple(slice(s, s + 7) for s in start)].ravel() for v in (x, y))
        c = np.cov(a, b)
        found.append((2 * a.mean() * b.mean() + 1e-4) * (2 * c[0, 1] + 9e-4)
                     / ((a.mean() ** 2 + b.mean() ** 2 + 1e-4) * (c[0, 0] + c[1, 1] + 9e-4)))
    return float(np.mean(found))


def test_uniform_ssim_is_that_of_its_windows_in_the_volume_and_in_the_slices():
    hu, truth = volumes()
    x, y = ((v.double().clamp(-1000, 1500).numpy() + 1000) / 2500 for v in (hu, truth))
    assert ssim_uniform(hu, truth, X2CT) == pytest.approx(by_windows(x, y), rel=1e-9)
    wanted = np.mean([np.mean([by_windows(a, b) for a, b in zip(*(np.moveaxis(v, axis, 0) for v in (x, y)))])
                      for axis in range(3)])
    assert ssim_slices(hu, truth, X2CT) == pytest.approx(wanted, rel=1e-9)
    assert ssim_uniform(truth, truth, X2CT) == pytest.approx(1) == ssim_slices(truth, truth, X2CT)
