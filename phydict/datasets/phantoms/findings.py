"""Findings of a procedural thorax: what can be wrong, where and how large.

    Finding.size by kind
    nodule, mass                 diameter in mm (a mass is larger than 30 mm)
    effusion, pneumothorax       fraction of the lung cavity of that side that is filled
    consolidation, opacity       fraction of the lobe that is airless, or of ground glass
    atelectasis                  fraction of the lobe that is collapsed, where it lies lowest
    emphysema                    severity in (0, 1], both lungs, strongest in the upper lobes
    cardiomegaly                 cardiothoracic ratio, at least 0.55
    pericardial effusion         mm of fluid around the heart
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

KINDS = ("nodule", "mass", "effusion", "consolidation", "opacity", "atelectasis", "emphysema", "cardiomegaly",
         "pericardial effusion", "pneumothorax")
PLEURAL = ("effusion", "pneumothorax")
FOCAL = ("nodule", "mass", "consolidation", "opacity", "atelectasis")
LOBES = {"right": ("upper", "middle", "lower"), "left": ("upper", "lower")}
MIDLINE = {"emphysema": ("both",), "cardiomegaly": ("",), "pericardial effusion": ("",)}
"""The sides of the kinds that take neither right nor left."""

FREQUENCY = {"nodule": 0.13, "mass": 0.12, "effusion": 0.21, "consolidation": 0.19, "opacity": 0.09,
             "atelectasis": 0.07, "emphysema": 0.08, "cardiomegaly": 0.14, "pericardial effusion": 0.05,
             "pneumothorax": 0.06}
"""How often `draw_findings` proposes a kind for an abnormal case; refused proposals shift these slightly."""

GRADES = {
    "effusion": {"small": (0.07, 0.12), "moderate": (0.18, 0.30), "large": (0.40, 0.65)},
    "pneumothorax": {"small": (0.08, 0.14), "moderate": (0.20, 0.32), "large": (0.40, 0.60)},
    "consolidation": {"focal": (0.20, 0.38), "extensive": (0.50, 0.75), "complete": (0.99, 1.0)},
    "opacity": {"focal": (0.20, 0.38), "extensive": (0.50, 0.75), "complete": (0.99, 1.0)},
    "atelectasis": {"mild": (0.06, 0.10), "moderate": (0.16, 0.24), "marked": (0.32, 0.42)},
    "emphysema": {"mild": (0.30, 0.45), "moderate": (0.55, 0.70), "severe": (0.85, 1.0)},
    "cardiomegaly": {"mild": (0.55, 0.57), "moderate": (0.59, 0.62), "marked": (0.64, 0.68)},
    "pericardial effusion": {"small": (5.0, 8.0), "moderate": (11.0, 15.0), "large": (19.0, 26.0)},
}
"""The word a report uses for a size, and the sizes drawn for it; the intervals are apart, so a word is never a toss."""


@dataclass(frozen=True)
class Finding:
    """One abnormality.

    kind: one of `KINDS`. side: "right" or "left"; "both" for emphysema, "" for the heart's.
    lobe: "upper", "middle" (right only) or "lower" for the kinds of FOCAL; "" else.
    size: see the table at the head of this file. seed: places it inside its lobe.
    """

    kind: str
    side: str
    lobe: str
    size: float
    seed: int = 0

    def __post_init__(self):
        if self.kind not in KINDS:
            raise ValueError(f"'{self.kind}' is no kind of finding; choose one of {', '.join(KINDS)}")
        sides = MIDLINE.get(self.kind, ("right", "left"))
        lobes = LOBES[self.side] if self.kind in FOCAL and self.side in LOBES else ("",)
        if self.side not in sides or self.lobe not in lobes:
            raise ValueError(f"{self.kind} was given side '{self.side}' and lobe '{self.lobe}'; "
                             f"it takes a side of {sides} and a lobe of {lobes}")

    @property
    def grade(self) -> str:
        """The report's word for the size ("" for nodule and mass, which are given in mm)."""
        bands = GRADES.get(self.kind, {})
        centres = {word: (low + high) / 2 for word, (low, high) in bands.items()}
        return min(centres, key=lambda word: abs(centres[word] - self.size)) if centres else ""

    @property
    def mirrored(self) -> Finding:
        """The same finding on the other side; the right middle lobe becomes the left upper lobe."""
        side = {"right": "left", "left": "right"}.get(self.side, self.side)
        lobe = "upper" if side == "left" and self.lobe == "middle" else self.lobe
        return replace(self, side=side, lobe=lobe)


def draw_findings(rng: np.random.Generator) -> tuple[Finding, ...]:
    """No finding in a quarter of the draws, else one to three that do not hide each other."""
    wanted = int(rng.choice(4, p=[0.25, 0.42, 0.22, 0.11]))
    findings: list[Finding] = []
    for _ in range(20):
        if len(findings) == wanted:
            break
        proposal = _draw_finding(rng)
        if not any(_clash(proposal, other) for other in findings):
            findings.append(proposal)
    return tuple(findings)


def _draw_finding(rng: np.random.Generator) -> Finding:
    kind = str(rng.choice(list(FREQUENCY), p=np.array(list(FREQUENCY.values())) / sum(FREQUENCY.values())))
    side = str(rng.choice(MIDLINE.get(kind, ("right", "left"))))
    lobe = str(rng.choice(LOBES[side])) if kind in FOCAL else ""
    if kind == "nodule":
        size = float(rng.integers(7, 30))
    elif kind == "mass":
        size = float(rng.integers(34, 41 if lobe == "middle" else 66))
    else:
        low, high = GRADES[kind][str(rng.choice(list(GRADES[kind])))]
        size = round(float(rng.uniform(low, high)), 2)
    return Finding(kind, side, lobe, size, int(rng.integers(2**31)))


def _clash(a: Finding, b: Finding) -> bool:
    """Whether one finding would hide or repeat the other."""
    if a.kind == b.kind and a.side == b.side and a.lobe == b.lobe:
        return True
    local = PLEURAL + FOCAL
    if a.kind not in local or b.kind not in local or a.side != b.side:
        return False
    return a.kind in PLEURAL or b.kind in PLEURAL or a.lobe == b.lobe
