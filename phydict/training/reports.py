"""Teaching a report encoder before denoising begins.

Denoising alone teaches text slowly, since at most noise levels the state shows what the report says. Two short tasks
come first: telling a report's findings, and sketching what they change in the CT. The sketch is of the change alone,
since in a whole CT one finding is too small a part for its side to be learnt.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

import torch
from torch import Tensor, nn
from torch.nn.functional import binary_cross_entropy_with_logits

from phydict.prior.prior import Prior
from phydict.prior.text import TextEncoder

BATCH, LEARNING_RATE = 32, 2e-3


def learn_findings(text: TextEncoder, reports: list[str], labels: Tensor, steps: int, seed: int = 0) -> list[float]:
    """The encoder learns to tell findings: labels (N, F) in {0, 1} of N reports. Returns the loss of each step."""
    head = nn.Linear(text.width, labels.shape[1]).to(text.bert.device)

    def loss(picked: list[int]) -> Tensor:
        states, mask = text([reports[i] for i in picked])
        mean = (states * mask[..., None]).sum(1) / mask.sum(1, keepdim=True)
        return binary_cross_entropy_with_logits(head(10 * mean), labels[picked].to(mean))

    return _learn([*text.parameters(), *head.parameters()], loss, len(reports), steps, seed)


def learn_sketch(prior: Prior, reports: list[str], maps: Tensor, steps: int, seed: int = 0) -> list[float]:
    """The text map learns maps (N, 1, cells^3) that N reports imply, in units of their root mean square.

    Returns the loss of each step.
    """
    text_map, maps = prior.network.text_map, maps / maps.square().mean().sqrt().clamp(min=1e-6)

    def loss(picked: list[int]) -> Tensor:
        with torch.no_grad():
            context = prior.context([reports[i] for i in picked])
        return (text_map.sketch(context) - maps[picked].to(context)).square().mean()

    return _learn(text_map.parameters(), loss, len(reports), steps, seed)


def _learn(parameters: Iterable[Tensor], loss: Callable[[list[int]], Tensor], cases: int, steps: int,
           seed: int) -> list[float]:
    optimizer = torch.optim.AdamW(parameters)
    draw, losses = torch.Generator().manual_seed(seed), []
    for step in range(steps):
        for group in optimizer.param_groups:
            group["lr"] = LEARNING_RATE * min(1, (step + 1) / 50, 3 * (1 - step / steps))
        value = loss(torch.randint(cases, (BATCH,), generator=draw).tolist())
        optimizer.zero_grad()
        value.backward()
        optimizer.step()
        losses.append(float(value.detach()))
    return losses
