"""Reports in prose: a reader that knows the words, and not the writer, finds what was written, and nothing else."""

import re
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from phydict.datasets import Thorax, format_report, report
from phydict.datasets.phantoms.findings import FOCAL, KINDS, LOBES, MIDLINE, PLEURAL, Finding
from phydict.datasets.phantoms.phantom import change_by_findings
from phydict.datasets.phantoms.places import examples, extents
from phydict.datasets.phantoms.teaching import teaching_sentences
from phydict.datasets.phantoms.thorax import wrong_side
from phydict.datasets.prose import phrases, write_report, written_words
from phydict.datasets.reports import read_texts
from phydict.grid import Grid

ORGANS = re.compile(r"thyroid|kidney|adrenal|liver|breast|\brib|chest wall|spleen|vertebra|gallbladder|bone|"
                    "abdom|lytic")
DENIED = re.compile(r"\b(no|not|without|neither|negative|absence|none)\b")
NAMES = {"pericardial effusion": "pericardial|around the heart",
         "pneumothorax": "pneumothora|air in the pleur|pleural air",
         "effusion": "effusion|hydrothorax|pleural fluid|fluid in the pleura", "emphysema": "emphysem",
         "opacity": "ground.glass|ggo|hazy|crazy", "consolidation": "consolidat", "nodule": "nodul", "mass": "mass",
         "atelectasis": "atelect|collapse",
         "cardiomegaly": "cardiomegaly|heart|cardiac|cardiothoracic (ratio|index)", "opacity ": "opacit|infiltrat"}
ABBREVIATIONS = {"rul": ("right", "upper"), "rml": ("right", "middle"), "rll": ("right", "lower"),
                 "lul": ("left", "upper"), "lll": ("left", "lower")}
ENLARGED = re.compile("cardiomegaly|enlarge|increase|larger|dilated")
SEEDS = range(300)


def sentences(text: str) -> list[str]:
    return [s.lower() for s in re.split(r"(?<=[.;])\s+|(?:Findings|Impression):\s*", text) if s.strip(" 0123456789.")]


def places(sentence: str, kind: str) -> set[tuple[str, str]]:
    if kind in MIDLINE:
        return {(side, "") for side in MIDLINE[kind]}
    found = {place for word, place in ABBREVIATIONS.items() if re.search(rf"\b{word}\b", sentence)}
    for side in LOBES:
        for lobe in LOBES[side]:
            if re.search(rf"{side} (lung )?{lobe} lobe|{lobe} lobe (of the|on the) {side}", sentence):
                found.add((side, lobe))
    both = re.search(r"\bboth\b|bilateral", sentence)
    if kind in PLEURAL:
        return {(side, "") for side in LOBES if both or side in sentence}
    paired = re.search(r"(upper|middle|lower) lobes", sentence)
    if both and paired:
        return {(side, paired.group(1)) for side in LOBES}
    if found:
        return found
    return {(side, lobe) for side in LOBES if both or side in sentence for lobe in LOBES[side]}


def read(text: str) -> set[tuple[str, str, str]]:
    """(kind, side, lobe) of what a report states."""
    found = set()
    for sentence in sentences(text):
        if ORGANS.search(sentence) or DENIED.search(sentence):
            continue
        kind = next((kind.strip() for kind, names in NAMES.items() if re.search(names, sentence)), None)
        if kind and (kind != "cardiomegaly" or ENLARGED.search(sentence)):
            found |= {(kind, side, lobe) for side, lobe in places(sentence, kind)}
    return found


def told(findings) -> set[tuple[str, str, str]]:
    return {(finding.kind, finding.side, finding.lobe) for finding in findings}


def test_a_reader_gets_the_findings_of_a_phantom_back():
    for seed in SEEDS:
        thorax = Thorax.draw(seed)
        assert read(report(thorax)) == told(thorax.findings), (seed, report(thorax))


def test_the_report_of_the_wrong_side_states_the_findings_on_the_other_side():
    for seed in SEEDS:
        mirrored = wrong_side(Thorax.draw(seed))
        assert read(report(mirrored)) == told(mirrored.findings), (seed, report(mirrored))


def test_a_report_of_the_wrong_side_differs_in_places_alone():
    swapped = {"right": "left", "left": "right", "rul": "lul", "lul": "rul", "rll": "lll", "lll": "rll"}
    for seed in SEEDS:
        thorax = Thorax.draw(seed)
        if any(finding.lobe == "middle" for finding in thorax.findings):
            continue
        ours, theirs = (re.findall(r"\w+", report(case).lower()) for case in (thorax, wrong_side(thorax)))
        assert len(ours) == len(theirs)
        assert all(b in (a, swapped.get(a)) for a, b in zip(ours, theirs)), seed


@pytest.mark.parametrize("kind", KINDS)
def test_several_findings_of_a_kind_are_all_read_back(kind):
    sides = MIDLINE.get(kind, ("right", "left"))
    own = [Finding(kind, side, lobe, next(e.size for e in examples() if e.kind == kind))
           for side in sides for lobe in (LOBES[side] if kind in FOCAL else ("",))]
    draw = np.random.default_rng(0)
    for seed in range(60):
        some = [finding for finding in own if draw.random() < 0.6] or own
        text = write_report(some, bool(seed % 2), seed)
        assert read(text) == told(some), text


def test_what_is_present_is_never_denied():
    for seed in SEEDS:
        findings = Thorax.draw(seed).findings
        denials = [s for s in sentences(report(Thorax.draw(seed))) if DENIED.search(s) and not ORGANS.search(s)]
        for name in (name for finding in findings for name in phrases.DENIED_NAMES[finding.kind]):
            assert not any(re.search(rf"\b{name}", denial) for denial in denials), (seed, name)
        for lungs in phrases.CLEAR_LUNGS:
            assert lungs not in report(Thorax.draw(seed)) or not any(f.kind in FOCAL for f in findings)


def test_a_report_replays_from_its_seed_and_is_laid_out():
    texts = [report(Thorax.draw(seed)) for seed in SEEDS]
    assert texts == [report(Thorax.draw(seed)) for seed in SEEDS]
    assert all(format_report(text) == text for text in texts)


def test_reports_of_one_finding_seldom_repeat_a_sentence():
    finding = Finding("effusion", "left", "", 0.25)
    stated = {s for seed in SEEDS for s in sentences(write_report([finding], False, seed))
              if "left" in s and NAMES["effusion"].split("|")[0] in s}
    assert len(stated) > len(SEEDS) / 2


def test_sections_may_be_missing_and_seldom_are():
    texts = [report(Thorax.draw(seed)) for seed in SEEDS]
    both = sum("Findings: " in text and "Impression: " in text for text in texts) / len(texts)
    assert 0.5 < both < 0.85
    assert any(text.startswith("Impression: ") for text in texts) and any("Findings" not in text for text in texts)


def test_every_word_that_is_written_is_known():
    known = set(written_words())
    for text in [report(Thorax.draw(seed)) for seed in SEEDS] + [text for text, _ in teaching_sentences(2000)]:
        words = set(re.findall(r"[a-z]{2,}", text.lower())) - {"mm", "cm"}
        assert words <= known | {"findings", "impression"}, words - known


# Sentences that teach

def test_teaching_replays_and_every_example_is_stated_and_some_sentences_state_nothing():
    first = teaching_sentences(6000, seed=3)
    assert first == teaching_sentences(6000, seed=3) and first != teaching_sentences(6000, seed=4)
    assert {number for _, stated in first for number in stated} == set(range(len(examples())))
    assert 0.3 < sum(not stated for _, stated in first) / len(first) < 0.7


def test_a_plain_denial_teaches_that_nothing_is_there():
    for text, stated in teaching_sentences(3000):
        if re.match(r"(No|Without|Neither|Negative|Absence)\b", text) and not re.search("but|however|although", text):
            assert not stated, text


# Where findings lie

def test_extents_lie_on_the_side_and_in_the_lobe_that_a_finding_names():
    maps = extents(8, 384.0)
    for finding, extent in zip(examples(), maps):
        right, expected = extent[4:].sum() / extent.sum(), {"right": 1.0, "left": 0.0}.get(finding.side, 0.4)
        assert right == pytest.approx(expected, abs=0.02 if finding.side in LOBES else 0.2), finding
    for kind in FOCAL:
        heights = {f.lobe: (maps[n].sum((0, 1)) @ np.arange(8)) / maps[n].sum() for n, f in enumerate(examples())
                   if f.kind == kind and f.side == "right"}
        assert heights["upper"] > heights["lower"] + 1


def test_larger_findings_fill_more_and_each_kind_fills_at_most_all():
    maps = extents(8, 384.0)
    assert maps.min() >= 0
    for kind in KINDS:
        own = [n for n, finding in enumerate(examples()) if finding.kind == kind]
        assert maps[own].max() == pytest.approx(1)
        for small, large in pairwise(own):
            if examples()[small].size < examples()[large].size:
                assert maps[large].sum() > maps[small].sum()


@pytest.mark.parametrize("finding", [
    Finding("effusion", "left", "", 0.24, 7), Finding("consolidation", "right", "lower", 0.6, 8),
    Finding("opacity", "left", "upper", 0.6, 8), Finding("atelectasis", "left", "lower", 0.2, 8),
    Finding("pneumothorax", "right", "", 0.26, 9), Finding("cardiomegaly", "", "", 0.66, 1),
    Finding("pericardial effusion", "", "", 22.5, 1), Finding("emphysema", "both", "", 0.92, 1)], ids=lambda f: f.kind)
def test_an_extent_is_where_a_phantom_changes(finding):
    thorax = replace(Thorax.standard(), findings=(finding,))
    change = np.abs(change_by_findings(thorax, Grid.cube(16, 384.0))).reshape(8, 2, 8, 2, 8, 2).mean((1, 3, 5))
    nearest = min((e for e in examples() if (e.kind, e.side, e.lobe) == (finding.kind, finding.side, finding.lobe)),
                  key=lambda e: abs(e.size - finding.size))
    extent = extents(8, 384.0)[examples().index(nearest)]
    assert np.corrcoef(change.flatten(), extent.flatten())[0, 1] > 0.6


# Texts for a vocabulary

def test_texts_are_lines_or_json_lines(tmp_path):
    (tmp_path / "a.txt").write_text("Clear lungs.\n\nLeft nodule.\n")
    (tmp_path / "b.jsonl").write_text('{"caption": "Clear lungs."}\n{"text": "Left nodule."}\n')
    (tmp_path / "c.jsonl").write_text("\ufeff" + (tmp_path / "b.jsonl").read_text(), encoding="utf-8")
    assert read_texts(tmp_path / "c.jsonl") == read_texts(tmp_path / "b.jsonl")
    assert read_texts(tmp_path / "a.txt") == read_texts(tmp_path / "b.jsonl") == ["Clear lungs.", "Left nodule."]


@pytest.mark.parametrize("content", [b"", b"\n \n", b'{"words": 3}\n', b"{nonsense\n", b"\xff\xfe\n"])
def test_a_file_without_texts_is_refused_in_one_sentence(tmp_path, content):
    (tmp_path / "texts").write_bytes(content)
    with pytest.raises(ValueError, match="texts.*(one text|UTF-8)"):
        read_texts(tmp_path / "texts")
    with pytest.raises((ValueError, OSError), match="none.txt"):
        read_texts(tmp_path / "none.txt")
