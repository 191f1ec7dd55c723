"""What a report says of each kind of finding, and where: one coarse map per kind."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn


class KindMap(nn.Module):
    """One map per kind of finding, in which the sentence that says most counts: what lies on the right in one sentence
    is not lost among forty others that speak of normal organs.

    Each state s of the context (a sentence) scores each kind k, and weighs maps that the kind has learnt; drawn is
    max_s sigmoid(score_sk) sum_r weight_skr map_kr.

    context_dim: width D of the context; kinds: their names; cells: a map has cells^3 positions; maps: r of each kind.
    """

    def __init__(self, context_dim: int, kinds: Sequence[str], cells: int = 8, maps: int = 12):
        super().__init__()
        self.kinds, self.cells, self.channels = tuple(kinds), cells, len(kinds)
        self.read = nn.Sequential(nn.LayerNorm(context_dim), nn.Linear(context_dim, 2 * context_dim), nn.GELU())
        self.score = nn.Linear(2 * context_dim, len(kinds))
        self.weight = nn.Linear(2 * context_dim, len(kinds) * maps)
        self.maps = nn.Parameter(0.1 * torch.randn(len(kinds), maps, cells**3))

    def answers(self, context: Tensor) -> tuple[Tensor, Tensor]:
        """Context (B, L, D) -> of each state, scores (B, L, kinds) and extents (B, L, kinds, cells^3)."""
        read = self.read(context)
        weight = self.weight(read).unflatten(-1, self.maps.shape[:2])
        return self.score(read), torch.einsum("blkr,krp->blkp", weight, self.maps.to(weight))

    def forward(self, context: Tensor) -> Tensor:
        """Context (B, L, D) -> maps (B, kinds, cells, cells, cells)."""
        score, extent = self.answers(context)
        drawn = (score.sigmoid()[..., None] * extent).amax(1)
        return drawn.unflatten(2, (self.cells,) * 3)

    def stated(self, context: Tensor) -> Tensor:
        """Context (B, L, D) -> the probability of each kind that some state states it (B, kinds)."""
        return self.answers(context)[0].sigmoid().amax(1)
