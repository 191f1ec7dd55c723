"""Sentences for teaching a reader of reports, each with the findings that it states."""

from __future__ import annotations

import numpy as np

from phydict.datasets.phantoms.findings import FOCAL, KINDS, LOBES, MIDLINE, Finding
from phydict.datasets.phantoms.places import examples
from phydict.datasets.prose import Pen, phrases, unrelated


def teaching_sentences(count: int, seed: int = 0) -> list[tuple[str, tuple[int, ...]]]:
    """Sentences, and which of the `examples` each states: none where it denies findings or is of something else.

    Beyond what phantoms' reports say, they speak of several lobes at once, of segments, changes and suppositions, and
    of lesions of the chest that are of no kind. The same count and seed give the same sentences.
    """
    index = {finding: number for number, finding in enumerate(examples())}
    rng = np.random.default_rng([seed, 11])
    written = [_sentence(Pen(rng, exact=False)) for _ in range(count)]
    return [(text, tuple(index[finding] for finding in findings)) for text, findings in written]


def _sentence(pen: Pen) -> tuple[str, tuple[Finding, ...]]:
    task = pen.rng.random()
    findings: tuple[Finding, ...] = ()
    if task < 0.25:
        text = unrelated(pen, inside=True)
    elif task < 0.45:
        kinds = pen.rng.permutation(len(KINDS))[:1 + int(4 * pen.rng.random() ** 2)]
        text = pen.deny([KINDS[kind] for kind in kinds])
    elif task < 0.49:
        text = pen.resolve(pen.pick(KINDS))
    elif task < 0.54:
        text = pen.pick(pen.pick([phrases.NORMAL_HEART, phrases.CLEAR_LUNGS, phrases.CLEAR_PLEURA,
                                  phrases.NORMAL_CHEST]))
    else:
        text, findings = _statement(pen)
    if pen.chance(0.1):
        text = pen.pick(phrases.OPENINGS) + text
    return text, findings


def _statement(pen: Pen) -> tuple[str, tuple[Finding, ...]]:
    first, second, *others = (KINDS[kind] for kind in pen.rng.permutation(len(KINDS))[:5])
    findings = _findings(pen, first)
    text = pen.state(findings, short=pen.chance(0.3))
    if pen.chance(0.2):
        more = _findings(pen, second)
        text, findings = pen.join(text, pen.state(more, short=True)), findings + more
        others = others[1:]
    else:
        others.append(second)
    if pen.chance(0.15):
        text = pen.without(text, others[:1 + int(2 * pen.rng.random())], [finding.kind for finding in findings])
    elif pen.chance(0.2):
        text = text[:-1] + pen.pick(phrases.SUPPOSITIONS) + "."
    return text, findings


def _findings(pen: Pen, kind: str) -> tuple[Finding, ...]:
    """Findings of one kind and size in one place, in the same lobe of both sides, in one lung or everywhere."""
    alike = [finding for finding in examples() if finding.kind == kind]
    sizes = list(dict.fromkeys(finding.size for finding in alike))
    size = sizes[int(pen.rng.random() * len(sizes))]
    alike = [finding for finding in alike if finding.size == size]
    where, chosen = pen.rng.random(), alike[int(pen.rng.random() * len(alike))]
    if kind in MIDLINE or where < 0.5:
        return (chosen,)
    if kind not in FOCAL:
        return tuple(alike) if where < 0.8 else (chosen,)
    if where < 0.65 and chosen.lobe in LOBES["left"]:
        return tuple(finding for finding in alike if finding.lobe == chosen.lobe)
    if where < 0.75:
        return tuple(finding for finding in alike if finding.side == chosen.side)
    return tuple(alike)
