"""One layout of reports, whatever they come from, and absent sections are absent however they are written."""

import itertools
import random
import time

import pytest
import torch

import phydict
from phydict.baselines import SIRT
from phydict.datasets import Thorax, format_report, join_report, load_xrays, read_reports, report, save_xrays
from phydict.grid import Grid
from phydict.xray import ConeBeam

NOTHING = [None, float("nan"), "", "  \n\t", "\u00a0", "nan", "NaN", "None", "Not given.", "not given", "-", "N/A",
           "null"]
LAYOUT = "Findings: Nodule, 4 mm. Impression: Benign nodule."


@pytest.mark.parametrize("findings, impression, joined", [
    ("Clear\nlungs.", "Normal.", "Findings: Clear lungs. Impression: Normal."),
    ('A, "b" (c).', None, 'Findings: A, "b" (c).'),
    ("Findings: Nodule, 4 mm.", "IMPRESSION:\nBenign nodule.", LAYOUT)])
def test_sections_are_joined_in_one_layout(findings, impression, joined):
    assert join_report(findings, impression) == joined


@pytest.mark.parametrize("nothing", NOTHING, ids=repr)
def test_an_absent_section_is_left_out_however_it_is_written(nothing):
    assert join_report(nothing, nothing) == "" == format_report(nothing)
    assert join_report("Nodule.", nothing) == join_report("Nodule.", "")
    assert join_report(nothing, "Nodule.") == "Impression: Nodule."
    if isinstance(nothing, str):
        assert format_report(f"Findings: {nothing} Impression: Nodule.") == "Impression: Nodule."
        assert format_report(f"Findings:{nothing}\nImpression:{nothing}") == ""


@pytest.mark.parametrize("text", [
    LAYOUT, "FINDINGS:\nNodule,\n4 mm.\n\nIMPRESSION:\nBenign nodule.\n",
    "findings : Nodule, 4 mm.\r\nimpression: Benign nodule.",
    "Nodule, 4 mm.\nConclusion: Benign nodule.", "IMPRESSIONS: Benign nodule.\nFINDINGS: Nodule, 4 mm.",
    "Clinical information: cough.\nTechnique: CT without contrast.\nFindings: Nodule, 4 mm.\nImpression: Benign "
    "nodule.", "INDICATION\nLeft effusion.\n\nFINDINGS\r\nNodule, 4 mm.\n\n Impressions \nBenign nodule.",
    "Reason for exam: left effusion.\nFindings: Nodule, 4 mm.\nImpression: Benign nodule.",
    "CLINICAL DETAILS:\nLeft effusion?\nFindings\nNodule, 4 mm.\nConclusion\nBenign nodule."
])
def test_every_usual_way_to_write_a_report_is_the_same_report(text):
    assert format_report(text) == LAYOUT


@pytest.mark.parametrize("text", [
    "Small nodule in the left upper lobe.", "The findings: a nodule.", "Impressive nodule.", "Heart size: normal.",
    "None of the findings of 2020.", "结节", "Findings are normal."])
def test_a_text_without_sections_is_kept(text):
    assert format_report(text) == text
    assert format_report(f" \t{text.replace(' ', '   ')}\n\n") == text


@pytest.mark.parametrize("lines, sentences", [
    ("- No effusion\n- Nodule in the right\n  upper lobe\n\n- Clear.",
     "- No effusion. - Nodule in the right upper lobe. - Clear."),
    ("• No effusion\n• heart: normal\n• 4 mm nodule", "• No effusion. • heart: normal. • 4 mm nodule"),
    ("1) No effusion;\n2) Nodule of 4 mm", "1) No effusion; 2) Nodule of 4 mm"),
    ("No effusion\n12 mm nodule (right)\nNormal heart", "No effusion. 12 mm nodule (right). Normal heart")])
def test_lines_of_a_list_are_sentences(lines, sentences):
    assert format_report(lines) == format_report(sentences) == sentences
    assert join_report(lines, None) == f"Findings: {sentences}"
    assert format_report(f"FINDINGS:\n{lines}\nIMPRESSION:\nMass") == f"Findings: {sentences} Impression: Mass"


def test_text_before_the_findings_is_a_sentence_of_its_own():
    assert format_report("CT without contrast\nFINDINGS: Left mass") == "Findings: CT without contrast. Left mass"


def test_a_report_of_many_headings_takes_no_minutes():
    begun = time.process_time()
    assert format_report("Findings: Mass\n" * 4000) == "Findings: " + "Mass. " * 3999 + "Mass"
    assert time.process_time() - begun < 2


@pytest.mark.parametrize("prose", [
    "No nodule in the right\nupper lobe. No\neffusion", "Typical of\nCOVID-19", "Nodule,\n4 mm", "Lungs:\nClear"])
def test_lines_of_prose_are_joined(prose):
    assert format_report(prose) == prose.replace("\n", " ")


def test_a_laid_out_report_is_laid_out_already():
    words = ["Findings:", "Findings", "impression:", "IMPRESSION:", "Technique:", "nodule", "no", "nan", "Not given.",
             "\n", "mass.", "Not", "given.", "-"]
    draw = random.Random(0)
    for _ in range(3000):
        first, second = (" ".join(draw.choices(words, k=draw.randrange(7))) for _ in range(2))
        for laid_out in (join_report(first, second), format_report(first)):
            assert format_report(laid_out) == laid_out, (first, second)


def test_no_word_of_findings_or_impression_is_lost_or_moved():
    words = ["nodule", "mass", "left", "2.5", "×"]
    for first, second in itertools.product(itertools.permutations(words, 2), repeat=2):
        laid_out = format_report(f"Findings:\n{' '.join(first)}\nImpression:\n{' '.join(second)}")
        assert laid_out == join_report(" ".join(first), " ".join(second))
        assert laid_out.split() == ["Findings:", *first, "Impression:", *second]


def test_phantoms_write_their_reports_in_the_layout():
    for seed in range(50):
        text = report(Thorax.draw(seed))
        assert text and format_report(text) == text


def test_table_file_and_call_give_a_prior_the_same_report(tmp_path):
    table = tmp_path / "reports.csv"
    table.write_text('VolumeName,Findings_EN,Impressions_EN\na.nii.gz,"Nodule,\n 4 mm.",Benign nodule.\n')
    beam = ConeBeam.orbit(1, 1020.0, 740.0, (4, 4), (100.0, 100.0))
    xrays = torch.arange(16.0).view(1, 4, 4)
    save_xrays(tmp_path / "xrays", xrays, beam)
    whole = "FINDINGS: Nodule, 4 mm.\nIMPRESSION: Benign nodule.\n"
    (tmp_path / "xrays" / "report.txt").write_text("\ufeff" + whole, encoding="utf-8")
    seen = []

    class Listening(SIRT):
        def reconstruct(self, xrays, projector, report="", *others):
            seen.append(report)
            return super().reconstruct(xrays, projector, report, *others)

    phydict.reconstruct(xrays, beam, method=Listening(iterations=1), report=whole, grid=Grid.cube(4))
    assert read_reports(table)["a"] == load_xrays(tmp_path / "xrays")["report"] == seen[0] == LAYOUT
