"""A prior's denoiser that sees the X-rays: it takes what they say of each voxel beside the state."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from phydict.diffusion import CosineSchedule
from phydict.grid import Grid
from phydict.prior.convolution import lay_out, silence, speed_up
from phydict.prior.evidence_channels import EVIDENCE_CHANNELS
from phydict.prior.kind_map import KindMap
from phydict.prior.prior import BoundPrior, Prior
from phydict.prior.uncertainty import Uncertainty
from phydict.prior.unet import VolumeUNet
from phydict.runtime.precision import network_precision
from phydict.units import HUWindow

GATE_WIDTH = 16

STATED = 0.5
"""Probability from which a report counts as stating a finding. Phantoms' with findings have 0.96 and more, those
without, and sentences that deny or call all normal, 0.01 at most."""


class Refiner(nn.Module):
    """One call of an unrolled reconstruction: state and evidence in, clean state out.

    x0 = p + g (x_t / a - p) with p = prior(x_t, t, context), where linear maps of the evidence (B, EVIDENCE_CHANNELS,
    X, Y, Z) are added at the entrance of its network and of its detail network. The gate g, of evidence and time, says
    of each voxel how much of the CT is kept as it is; masks are not gated. Maps and gate start at zero, so that an
    untrained refiner is its prior. Unrolled networks: Adler & Oktem 2018, doi:10.1109/TMI.2018.2799231.

    prior: whose weights are trained on; it needs a detail network. mean: the state (C, X, Y, Z) that an unrolled
    reconstruction starts from. uncertainty: what says how far the last state may be off, None for a refiner without.
    first: a prior, left as it is, that reads reports instead: with one, a reconstruction from few X-rays starts from
    what it makes of both, and the calls hear of the report by that alone. A report that states no finding of those that
    it knows counts as none: that all is normal cost real CTs 0.6 dB from one view. None for a refiner whose calls read
    reports.
    """

    mean: Tensor
    first: Prior | None

    def __init__(self, prior: Prior, mean: Tensor, uncertainty: Uncertainty | None = None, first: Prior | None = None):
        super().__init__()
        if prior.detail is None:
            raise ValueError("a refiner needs a prior with a detail network, but this one has none: give another prior")
        self.prior, self.uncertainty, self.first = prior, uncertainty, None
        block, width = prior.network.block, prior.network.settings["channels"][0]
        self.entrance = nn.Conv3d(EVIDENCE_CHANNELS * block**3, width, 1)
        self.detail_entrance = nn.Conv3d(EVIDENCE_CHANNELS, prior.detail.settings["width"], 3, padding=1)
        self.gate = nn.Sequential(nn.Conv3d(EVIDENCE_CHANNELS + 1, GATE_WIDTH, 1), nn.SiLU(),
                                  nn.Conv3d(GATE_WIDTH, 1, 1))
        for layer in (self.entrance, self.detail_entrance, self.gate[-1]):
            silence(layer)
        lay_out(self.detail_entrance)
        speed_up(self)
        self.register_buffer("mean", mean)
        if first is not None:
            self.begin_with(first)

    def begin_with(self, first: Prior) -> None:
        """Reports are read by `first`, of the same grid, HU window, state and noise schedule, and no more by the calls.
        It becomes a part of this refiner. Raises ValueError for another."""
        if (not first.grid.same_as(self.grid) or first.window != self.window or first.schedule != self.schedule
                or first.state_channels != self.state_channels):
            raise ValueError("a refiner begins with a prior of its own grid, HU window, state and noise schedule, but "
                             "others were given: give another prior")
        self.first = first.eval().requires_grad_(False)
        self.prior.text = self.prior.load_text = None

    def describe(self) -> dict:
        """What the refiner is, as plain JSON values, for `build_refiner`: its prior, called by another stage."""
        described = self.prior.describe() | {"stage": "refiner"}
        if self.uncertainty:
            described["uncertainty"] = self.uncertainty.settings
        if self.first:
            first = self.first.describe()
            described |= {"text": first.pop("text"), "first": first}
        return described

    def train(self, mode: bool = True) -> Refiner:
        super().train(mode)
        if self.first is not None:
            self.first.eval()
        return self

    @property
    def reader(self) -> Prior:
        """The prior that reads reports."""
        return self.first or self.prior

    @property
    def grid(self) -> Grid:
        return self.prior.grid

    @property
    def window(self) -> HUWindow:
        return self.prior.window

    @property
    def schedule(self) -> CosineSchedule:
        return self.prior.schedule

    @property
    def state_channels(self) -> int:
        return self.prior.state_channels

    @property
    def network(self) -> VolumeUNet:
        return self.prior.network

    def takes(self, shape: Sequence[int]) -> bool:
        """As for a Prior."""
        return self.prior.takes(shape)

    def network_inputs(self, shape: Sequence[int]) -> tuple[Tensor, Tensor, Tensor]:
        """As for a Prior."""
        return self.prior.network_inputs(shape)

    @property
    def reads_text(self) -> bool:
        """As for a Prior."""
        return self.reader.reads_text

    def forward(self, x: Tensor, t: Tensor, context: Tensor, evidence: Tensor) -> Tensor:
        """Clean estimate of the state x (B, C, X, Y, Z) at times t (B,), in x's dtype."""
        evidence = evidence.to(x.dtype)
        x0 = self.prior(x, t, context, (self.entrance(self.prior.network.blocked(evidence)),
                                        self.detail_entrance(evidence)))
        a, t = self.schedule.scales(t.double())[0].to(x.dtype), t.to(x.dtype)
        kept = self.gate(torch.cat([evidence, t.view(-1, 1, 1, 1, 1).expand_as(evidence[:, :1])], 1)).to(x.dtype)
        ct = x0[:, :1] + kept * (x[:, :1] / a.view(-1, 1, 1, 1, 1) - x0[:, :1])
        return torch.cat([ct, x0[:, 1:]], 1)

    @torch.no_grad()
    def bind(self, report: str = "", guidance: float = 1.0, precision: str = "auto") -> BoundRefiner:
        """The refiner of one report. guidance: 1, since the X-rays guide. Otherwise as for a Prior."""
        if guidance != 1:
            raise ValueError(f"a refiner is guided by the X-rays alone, but a guidance scale of {guidance} was given: "
                             "leave it at 1, or use phydict_fast")
        context, first = self.conditioning(self.reader.bind(report, 1.0, precision), bool(report))
        return BoundRefiner(self, context, precision, first)

    def conditioning(self, heard: BoundPrior, reported: bool) -> tuple[Tensor, BoundPrior | None]:
        """Of what the reader has heard, the context (1, L, D) of the calls, and the denoiser to begin with, if any."""
        if self.first is None:
            return heard.context, None
        kinds = self.first.network.text_map
        if reported and isinstance(kinds, KindMap):
            reported = bool((kinds.stated(heard.context) > STATED).any())
        return self.prior.null, heard if reported else None


@dataclass(frozen=True)
class BoundRefiner:
    """A refiner with its context fixed.

    first: the denoiser that a reconstruction from few X-rays begins with; None: it starts from the mean.
    """

    refiner: Refiner
    context: Tensor
    precision: str = "auto"
    first: BoundPrior | None = None

    @property
    def schedule(self) -> CosineSchedule:
        return self.refiner.schedule

    @property
    def mean(self) -> Tensor:
        """The state (1, C, X, Y, Z) to start from."""
        return self.refiner.mean[None]

    @property
    def begins(self) -> bool:
        """Whether there is what a reconstruction from few X-rays begins with."""
        return self.first is not None

    def denoise(self, x: Tensor, t: float) -> Tensor:
        """What `first` answers."""
        return self.first.denoise(x, t)  # type: ignore[union-attr]  # is called where it `begins`

    def refine(self, x: Tensor, t: float, evidence: Tensor) -> Tensor:
        """The clean state of x (B, C, X, Y, Z) at time t, given the evidence (B, EVIDENCE_CHANNELS, X, Y, Z)."""
        times = torch.full((len(x),), float(t), device=x.device)
        with torch.no_grad(), network_precision(self.precision, x):
            return self.refiner(x, times, self.context.expand(len(x), -1, -1), evidence)

    def conclude(self, z: Tensor, evidence: Callable[[], Tensor]) -> None:
        """Is called with the last state and what computes the evidence there."""

    def half_widths(self, z: Tensor, evidence: Tensor) -> Tensor:
        """Half-widths (B, len(LEVELS), X, Y, Z), in the prior's range, of the intervals around the CT of the last state
        z, given the evidence there; of a refiner with uncertainty."""
        with torch.no_grad(), network_precision(self.precision, z):
            return self.refiner.uncertainty.half_widths(z, evidence)  # type: ignore[union-attr]
