"""Findings of a procedural thorax: what can be wrong, where and how large, and the report that says so.

    Finding.size by kind
    nodule, mass                 diameter in mm (a mass is larger than 30 mm)
    effusion, pneumothorax       fraction of the lung cavity of that side that is filled
    consolidation                fraction of the lobe that is opacified
    emphysema                    severity in (0, 1], both lungs, strongest in the upper lobes
    cardiomegaly                 cardiothoracic ratio, at least 0.55
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from phydict.datasets.reports import join_report

KINDS = ("nodule", "mass", "effusion", "consolidation", "emphysema", "cardiomegaly", "pneumothorax")
PLEURAL = ("effusion", "pneumothorax")
FOCAL = ("nodule", "mass", "consolidation")
LOBES = {"right": ("upper", "middle", "lower"), "left": ("upper", "lower")}
FREQUENCY = {"nodule": 0.15, "mass": 0.14, "effusion": 0.25, "consolidation": 0.23, "emphysema": 0.09,
             "cardiomegaly": 0.18, "pneumothorax": 0.06}
"""How often `draw_findings` proposes a kind for an abnormal case; refused proposals shift these slightly."""

GRADES = {
    "effusion": {"small": (0.07, 0.12), "moderate": (0.18, 0.30), "large": (0.40, 0.65)},
    "pneumothorax": {"small": (0.08, 0.14), "moderate": (0.20, 0.32), "large": (0.40, 0.60)},
    "consolidation": {"focal": (0.20, 0.38), "extensive": (0.50, 0.75), "complete": (0.99, 1.0)},
    "emphysema": {"mild": (0.30, 0.45), "moderate": (0.55, 0.70), "severe": (0.85, 1.0)},
    "cardiomegaly": {"mild": (0.55, 0.57), "moderate": (0.59, 0.62), "marked": (0.64, 0.68)},
}
"""The word a report uses for a size, and the sizes drawn for it; the intervals are apart, so a word is never a toss."""


@dataclass(frozen=True)
class Finding:
    """One abnormality.

    kind: one of `KINDS`. side: "right" or "left"; "both" for emphysema, "" for cardiomegaly.
    lobe: "upper", "middle" (right only) or "lower" for nodule, mass and consolidation; "" else.
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
        sides = {"emphysema": ("both",), "cardiomegaly": ("",)}.get(self.kind, ("right", "left"))
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
    found: list[Finding] = []
    for _ in range(20):
        if len(found) == wanted:
            break
        proposal = _draw_finding(rng)
        if not any(_clash(proposal, other) for other in found):
            found.append(proposal)
    return tuple(found)


def _draw_finding(rng: np.random.Generator) -> Finding:
    kind = str(rng.choice(list(FREQUENCY), p=np.array(list(FREQUENCY.values())) / sum(FREQUENCY.values())))
    side = {"emphysema": "both", "cardiomegaly": ""}.get(kind, str(rng.choice(["right", "left"])))
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


def _sentences(finding: Finding) -> tuple[list[str], list[str]]:
    """The phrasings of one finding in the Findings and in the Impression section."""
    side, lobe, mm, grade = finding.side, f"{finding.side} {finding.lobe} lobe", f"{finding.size:.0f} mm", finding.grade
    if finding.kind == "nodule":
        return ([f"A {mm} nodule in the {lobe}.", f"There is a {mm} solid nodule in the {lobe}.",
                 f"A nodule measuring {mm} is observed in the {lobe} of the lung."],
                [f"{mm} nodule in the {lobe}.", f"Nodule in the {lobe}, {mm}."])
    if finding.kind == "mass":
        return ([f"A {mm} mass in the {lobe}.", f"There is a soft tissue mass measuring {mm} in the {lobe}.",
                 f"A mass lesion with a diameter of {mm} is observed in the {lobe}."],
                [f"{mm} mass in the {lobe}.", f"Mass in the {lobe}, {mm}."])
    if finding.kind == "effusion":
        return ([f"There is a {grade} {side} pleural effusion.", f"A {grade} pleural effusion on the {side}.",
                 f"{grade.capitalize()} pleural effusion is observed on the {side} side."],
                [f"{grade.capitalize()} {side} pleural effusion."])
    if finding.kind == "pneumothorax":
        return ([f"There is a {grade} {side} pneumothorax.", f"A {grade} pneumothorax on the {side}.",
                 f"Free air in the {side} pleural space, consistent with a {grade} pneumothorax."],
                [f"{grade.capitalize()} {side} pneumothorax."])
    if finding.kind == "consolidation":
        return ([f"{grade.capitalize()} consolidation in the {lobe}.", f"There is {grade} consolidation in the {lobe}.",
                 f"{grade.capitalize()} consolidation with air bronchograms is observed in the {lobe}."],
                [f"{grade.capitalize()} consolidation in the {lobe}.", f"{grade.capitalize()} {lobe} consolidation."])
    if finding.kind == "emphysema":
        return ([f"{grade.capitalize()} emphysema in both lungs, most marked in the upper lobes.",
                 f"There is {grade} upper lobe predominant emphysema in both lungs."],
                [f"{grade.capitalize()} bilateral emphysema."])
    return ([f"The heart is enlarged, cardiothoracic ratio {finding.size:.2f}.",
             f"{grade.capitalize()} cardiomegaly with a cardiothoracic ratio of {finding.size:.2f}.",
             f"Heart size is increased, cardiothoracic ratio {finding.size:.2f}."],
            [f"{grade.capitalize()} cardiomegaly."])


ABSENT = {
    ("effusion",): ["No pleural effusion.", "No pleural effusion was observed."],
    ("pneumothorax",): ["No pneumothorax.", "There is no pneumothorax."],
    ("consolidation",): ["No consolidation.", "There is no consolidation in either lung."],
    ("nodule", "mass"): ["No nodule or mass in either lung.", "There is no pulmonary nodule or mass."],
    ("emphysema",): ["No emphysema."],
    ("cardiomegaly",): ["Heart size is normal.", "The heart is of normal size."],
}
AIRWAY = ["Trachea and both main bronchi are open.", "Trachea and main bronchi are patent.", ""]
NORMAL = ["No acute abnormality in the thorax.", "Chest CT within normal limits.", "Normal chest CT."]


def write_report(findings: tuple[Finding, ...], contrast: bool, seed: int) -> str:
    """"Findings: ... Impression: ..." stating every finding with side, lobe and size, and most absent kinds as absent.

    The phrasing depends on `seed` alone, so that swapping sides changes nothing but the sides.
    """
    rng = np.random.default_rng([seed, 7])

    def pick(options: list[str]) -> str:
        return options[int(rng.random() * len(options))]

    lines = [pick(AIRWAY)]
    if rng.random() < 0.5:
        lines.append("Contrast-enhanced examination." if contrast else "Examination without contrast.")
    impression = []
    for finding in findings:
        long, short = _sentences(finding)
        lines.append(pick(long))
        impression.append(pick(short))
    present = {finding.kind for finding in findings}
    for kinds, options in ABSENT.items():
        stated = rng.random() < 0.75
        if stated and not present.intersection(kinds):
            lines.append(pick(options))
    text = " ".join(line for line in lines if line) or "The lungs are clear."
    return join_report(text, " ".join(impression) or pick(NORMAL))
