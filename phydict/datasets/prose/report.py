"""A whole report in a radiologist's prose: findings stated, most absent kinds denied, other organs, an impression."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from phydict.datasets.prose import elsewhere, phrases
from phydict.datasets.prose.sentences import Pen, unrelated
from phydict.datasets.reports import join_report

if TYPE_CHECKING:
    from phydict.datasets.phantoms.findings import Finding

PLEURAL, CARDIAC = {"effusion", "pneumothorax"}, {"cardiomegaly", "pericardial effusion"}


def write_report(findings: Sequence[Finding], contrast: bool, seed: int) -> str:
    """A report of these findings, laid out as `format_report` lays it out; the same seed writes the same report.

    It states every finding with its side and lobe, denies absent kinds alone, and speaks of technique and of organs
    outside the chest cavity. Findings of one kind may share a sentence, and one of the two sections may be missing.
    Where the same findings lie on other sides, the sentences are the same but for their places and, where fewer or more
    places have names of their own there, for what is drawn after these.
    """
    choose = Pen(np.random.default_rng([seed, 7]))
    pens = (Pen(np.random.default_rng([seed, 7, part])) for part in range(1000))
    groups = _groups(findings, together=choose.chance(0.6))
    stated = [next(pens).state(group) for group in groups]
    rest = _denials(choose, next(pens), {finding.kind for finding in findings})
    rest += [unrelated(next(pens), inside=False) for _ in range(int(choose.rng.integers(0, 8)))]
    if choose.chance(0.4):
        rest.append(choose.pick(elsewhere.CONTRAST[contrast]))
    order = [int(place) for place in choose.rng.permutation(len(rest))]
    rest = [rest[place] for place in order]
    cut = int(choose.rng.integers(0, len(rest) + 1))
    body = " ".join(rest[:cut] + stated + rest[cut:]) or choose.pick(phrases.CLEAR_LUNGS)
    short = [next(pens).state(group, short=True) for group in groups] or [choose.pick(phrases.NORMAL_CHEST)]
    if choose.chance(0.3):
        short = [f"{number}. {text}" for number, text in enumerate(short, 1)]
    layout = choose.pick(["both"] * 7 + ["findings", "impression", "plain"])
    if layout == "plain":
        return f"{body} {' '.join(short)}"
    return join_report(None if layout == "impression" else body, None if layout == "findings" else " ".join(short))


def _groups(findings: Sequence[Finding], together: bool) -> list[list[Finding]]:
    if not together:
        return [[finding] for finding in findings]
    kinds = dict.fromkeys(finding.kind for finding in findings)
    return [[finding for finding in findings if finding.kind == kind] for kind in kinds]


def _denials(choose: Pen, pen: Pen, present: set[str]) -> list[str]:
    """Sentences that deny absent kinds, one or a few at a time, or call what holds them normal."""
    absent = [kind for kind in phrases.DENIED_NAMES if kind not in present and choose.chance(0.7)]
    sentences = []
    for group, normal in ((PLEURAL, phrases.CLEAR_PLEURA), (CARDIAC, phrases.NORMAL_HEART)):
        if not group & present and choose.chance(0.4):
            sentences.append(choose.pick(normal))
            if choose.chance(0.5):
                absent = [kind for kind in absent if kind not in group]
    if present <= PLEURAL | CARDIAC and choose.chance(0.3):
        sentences.append(choose.pick(phrases.CLEAR_LUNGS))
    order = [absent[int(place)] for place in choose.rng.permutation(len(absent))]
    while order:
        size = 1 + int(3 * choose.rng.random() ** 2)
        sentences.append(pen.deny(order[:size], sorted(present)))
        order = order[size:]
    return sentences
