"""A text-conditioned diffusion prior of CT: network, text, schedule, and the grid and HU window it was trained on."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from phydict.diffusion import CosineSchedule, guided
from phydict.grid import Grid
from phydict.prior.detail import DetailNetwork
from phydict.prior.stage_file import header_start
from phydict.prior.text import TextEncoder
from phydict.prior.unet import VolumeUNet
from phydict.runtime.precision import network_precision
from phydict.runtime.warning import warn
from phydict.units import HUWindow

if TYPE_CHECKING:
    from phydict.prior.medsyn.prior import MedSynPrior

STATE = ("ct", "lung", "airway", "vessel")
"""The channels of the state: the CT volume, then soft anatomy masks mapped to [-1, 1]."""


DETAIL_REACH = 8.0
"""Noise, over the size of the detail, beyond which a detail network is not called."""


def preconditioning(schedule: CosineSchedule, t: Tensor, size: float, skip_std: float) -> tuple[Tensor, Tensor]:
    """At times t (B,): the share of x_t / a in an estimate, and the scale of a network's output, whose size is `size`;
    see Prior."""
    sigma = schedule.sigma(t.double()).float().view(-1, 1, 1, 1, 1)
    share = skip_std**2 / (sigma**2 + skip_std**2)
    return share, (((1 - share) * size) ** 2 + (share * sigma) ** 2).sqrt()


class Prior(nn.Module):
    """x0-predicting denoiser of the state (B, C, X, Y, Z), channel 0 the CT in the prior's range.

    x0 = k x_t / a + c_out F(c_in x_t, t, context): the network F predicts the clean state, in units of its expected
    size; only below the noise level `skip_std` does the input itself take over, k = skip_std^2 / (sigma^2 +
    skip_std^2). (With Karras et al.'s larger skip, arXiv:2206.00364, F would have to carry the noise voxel by voxel
    through its narrow top level, and removes none of it.)

    A detail network D works on single voxels where F works on blocks: to x0 it adds
    c D((x_t / a - b) / sqrt(sigma^2 + skip_std^2), b, t) with b = sigma_data F and c = sigma skip_std / sqrt(sigma^2 +
    skip_std^2), Karras et al.'s preconditioning of what b lacks, whose expected size is skip_std. It is left out where
    sigma > DETAIL_REACH skip_std and the noise hides all detail.

    ends_at_zero: whether its own inference ends with a call at time 0 (see PriorOnly).
    network: F; detail: D, None for a prior without; text: the report encoder, None for a prior without text or until
    `load_text`, if there is one, returns it when the first report arrives; grid, window: where and in which HU range
    the volumes live; sigma_data: standard deviation of the state; skip_std: see above. unheard: what is warned of at
    the first report.
    """

    ends_at_zero = False

    def __init__(self, network: VolumeUNet, grid: Grid, window: HUWindow, text: TextEncoder | None = None,
                 schedule: CosineSchedule = CosineSchedule(), sigma_data: float = 0.5, skip_std: float = 0.1,
                 detail: DetailNetwork | None = None):
        super().__init__()
        if text is not None and text.width != network.context_dim:
            raise ValueError(f"this text encoder's tokens have width {text.width}, but the network's context_dim is "
                             f"{network.context_dim}: build the network with context_dim {text.width}")
        self.network, self.detail, self.text = network, detail, text
        self.load_text: Callable[[], TextEncoder] | None = None
        self.work_on(grid)
        self.window, self.schedule, self.sigma_data = window, schedule, sigma_data
        self.skip_std, self.unheard = skip_std, ""
        self.null = nn.Parameter(0.02 * torch.randn(1, 1, network.context_dim))

    def work_on(self, grid: Grid) -> None:
        """Takes the voxels of `grid`, none of which its weights are bound to. Raises ValueError for sizes that the
        network cannot halve."""
        if not self.takes(grid.shape):
            raise ValueError(f"this network needs sizes divisible by {self.network.divisor}, but the grid is "
                             f"{grid.shape}")
        self.grid, self.network.map_shape = grid, tuple(n // self.network.block for n in grid.shape)

    def takes(self, shape: Sequence[int]) -> bool:
        """Whether the network can halve a state of so many voxels along each axis."""
        return not any(n % self.network.divisor for n in shape)

    def ready_text(self) -> TextEncoder | None:
        """The report encoder, read from its file where it is not yet; None for a prior without text."""
        if self.text is None and self.load_text is not None:
            self.text = self.load_text().to(self.null.device)
        return self.text

    def context(self, reports: Sequence[str]) -> Tensor:
        """Reports -> contexts (B, L, D); the learned null token stands for padding and for a report left empty.

        Without any report the text encoder is not loaded and L is 1.
        """
        if not any(reports):
            return self.null.expand(len(reports), 1, -1)
        text = self.ready_text()
        if text is None:
            raise ValueError("this prior was trained without text, but a report was given: leave the report out")
        states, mask = text(list(reports))
        mask = mask & torch.tensor([bool(r) for r in reports], device=mask.device)[:, None]
        return torch.where(mask[..., None], states, self.null)

    def describe(self) -> dict:
        """What the prior is, as plain JSON values: from this and the weights `load_prior` builds it again."""
        encoder = self.text
        text = None if encoder is None else {
            "source": encoder.source, "length": encoder.length, "width": encoder.width,
            "layers": encoder.bert.config.num_hidden_layers,
            "vocabulary": None if encoder.source else encoder.vocabulary,
            **({"padded_to": encoder.padded_to} if encoder.padded_to else {}),
            **({"sentences": encoder.sentences} if encoder.sentences else {})}
        return header_start("base", self.grid, self.window) | {
            "state": STATE[:self.network.state_channels], "sigma_data": self.sigma_data, "skip_std": self.skip_std,
            "schedule": vars(self.schedule), "text": text, "network": self.network.settings,
            **({"detail": self.detail.settings} if self.detail else {})}  # which older files do not name

    @property
    def state_channels(self) -> int:
        """Channels of the state: the CT, then masks."""
        return self.network.state_channels

    @property
    def reads_text(self) -> bool:
        """Whether a report can be given."""
        return self.text is not None or self.load_text is not None

    def forward(self, x: Tensor, t: Tensor, context: Tensor,
                offsets: tuple[Tensor | None, Tensor | None] = (None, None)) -> Tensor:
        """Clean estimate of the state x (B, C, X, Y, Z) at times t (B,), in x's dtype, of 32 bits at least.

        offsets: what is added at the entrance of the network and of the detail network (see Refiner).
        """
        a, s = (w.to(x.dtype).view(-1, 1, 1, 1, 1) for w in self.schedule.scales(t.double()))
        share, out = self.preconditioning(t)
        inward = (s**2 + (a * self.sigma_data) ** 2).rsqrt()
        answer = self.network(inward * x, t, context, offsets[0]).to(x.dtype)
        x0 = share * x / a + out * answer
        if self.detail is None:
            return x0
        return self._with_detail(self.detail, x0, x, a, self.sigma_data * answer, t, offsets[1])

    def _with_detail(self, detail: DetailNetwork, x0: Tensor, x: Tensor, a: Tensor, estimate: Tensor, t: Tensor,
                     offset: Tensor | None) -> Tensor:
        """`x0` and what the detail network adds. In training it is always run, so that every process does the
        same."""
        sigma = self.schedule.sigma(t.double()).to(x.dtype)
        reached = sigma <= DETAIL_REACH * self.skip_std
        active = reached.nonzero().flatten()
        if not len(active):
            if not self.training:
                return x0
            active = active.new_zeros(1)
        size = (sigma**2 + self.skip_std**2).sqrt()
        inward, out = (w[active].view(-1, 1, 1, 1, 1) for w in (1 / size, reached * sigma * self.skip_std / size))
        estimate = estimate[active]
        answer = detail(inward * (x[active] / a[active] - estimate), estimate, t[active].to(x.dtype),
                        None if offset is None else offset[active])
        return x0.index_add(0, active, out * answer.to(out))

    def network_inputs(self, shape: Sequence[int]) -> tuple[Tensor, Tensor, Tensor]:
        """Zeros on the default device, laid out as what the network is given for one state of `shape` voxels."""
        length = self.text.states if self.text is not None else 1
        return (torch.zeros(1, self.state_channels, *shape), torch.zeros(1),
                torch.zeros(1, length, self.network.context_dim))

    def preconditioning(self, t: Tensor) -> tuple[Tensor, Tensor]:
        """At times t (B,): the share of x_t / a in the estimate, and the scale of the network's output."""
        return preconditioning(self.schedule, t, self.sigma_data, self.skip_std)

    @torch.no_grad()
    def bind(self, report: str = "", guidance: float = 1.0, precision: str = "auto") -> BoundPrior:
        """The denoiser of one report, with classifier-free guidance of the given scale inside (1 = none).

        precision: see phydict.runtime.precision. Warns where a report is cut or in words that the text
        encoder does not know.
        """
        if guidance < 0:
            raise ValueError(f"the guidance scale is at least 0, but {guidance} was given")
        context = self.context([report])
        if report and self.unheard:
            warn(self.unheard)
        if report and self.text is not None:
            self.text.check([report])
        return BoundPrior(self, context, guidance if report else 1.0, precision)


@dataclass(frozen=True)
class BoundPrior:
    """A Denoiser: a prior with its context fixed. Two network calls per step when guidance is not 1."""

    prior: Prior | MedSynPrior
    context: Tensor
    guidance: float
    precision: str = "auto"

    @property
    def schedule(self) -> CosineSchedule:
        return self.prior.schedule

    def denoise(self, x: Tensor, t: float) -> Tensor:
        """E[x_0 | x_t = x, report]. Differentiable where x requires a gradient; otherwise nothing is kept for one."""
        n, prior = len(x), self.prior
        times = torch.full((n,), float(t), device=x.device)
        with torch.set_grad_enabled(x.requires_grad), network_precision(self.precision, x):
            conditional = prior(x, times, self.context.expand(n, -1, -1))
            if self.guidance == 1.0:
                return conditional
            null = prior.null.expand(n, self.context.shape[1], -1)
            return guided(conditional, prior(x, times, null), self.guidance)
