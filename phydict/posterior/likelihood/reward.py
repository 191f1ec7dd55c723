"""The reward of Eq. 5: how well a volume's projections agree with the measured X-rays.

| here            | paper                                             |
|-----------------|---------------------------------------------------|
| Reward()(m, x)  | -J(Y, x), J = (1/K) sum_k (|y_k - P_k(x)|^2 + LPIPS) |

The authors' release differs in almost every term: each difference is a switch.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import interpolate

from phydict.posterior.measurement import Measurement
from phydict.runtime.lpips_networks import load_lpips, lpips_distances
from phydict.xray import Projector
from phydict.xray.boxes import divided


@dataclass(frozen=True)
class Reward:
    """-J(Y, x) per case: squared error per view plus `lpips` times the perceptual distance.

    Args:
        lpips: weight of LPIPS; at 0 it is not loaded
        backbone: of LPIPS: alex, vgg or squeeze
        random_backbone: use LPIPS with an untrained backbone, which needs no download; its figures mean nothing beside
            those of the trained one
        dropout: leave LPIPS' dropout active, as it is in training; it then draws anew at each call
        squared: weight of the squared error
        pixel_mean: the squared error's mean over a view's pixels instead of the sum
        view_sum: the sum over views instead of the mean
        standardise: both views of a pair less their mean and divided by their standard deviation, each by itself; LPIPS
            is then given those
        raw_range: project the prior's range itself, zero outside the volume, instead of attenuation
        renderer: a kind of Projector instead of the measurement's
        upsampling: project the volume on a grid so many times finer
        nearest: repeat each voxel on that grid instead of interpolating linearly
    """

    lpips: float = 0.0
    backbone: str = "vgg"
    random_backbone: bool = False
    dropout: bool = False
    squared: float = 1.0
    pixel_mean: bool = False
    view_sum: bool = False
    standardise: bool = False
    raw_range: bool = False
    renderer: str | None = None
    upsampling: int = 1
    nearest: bool = False

    def __post_init__(self):
        if self.upsampling < 1:
            raise ValueError(f"a volume is projected on a grid at least 1 times as fine, but upsampling "
                             f"{self.upsampling} was given")

    def __call__(self, measurement: Measurement, x: Tensor) -> Tensor:
        """CTs x (B, 1, X, Y, Z) in the prior's range -> rewards (B,)."""
        views = self.project(measurement, x), measurement.y
        projected, measured = (_standardised(v) for v in views) if self.standardise else views
        error = (projected - measured).square()
        error = self.squared * (error.mean((-2, -1)) if self.pixel_mean else error.sum((-2, -1)))
        if self.lpips:
            error = error + self.lpips * self._lpips(projected, measured, seed=measurement.calls)
        return -(error.sum(1) if self.view_sum else error.mean(1))

    def project(self, measurement: Measurement, x: Tensor) -> Tensor:
        """What is compared with the X-rays: projections (B, K, V, U) of the CT x."""
        if not (self.raw_range or self.renderer or self.upsampling > 1):
            return measurement.project(x)
        projector, n = measurement.projector, self.upsampling
        field = x if self.raw_range else measurement.slope * x + measurement.offset
        if n > 1:
            field = interpolate(field, scale_factor=n, mode="nearest" if self.nearest else "trilinear")
        if self.renderer or n > 1:
            projector = Projector(divided(projector.grid, n), projector.beam, self.renderer or "auto", device=x.device,
                                  full_detector=True)
        measurement.calls += len(x)
        return projector(field) + (0.0 if self.raw_range else measurement.added)

    def _lpips(self, projected: Tensor, measured: Tensor, seed: int) -> Tensor:
        """LPIPS per view (B, K). The measured views' range is mapped to the [-1, 1] that LPIPS expects, unless both
        are standardised. seed: of dropout, if any."""
        images = projected, measured.expand_as(projected)
        if not self.standardise:
            low, high = measured.amin((-2, -1), keepdim=True), measured.amax((-2, -1), keepdim=True)
            scale = 2 / (high - low).clamp(min=1e-6)
            images = (images[0] - low) * scale - 1, (images[1] - low) * scale - 1
        network = load_lpips(self.backbone, self.random_backbone).to(projected.device).train(self.dropout)
        with torch.random.fork_rng(enabled=self.dropout):
            if self.dropout:
                torch.manual_seed(seed)
            distances = lpips_distances(network, images[0].flatten(0, 1), images[1].flatten(0, 1),
                                    "give a finer detector, or set the reward's lpips weight to 0")
        return distances.view(projected.shape[:2])


def _standardised(views: Tensor) -> Tensor:
    deviation, mean = torch.std_mean(views, (-2, -1), keepdim=True)
    return (views - mean) / deviation.clamp(min=1e-6)
