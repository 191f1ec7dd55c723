"""MedSyn's stage 1 as a prior, and both stages' networks in short (Xu et al. 2024, doi:10.1109/TMI.2024.3415032).

| here                | resolution | condition           | parameters  |
|---------------------|------------|---------------------|-------------|
| TextUNet            | 64^3       | report              | 716,215,684 |
| SuperResolutionUNet | 256^3      | state of the 64^3   |  54,307,908 |

Both are UNets over (slice, row, column) that never downsample the slices. Their parameters bear the names of MedSyn's
checkpoints, which are therefore read strictly (`phydict.prior.medsyn.checkpoint`). What names and shapes leave open
follows the convention of the video diffusion UNets that they derive from (Ho et al. 2022, arXiv:2204.03458): attention
is normalised first and added to its input, the time gives scale before shift, sines stand before cosines, a level's own
features before the skipped ones. Going down, both resize before their block across slices, which is known of stage 1
alone. None of this could be compared with MedSyn's trained weights, which are not public.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn

from phydict.diffusion import CosineSchedule
from phydict.grid import Grid
from phydict.prior.medsyn.networks import STATE_CHANNELS, SliceUNet, TextUNet, from_slices, to_slices
from phydict.prior.prior import BoundPrior
from phydict.prior.text import TextEncoder
from phydict.units import HUWindow

WINDOW = HUWindow(-1024.0, 600.0)
"""The HU of MedSyn's range [-1, 1]."""

FIELD = (316.0, 316.0, 292.0)
"""Edge lengths in mm (x, y, z) of MedSyn's atlas, to which its CTs were registered: mm are the atlas's, not the
patient's."""


def atlas_grid(voxels: int) -> Grid:
    """`voxels`^3 voxels over MedSyn's atlas, centred on the isocentre: 64 at stage 1, 256 at stage 2."""
    return Grid((voxels,) * 3, (FIELD[0] / voxels, FIELD[1] / voxels, FIELD[2] / voxels))


class MedSynPrior(nn.Module):
    """MedSyn's stage 1 as a prior: denoises states (B, 4, X, Y, Z), in RAS+, of CT, lobe, airway and vessel masks.

    network: predicts the clean state; text: reports -> contexts (B, L, D), with or without a mask, such as a
    TextEncoder; None: `load_text`, if there is one, returns it when the first report arrives; grid: where the voxels
    are.
    The attenuation of the window's low end, -1024 HU, is slightly negative. ends_at_zero: MedSyn's inference descends
    in 50 steps from time 1 to 0 and denoises there once more.
    """

    window, schedule, state_channels = WINDOW, CosineSchedule(), STATE_CHANNELS
    ends_at_zero = True

    def __init__(self, network: TextUNet, text: Callable | None = None, grid: Grid = atlas_grid(64)):
        super().__init__()
        _check_divisible(network, grid)
        self.network, self.text, self.grid = network, text, grid
        self.load_text: Callable[[], Callable] | None = None

    @property
    def reads_text(self) -> bool:
        """As for a Prior."""
        return self.text is not None or self.load_text is not None

    @property
    def null(self) -> Tensor:
        """The learned context (1, L, D) of no report."""
        return self.network.null_cond_emb

    def context(self, reports: Sequence[str]) -> Tensor:
        """Reports -> contexts (B, L, D); the learned null context for an empty report.

        Raises ValueError where there is no text encoder, or where its contexts have another size.
        """
        null = self.null.expand(len(reports), -1, -1)
        if not any(reports):
            return null
        if self.text is None:
            if self.load_text is None:
                raise ValueError("this MedSyn prior has no text encoder, but a report was given: give MedSyn's "
                                 "language model as its text, or leave the report out")
            self.text = self.load_text()
        if isinstance(self.text, nn.Module):
            self.text.to(null.device)
        states = self.text(list(reports))
        states = states[0] if isinstance(states, tuple) else states
        if states.shape != null.shape:
            raise ValueError(f"MedSyn's contexts have {null.shape[1]} tokens of {null.shape[2]} numbers, but the text "
                             f"encoder gave {tuple(states.shape[1:])}: use MedSyn's language model and its first "
                             f"{null.shape[1]} positions")
        given = torch.tensor([bool(report) for report in reports], device=null.device)
        return torch.where(given[:, None, None], states.to(null), null)

    def forward(self, x: Tensor, t: Tensor, context: Tensor) -> Tensor:
        """Clean estimate of the state x (B, 4, X, Y, Z) at times t (B,), in x's dtype."""
        return from_slices(self.network(to_slices(x).contiguous(), t, context)).to(x.dtype)

    @torch.no_grad()
    def bind(self, report: str = "", guidance: float = 1.0, precision: str = "auto") -> BoundPrior:
        """The denoiser of one report, with classifier-free guidance of the given scale inside (1 = none).

        Warns where a TextEncoder cuts the report or does not know its words.
        """
        if guidance < 0:
            raise ValueError(f"the guidance scale is at least 0, but {guidance} was given")
        context = self.context([report])
        if report and isinstance(self.text, TextEncoder):
            self.text.check([report])
        return BoundPrior(self, context, guidance if report else 1.0, precision)


def _check_divisible(network: SliceUNet, grid: Grid) -> None:
    if any(n % network.divisor for n in grid.shape[:2]):
        raise ValueError(f"this network needs X and Y sizes divisible by {network.divisor}, but the grid is "
                         f"{grid.shape}")
