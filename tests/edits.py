"""Readers to be fuzzed, and how samples and contents are changed for them."""

from __future__ import annotations

import csv
import io
import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from hypothesis import strategies as st

NUMBERS = [struct.pack(kind, value) for kind, value in (
    ("<h", -1), ("<h", 32767), ("<i", -1), ("<i", 2**31 - 1), ("<q", -1), ("<q", 2**62), ("<f", float("nan")),
    ("<f", float("inf")), ("<f", -1e30), ("<d", float("nan")), ("<d", 1e300), ("<I", 0), ("<Q", 0), (">I", 2**31))]
TEXTS = [text.encode() for text in (
    "null", "true", "[]", "{}", "[[1]]", '""', "-1", "0", "1e400", ".nan", "NaN", "Infinity", "9" * 5000, "1e308",
    "-0.0",
    "&a ", "*a", "<<: ", "!!set ", "!!python/name:os.system ", "? ", "- ", ": ", "\n", "\r", "\t", "\0", "\ufeff",
    "\u2028",
    "\ud7ff", "²", "[" * 3000, "{a: " * 50, "'", '"', "`", "$", "\\", "%", "#", "|", "..", "/", "1970-01-01", "0x1F",
    "1:30")]


@dataclass(frozen=True)
class Target:
    """A reader of files called `name`; samples: contents to start from; pieces: what is put into them; whole: the file
    of a content, where that is a part of it."""

    name: str
    read: Callable[[Path], object]
    samples: Callable[[], list[bytes]]
    pieces: list[bytes]
    whole: Callable[[bytes], bytes] = bytes


def edited(target: Target) -> st.SearchStrategy[bytes]:
    """Samples with some of their bytes changed."""
    edit = st.tuples(st.floats(0, 1), st.sampled_from(["put", "over", "cut", "twice"]),
                     st.one_of(st.sampled_from(target.pieces), st.binary(min_size=1, max_size=9)), st.integers(1, 64))

    def apply(sample: bytes, edits: list) -> bytes:
        for where, how, piece, count in edits:
            at = int(where * len(sample))
            rest = {"put": piece + sample[at:], "over": piece + sample[at + len(piece):], "cut": sample[at + count:],
                    "twice": sample[at:at + count] + sample[at:]}[how]
            sample = sample[:at] + rest
        return sample

    return st.builds(apply, st.sampled_from(target.samples()), st.lists(edit, min_size=1, max_size=6))


def values() -> st.SearchStrategy:
    """Anything that YAML or JSON can hold."""
    leaf = st.one_of(st.none(), st.booleans(), st.integers(-10**25, 10**25), st.floats(), st.text(max_size=9),
                     st.sampled_from([0, 1, 2, 3, 1e-300, 1e9, -1, "1", "a" * 300, 2**63, 10**30]))
    return st.recursive(leaf, lambda inner: st.one_of(
        st.lists(inner, max_size=4), st.dictionaries(st.one_of(st.text(max_size=5), st.integers(), st.none()), inner,
                                                     max_size=3)), max_leaves=8)


def changed(content) -> st.SearchStrategy:
    """A nested content of which some parts are replaced by anything, or left out."""
    if isinstance(content, dict):
        kept = {k: st.one_of(changed(v), st.just(...)) if n % 3 == 0 else changed(v)
                for n, (k, v) in enumerate(content.items())}
        own = st.fixed_dictionaries(kept).map(lambda d: {k: v for k, v in d.items() if v is not ...})
    elif isinstance(content, list) and content and isinstance(content[0], list | dict):
        own = st.tuples(*map(changed, content)).map(list)
    else:
        own = st.just(content)
    return st.one_of(own, own, own, own, own, own, own, values())


def tables(table: bytes) -> st.SearchStrategy[bytes]:
    """A CSV table of one row with some of its fields changed."""
    columns, fields = csv.reader(table.decode().splitlines())
    text = st.one_of(st.text(max_size=9), st.sampled_from([piece.decode("utf-8", "replace") for piece in TEXTS]))

    def written(row: tuple) -> bytes:
        lines = io.StringIO()
        csv.writer(lines).writerows([columns, row])
        return lines.getvalue().encode(errors="replace")

    return st.tuples(*(st.one_of(st.just(field), st.just(field), text) for field in fields)).map(written)
