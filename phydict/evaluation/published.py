"""Scores as some publications take them, of volumes (X, Y, Z) in HU; not comparable with those of `volume_metrics`.

psnr_slices   mean of the PSNR of each slice, over the slices of a plane and then over the three planes, as X2CT-GAN's
              code does (Ying et al. 2019, arXiv:1905.06902), where equal slices count as 100 dB. The peak is the width
              of the HU range; that code's 4095 on a range of 2500 adds 20 log10(4095 / 2500) = 4.29 dB
ssim_slices   the same mean of 2-D SSIM with a uniform window of 7 x 7, as scikit-image computes it
ssim_uniform  3-D SSIM with a uniform window of 7 x 7 x 7, as scikit-image computes it: sample covariances, and only
              where the whole window lies inside
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch
from scipy.ndimage import uniform_filter
from torch import Tensor

from phydict.evaluation.planes import PLANES, slices
from phydict.units import HUWindow

WINDOW, EQUAL_DB = 7, 100.0


def psnr_slices(hu: Tensor, true_hu: Tensor, scored: HUWindow) -> float:
    """PSNR in dB of the slices, clipped to the HU range `scored`."""
    error = (hu.double().clamp(scored.low, scored.high) - true_hu.double().clamp(scored.low, scored.high)).square()
    means = []
    for plane in PLANES:
        squared = slices(error, plane).mean((1, 2))
        decibels = 10 * torch.log10((2 * scored.half_width) ** 2 / squared)
        means.append(torch.where(squared == 0, EQUAL_DB, decibels).mean())
    return float(torch.stack(means).mean())


def ssim_slices(hu: Tensor, true_hu: Tensor, scored: HUWindow) -> float:
    """2-D SSIM of the slices, clipped to the HU range `scored`."""
    x, y = _unit(hu, scored), _unit(true_hu, scored)
    return float(np.mean([_ssim(x, y, [a for a in range(3) if a != across]) for across in PLANES.values()]))


def ssim_uniform(hu: Tensor, true_hu: Tensor, scored: HUWindow) -> float:
    """3-D SSIM with a uniform window, of volumes clipped to the HU range `scored`."""
    return _ssim(_unit(hu, scored), _unit(true_hu, scored), range(3))


PUBLISHED: dict[str, Callable[[Tensor, Tensor, HUWindow], float]] = {
    "psnr_slices": psnr_slices, "ssim_slices": ssim_slices, "ssim_uniform": ssim_uniform}


def _unit(hu: Tensor, scored: HUWindow) -> np.ndarray:
    """HU in [0, 1], float64."""
    return ((scored.to_range(hu.double()) + 1) / 2).cpu().numpy()


def _ssim(x: np.ndarray, y: np.ndarray, axes: Sequence[int]) -> float:
    """The mean SSIM of arrays in [0, 1], by a window of WINDOW along `axes`."""
    size = [WINDOW if axis in axes else 1 for axis in range(x.ndim)]
    count = WINDOW ** len(axes)

    def mean(values: np.ndarray) -> np.ndarray:
        return uniform_filter(values, size)

    m, n = mean(x), mean(y)
    sample = count / (count - 1)
    xx, yy, xy = (sample * (mean(a * b) - p * q) for a, b, p, q in ((x, x, m, m), (y, y, n, n), (x, y, m, n)))
    c1, c2 = 0.01**2, 0.03**2
    ssim = (2 * m * n + c1) * (2 * xy + c2) / ((m**2 + n**2 + c1) * (xx + yy + c2))
    rim = WINDOW // 2
    return float(ssim[tuple(slice(rim, -rim) if axis in axes else slice(None) for axis in range(x.ndim))].mean())
