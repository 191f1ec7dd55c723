"""Reports as sentences."""

from __future__ import annotations

import re

ABBREVIATIONS = ("e.g.", "i.e.", "approx.", "resp.", "incl.", "esp.", "cf.", "vs.", "dr.", "prof.", "fig.")
"""What ends in a full stop, and no sentence."""

GO_ON = "".join(rf"(?<!\b{re.escape(word)})" for word in ABBREVIATIONS)
ENDS = re.compile(GO_ON + r'(?<=[.!?;])\s+|\s*[\n"“”]+\s*|\b(?:Findings|Impression):\s*', re.IGNORECASE)


def split_sentences(report: str) -> list[str]:
    """The sentences of a report in order, without its two headings and without pieces that hold no word.

    A sentence ends at a full stop, but not one of ABBREVIATIONS, an exclamation or question mark or a semicolon before
    white space, at a quotation mark and at the end of a line.
    """
    return [piece.strip() for piece in ENDS.split(report) if re.search(r"[^\W\d_]{2}", piece)]
