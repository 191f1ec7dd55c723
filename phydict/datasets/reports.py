"""Radiology reports in the one layout that priors are trained on: "Findings: ... Impression: ...".

CT-RATE's tables give the two sections apart; a report.txt or a call of `phydict.reconstruct` gives one text. Both end
in the same layout, so that a prior meets at inference what it met in training.
"""

from __future__ import annotations

import json
import re
from itertools import pairwise
from pathlib import Path

from phydict.runtime.reading import reading

ABSENT = {"", "nan", "none", "null", "n/a", "<na>", "not given", "not given.", "-", "."}
"""What stands for a section that nobody wrote, in lower case."""

SECTIONS = {"finding": "Findings", "impression": "Impression", "conclusion": "Impression"}
LEFT_OUT = ("clinical information", "clinical history", "clinical indication", "clinical data", "clinical detail",
            "clinical question", "history", "indication", "reason for exam", "reason for examination",
            "reason for study", "technique", "comparison", "examination")
NAMES = "|".join((*SECTIONS, *LEFT_OUT))
HEADING = re.compile(rf"(?:^[ \t]*|(?<=\s)(?=(?-i:[A-Z])))({NAMES})s?[ \t]*:", re.IGNORECASE | re.MULTILINE)
ALONE = re.compile(rf"^[ \t]*({NAMES})s?[ \t\r]*$", re.IGNORECASE | re.MULTILINE)

MARK = re.compile(r"[-–•*·]\s|\d{1,2}[.)]\s")
"""What the items of a list begin with."""

OPEN_END = re.compile(r"(?:^|\s)(?!(?:an?|the|of|in|on|at|to|by|for|with|and|or|no|is|are)$)\S*[\w%)]$", re.IGNORECASE)
"""The end of a line from which a full stop may have been left out: no mark, and no word that leads on."""


def join_report(findings: str | None, impression: str | None) -> str:
    """"Findings: ... Impression: ..." of two sections, on one line.

    A section that is None, NaN, empty, white space or "Not given." is left out; without both, the report is "".
    Headings inside a section are obeyed, as in `format_report`.
    """
    sections: dict[str, list[str]] = {"Findings": [], "Impression": []}
    for title, text in (("Findings", findings), ("Impression", impression)):
        for heading, part in _parts(text, title):
            if heading in sections and part.lower() not in ABSENT:
                sections[heading].append(part)
    joined = {title: _on_one_line("\n".join(parts)) for title, parts in sections.items()}
    return " ".join(f"{title}: {text}" for title, text in joined.items() if text.lower() not in ABSENT)


def format_report(text: str | None) -> str:
    """A whole report as `join_report` writes it; the layout's own texts stay as they are.

    Headings (findings, impression or conclusion) count alone on a line, and with a colon at the start of one, or
    anywhere with a capital. Text before any heading belongs to the findings. Clinical information, technique and
    comparison are left out, as they are in training. A text without findings or impression is kept as it is, on one
    line. Lines of a list that end in no mark get a full stop.
    """
    if any(heading in SECTIONS.values() for heading, _ in _parts(text, "")):
        return join_report(text, None)
    whole = _on_one_line(_written(text))
    return "" if whole.lower() in ABSENT else whole


def _parts(text: str | None, title: str) -> list[tuple[str, str]]:
    """(section, text on one line) in order; what comes before any heading belongs to `title`."""
    pieces = HEADING.split(ALONE.sub(r"\1:", _written(text)))
    titles = [title, *(SECTIONS.get(name.lower(), "") for name in pieces[1::2])]
    return [(name, _on_one_line(piece)) for name, piece in zip(titles, pieces[0::2])]


def _on_one_line(text: str) -> str:
    """A text whose lines are joined; those of a list end in a full stop, so that "no" in one is not read of the next.

    A list's lines begin with marks, or each of them with a capital or a number.
    """
    lines = [" ".join(line.split()) for line in text.splitlines() if line.strip()]
    listed = all(line[0].isupper() or line[0].isdigit() or MARK.match(line) for line in lines)
    ended = [f"{line}." if OPEN_END.search(line) and (listed or MARK.match(after)) else line
             for line, after in pairwise(lines)]
    return " ".join(ended + lines[-1:])


def _written(text: str | None) -> str:
    return "" if text is None or text != text else text  # NaN differs from itself


def read_texts(path: str | Path) -> list[str]:
    """The texts of a UTF-8 file: one a line, or of each line's JSON object what stands under "text" or "caption".

    Raises ValueError, with what to do, where there is no such file or no text in it.
    """
    with reading(f"the texts in '{path}'", "give a UTF-8 file with one text, or one JSON object, a line"):
        lines = [line for line in Path(path).read_text(encoding="utf-8-sig").splitlines() if line.strip()]
        entries = [json.loads(line) if line.lstrip().startswith("{") else {"text": line} for line in lines]
        texts: list = [text.get("text") or text.get("caption") for text in entries]
    if not texts or not all(isinstance(text, str) for text in texts):
        raise ValueError(f"the file '{path}' holds no texts, or a line without one: give one text, or one JSON object "
                         "with \"text\" or \"caption\", a line")
    return texts
