"""One sentence of a chest report at a time: findings stated, kinds denied, and all that is of neither."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from phydict.datasets.prose import elsewhere, phrases

if TYPE_CHECKING:
    from phydict.datasets.phantoms.findings import Finding

Option = TypeVar("Option")
ABBREVIATIONS = {("right", "upper"): "RUL", ("right", "middle"): "RML", ("right", "lower"): "RLL",
                 ("left", "upper"): "LUL", ("left", "lower"): "LLL"}
PLURAL = re.compile(r"\b\w+(?<!s)(?<!i)(?<!u)s\b|\bbullae\b")
COMBINED = {("effusion", "pericardial effusion"): ["pleural or pericardial effusion", "pericardial or pleural effusion",
                                                   "pleural-pericardial effusion"],
            ("nodule", "opacity", "consolidation"): ["nodular or infiltrative lesion", "nodule or infiltration",
                                                     "infiltrate, nodule or consolidation"],
            ("nodule", "mass"): ["nodule or mass", "nodular or mass lesion", "mass or nodule", "nodule-mass"],
            ("mass", "nodule", "opacity"): ["mass, nodule or infiltrate", "mass nodule infiltration"],
            ("effusion",): ["pleural effusion or thickening", "pleural thickening or effusion",
                            "pleural effusion/thickening", "pleural effusion-thickening"],
            ("pericardial effusion",): ["pericardial effusion or thickening", "pericardial thickening/effusion",
                                        "pericardial effusion-thickening"]}
"""Names under which several kinds, or one kind and something else, are denied at once."""

RELATED = {"consolidation": "opacity", "opacity": "consolidation", "nodule": "mass", "mass": "nodule"}
"""Kinds that share loose names: where one is present, the other is denied by its own name alone."""


class Pen:
    """Writes sentences; the same random generator writes the same ones.

    exact: of findings their places and sizes are stated as they are, and perhaps a change since before; else segments
    and sizes that nothing shows are added, and places left out, as in the reports of others, for teaching a reader.
    """

    def __init__(self, rng: np.random.Generator, exact: bool = True):
        self.rng, self.exact = rng, exact

    def pick(self, options: Sequence[Option]) -> Option:
        return options[int(self.rng.random() * len(options))]

    def chance(self, share: float) -> bool:
        return bool(self.rng.random() < share)

    def state(self, findings: Sequence[Finding], short: bool = False) -> str:
        """A sentence that states findings of one kind; short: as in an impression."""
        kind = findings[0].kind
        if kind == "cardiomegaly" and self.chance(0.7):
            ratio = phrases.RATIO.format(ratio=findings[0].size)
            return self._finish(self.pick(phrases.HEART_STATEMENTS).format(
                g=self._grade(findings), ratio=ratio if self.chance(0.5) else ""))
        place, adjective = self._place(findings), ""
        if self.chance(0.3):
            place, adjective = self._front(findings, place)
        name = self._name(findings, adjective)
        template = self.pick(phrases.SHORT if short else phrases.STATEMENTS)
        if "{place}" in template.split("{name}")[0] and not place:
            template = "{name}."
        plural = bool(PLURAL.search(re.split(" with | of | in |ground", name)[0] + name.partition("ground")[2]))
        verbs = {"is": "are", "was": "were"} if plural else {"is": "is", "was": "was"}
        text = template.format(name=name, place=place, is1="is", **verbs)
        tail = self.pick(phrases.TAILS)
        return self._finish(text if self.exact and "previous" in tail else text[:-1] + tail + ".")

    def join(self, first: str, second: str) -> str:
        """One sentence of two that state findings."""
        link = self.pick(phrases.LINKS)
        return self._finish(first[:-1] + link + second[0].lower() + second[1:])

    def deny(self, kinds: Sequence[str], present: Sequence[str] = ()) -> str:
        """A sentence that denies kinds, and perhaps things that are of none; `present` kinds are those there are."""
        return self._finish(self._denial(self._denied(kinds, present)))

    def without(self, stated: str, kinds: Sequence[str], present: Sequence[str] = ()) -> str:
        """A sentence that states findings, with kinds denied in it."""
        names = self._denied(kinds, present)
        if self.chance(0.4):
            denial = self._denial(names)
            return self._finish(denial[:-1] + self.pick(phrases.YET) + stated[0].lower() + stated[1:])
        link = self.pick(phrases.WITHOUT)
        return self._finish(stated[:-1] + link + " or ".join(names) + ".")

    def resolve(self, kind: str) -> str:
        """A sentence by which a finding of a kind was there and is no more."""
        return self._finish(self.pick(phrases.RESOLVED).format(name=self.pick(phrases.DENIED_NAMES[kind])))

    def fill(self, template: str) -> str:
        """A sentence of `elsewhere` with its slots filled."""
        return self._finish(template.format(s=self.pick(["right", "left"]), n=int(self.rng.integers(3, 45)),
                                            lobe=self.pick(["upper", "lower"])))

    def _denied(self, kinds: Sequence[str], present: Sequence[str]) -> list[str]:
        names: list[str] = []
        left = list(kinds)
        for group, options in COMBINED.items():
            if set(group) <= set(left) and self.chance(0.35):
                names.append(self.pick(options))
                left = [kind for kind in left if kind not in group]
        for kind in left:
            options = phrases.DENIED_NAMES[kind]
            name = self.pick(options[:1] if RELATED.get(kind) in present else options)
            names.append(name + "s" if name.endswith(("nodule", "lesion", "infiltrate")) and self.chance(0.3) else name)
        if self.chance(0.2):
            names.insert(int(self.rng.random() * (len(names) + 1)), self.pick(phrases.DENIED_ELSEWHERE))
        return names

    def _denial(self, names: list[str]) -> str:
        template = self.pick(phrases.DENIALS)
        if template.startswith("Neither") and len(names) == 1:
            template = "No {list} is seen."
        nor = " nor " if template.startswith("Neither") else self.pick([" or ", " or ", " or ", ", ", "/"])
        *most, last = names
        return template.format(list=nor.join((", " if "Neither" not in template else nor).join(group) for group in
                                             ([most, [last]] if most else [[last]])))

    def _grade(self, findings: Sequence[Finding]) -> str:
        grades = {finding.grade for finding in findings}
        word = self.pick(phrases.GRADE_WORDS.get(grades.pop(), [""])) if len(grades) == 1 else ""
        return f"{word} " if word and self.chance(0.85) else ""

    def _name(self, findings: Sequence[Finding], adjective: str) -> str:
        kind, several = findings[0].kind, len({(f.side, f.lobe) for f in findings}) > 1
        several = several or (not self.exact and self.chance(0.35))
        name = self.pick((phrases.SEVERAL if several else phrases.SINGLE)[kind])
        grade, after = self._grade(findings), ""
        if kind in ("nodule", "mass") and (self.exact or self.chance(0.6)):
            mm = max(finding.size for finding in findings)
            size = self.pick(phrases.SIZES).format(mm=mm, cm=mm / 10, across=0.92 * mm)
            if several:
                after = self.pick(phrases.LARGEST).format(size=size)
            elif self.chance(0.5):
                grade = f"{size} "
            else:
                after = self.pick(phrases.MEASURES).format(size=size)
        elif not self.exact and self.chance(0.12):
            after = self.pick(phrases.DEPTHS).format(mm=int(self.rng.integers(3, 40)))
        return name.format(g=grade + adjective) + after

    def _front(self, findings: Sequence[Finding], place: str) -> tuple[str, str]:
        """A place as an adjective, where there is one: ("", "right lower lobe ")."""
        sides, lobes = {f.side for f in findings}, {f.lobe for f in findings}
        if len(lobes) == 1 and sides == {"right", "left"}:
            return (place, "") if lobes != {""} else ("", "bilateral ")
        if len(lobes) > 1 or len(sides) > 1 or not sides <= {"right", "left"}:
            return place, ""
        side, lobe = findings[0].side, findings[0].lobe
        if not lobe:
            return "", self.pick(phrases.SIDED).format(side=side)
        return "", self.pick([f"{side} {lobe} lobe ", f"{side} {lobe} lobe ", f"{ABBREVIATIONS[side, lobe]} "])

    def _place(self, findings: Sequence[Finding]) -> str:
        kind, places = findings[0].kind, list(dict.fromkeys((f.side, f.lobe) for f in findings))
        if kind in ("cardiomegaly", "pericardial effusion"):
            return ""
        if kind == "emphysema":
            return self.pick(phrases.EMPHYSEMA_PLACES)
        sides = list(dict.fromkeys(side for side, _ in places))
        if not places[0][1]:
            return self.pick(phrases.PLEURAE_PLACES) if len(sides) == 2 else self.pick(phrases.PLEURA_PLACES).format(
                side=sides[0])
        if len(places) == 5:
            return "" if not self.exact and self.chance(0.3) else self.pick(phrases.BOTH_PLACES)
        if len(sides) == 1 and len(places) == (3 if sides[0] == "right" else 2):
            return self.pick(phrases.LUNG_PLACES).format(side=sides[0])
        if len(places) == 2 and places[0][1] == places[1][1]:
            return self.pick(phrases.PAIR_PLACES).format(lobe=places[0][1])
        first = self._lobe(*places[0])
        return first + "".join(f" and {self._lobe(*place)}" for place in places[1:])

    def _lobe(self, side: str, lobe: str) -> str:
        segments = not self.exact and self.chance(0.3)
        return self.pick(phrases.SEGMENT_PLACES if segments else phrases.LOBE_PLACES).format(
            side=side, lobe=lobe, abbr=ABBREVIATIONS[side, lobe], segment=self.pick(phrases.SEGMENTS[lobe]))

    @staticmethod
    def _finish(text: str) -> str:
        text = re.sub(r"\s+([.,;:])", r"\1", re.sub(r"\s+", " ", text)).strip()
        text = re.sub(r"\b([Aa]) (?=[aeioAEIO8]|18 |11 |GGO|unenhanced)", r"\1n ", text.replace(",,", ","))
        text = text.replace(",.", ".")
        return text[0].upper() + text[1:]


def unrelated(pen: Pen, inside: bool) -> str:
    """A sentence of technique, of other organs or, `inside`, of the chest, that is of no kind of finding."""
    pools = [elsewhere.TECHNIQUE, elsewhere.NORMAL, elsewhere.NORMAL, elsewhere.OUTSIDE]
    return pen.fill(pen.pick(pen.pick([*pools, elsewhere.INSIDE, elsewhere.INSIDE] if inside else pools)))
