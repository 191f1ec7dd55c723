"""Teaching the text side of a prior before denoising begins.

Denoising alone teaches text slowly, since at most noise levels the state shows what the report says. So the sentences
of written reports, whose findings are known, come first: the encoder and the map of kinds learn which kinds a sentence
states, and where in the chest these lie. Sentences that deny findings, or are of something else, state none.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from typing import cast

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits, mse_loss

from phydict.datasets.phantoms.findings import KINDS
from phydict.datasets.phantoms.places import examples, extents
from phydict.datasets.prose import naming_words, telling_words
from phydict.prior.kind_map import KindMap
from phydict.prior.prior import Prior
from phydict.prior.text import TextEncoder

BATCH, LEARNING_RATE = 64, 2e-3
EXTENT_WEIGHT = 40.0
"""Of the extents' squared error beside the kinds' cross-entropy: less, and the side of a finding is learnt last."""

STRANGE, NAMELESS = 0.35, 0.12
"""Shares of the sentences that are given strange words, and that lose the names of their findings."""


def learn_sentences(prior: Prior, sentences: Sequence[tuple[str, tuple[int, ...]]], steps: int, seed: int = 0,
                    words: Sequence[str] = (), on_step: Callable[[], None] = lambda: None) -> list[float]:
    """The report encoder and the map of kinds learn from sentences, each with the `examples` that it states.

    words: any words that reports may hold; on_step: called after each step. Returns the loss of each step.
    """
    text, kind_map = cast(TextEncoder, prior.text), cast(KindMap, prior.network.text_map)
    weights = [*text.parameters(), *kind_map.parameters()]
    resting = [weight for weight in weights if not weight.requires_grad]
    for weight in weights:
        weight.requires_grad_(True)
    targets = Targets(kind_map.cells, prior.grid.extent[0], prior.null.device)
    targets.begin(kind_map)
    disguise = Disguise(words)
    optimizer = torch.optim.AdamW(weights)
    rng, losses = np.random.default_rng(seed), []
    for step in range(steps):
        for group in optimizer.param_groups:
            group["lr"] = LEARNING_RATE * min(1, (step + 1) / 50, 2 * (1 - step / steps))
        picked = [disguise(*sentences[int(i)], rng) for i in rng.integers(len(sentences), size=BATCH)]
        states = text.read_sentences([sentence for sentence, _ in picked])
        states = torch.cat([states, prior.null[0].detach().to(states)])  # which stands for no sentence
        score, extent = kind_map.answers(states[None])
        stated, filled = targets([findings for _, findings in picked] + [()])
        loss = binary_cross_entropy_with_logits(score[0].float(), stated)
        if stated.any():
            loss = loss + EXTENT_WEIGHT * mse_loss(extent[0][stated > 0].float(), filled[stated > 0])
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(float(loss.detach()))
        on_step()
    for weight in resting:
        weight.requires_grad_(False)
    return losses


class Targets:
    """What sentences state, of the `examples` that they name: kinds (N, kinds) in {0, 1}, and the extent of each
    (N, kinds, cells^3), that of the example that fills most in each cell."""

    def __init__(self, cells: int, side: float, device: torch.device | str = "cpu"):
        self.extents = torch.from_numpy(extents(cells, side).copy()).flatten(1).to(device)
        self.kinds = [KINDS.index(finding.kind) for finding in examples()]

    @torch.no_grad()
    def begin(self, kind_map: KindMap) -> None:
        """Each kind's maps begin as the principal components of its examples' extents, for sentences to be mixed of:
        from random maps, places are learnt after kinds, and hardly in the same steps."""
        for kind in range(len(KINDS)):
            kind_extents = self.extents[[place for place, of in enumerate(self.kinds) if of == kind]]
            components = torch.linalg.svd(kind_extents, full_matrices=False).Vh[:kind_map.maps.shape[1]]
            kind_map.maps[kind] = 0
            kind_map.maps[kind, :len(components)] = components

    def __call__(self, stated: Sequence[tuple[int, ...]]) -> tuple[Tensor, Tensor]:
        filled = self.extents.new_zeros(len(stated), len(KINDS), self.extents.shape[1])
        kinds = filled.new_zeros(len(stated), len(KINDS))
        for row, findings in enumerate(stated):
            for finding in findings:
                kind = self.kinds[finding]
                kinds[row, kind] = 1
                filled[row, kind] = torch.maximum(filled[row, kind], self.extents[finding])
        return kinds, filled


class Disguise:
    """Sentences with words of elsewhere, so that a reader goes by the words that tell, and by no others.

    words: that reports may hold. Some sentences get a few more of them, and in some they stand for words that tell
    nothing, which changes no finding; in some they stand for the words that name findings, and no finding is left.
    """

    def __init__(self, words: Sequence[str]):
        self.telling, self.naming = set(telling_words()), set(naming_words())
        self.words = [word for word in words if word not in self.telling]

    def __call__(self, sentence: str, findings: tuple[int, ...],
                 rng: np.random.Generator) -> tuple[str, tuple[int, ...]]:
        case = rng.random()
        if not self.words or case > STRANGE + NAMELESS:
            return sentence, findings
        parts = re.findall(r"\w+|[^\w\s]", sentence)
        if case < NAMELESS:
            return " ".join(self._any(rng) if part.lower() in self.naming else part for part in parts), ()
        parts = [self._any(rng) if part.isalpha() and part.lower() not in self.telling and rng.random() < 0.4
                 else part for part in parts]
        for _ in range(int(rng.integers(0, 4))):
            parts.insert(int(rng.integers(len(parts) + 1)), self._any(rng))
        return " ".join(parts), findings

    def _any(self, rng: np.random.Generator) -> str:
        return self.words[int(rng.integers(len(self.words)))]
