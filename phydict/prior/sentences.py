"""Reports as sentences."""

from __future__ import annotations

import re

ENDS = re.compile(r'(?<=[.!?;])\s+|\s*[\n"“”]+\s*|\b(?:Findings|Impression):\s*', re.IGNORECASE)


def split_sentences(report: str) -> list[str]:
    """The sentences of a report in order, without its two headings and without pieces that hold no word.

    A sentence ends at a full stop, an exclamation or question mark or a semicolon before white space, at a quotation
    mark and at the end of a line.
    """
    return [piece.strip() for piece in ENDS.split(report) if re.search(r"[^\W\d_]{2}", piece)]
