"""The document itself: everything that is text goes in as JSON, which the page's script shows as text and no more."""

from __future__ import annotations

import html
import json
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from urllib.parse import quote

from phydict.evaluation.metrics import MEASURES, Measure
from phydict.evaluation.tables import Table, ranks
from phydict.runtime.files import atomic_write, is_signed
from phydict.runtime.strict_json import strict_json
from phydict.runtime.version import VERSION

PAGE = "index.html"
SIGNED = '<meta name="generator" content="phydict">'
"""What the head of a page says wrote it, so that none but a page is ever replaced."""

SHARED = ("settings", "versions")
"""Parts of records that are kept once for all cases of which they are the same."""

FIRST = ("SSIM", "PSNR (dB)", "MAE (HU)", "misfit", "time (s)", "warned")
"""Labels of measures whose columns stand before all others."""


@dataclass(frozen=True)
class PageCase:
    """A finished case. folder: from the page's folder to its own, with forward slashes; files: names in it that are
    linked; record: all that is known of it, plain JSON values, of which case, method, scores, misfit and seconds (per
    stage) are needed; group: those of which the best is marked, left out the cases of one name."""

    folder: str
    files: Sequence[str]
    record: Mapping
    group: str = ""


@dataclass(frozen=True)
class Contents:
    """What a page shows. points: one per dot of seconds against error, {name, series, seconds, error}; error: the name
    of that measure; plots: files of pictures from the page's folder; unranked: measures whose best is not marked in the
    list of cases."""

    title: str
    tables: Sequence[Table] = ()
    cases: Sequence[PageCase] = ()
    points: Sequence[Mapping] = ()
    error: str = "mae_hu"
    plots: Sequence[str] = ()
    links: Sequence[str] = ()
    unranked: Sequence[str] = ()


def check_own_page(folder: Path, option: str) -> None:
    """Raises ValueError where a page of someone else's would be replaced; `option` is what the user may change."""
    path = folder / PAGE
    if os.path.lexists(path) and (path.is_symlink() or not is_signed(path, SIGNED)):
        raise ValueError(f"{path} is no page of results by phydict, and is not replaced: move it away, or give "
                         f"another {option}")


def write_page(folder: Path, contents: Contents) -> Path:
    """Writes index.html into a folder in one step; returns its path."""
    text, style, *scripts = ((files("phydict.page") / name).read_text("utf-8") for name in (
        "page.html", "page.css", "volume.js", "viewer.js", "xrays.js", "page.js"))
    data = strict_json(_content(contents)).replace("<", "\\u003c")
    for mark, value in (("TITLE", html.escape(contents.title)), ("STYLE", style), ("SIGNED", SIGNED),
                        ("SCRIPT", "".join(scripts)), ("CONTENT", data)):
        text = text.replace(f"<!--{mark}-->", value)
    with atomic_write(folder / PAGE) as part:
        part.write_text(text, "utf-8", "replace")
    return folder / PAGE


def _content(contents: Contents) -> dict:
    shared: dict[str, int] = {}
    cases = [_case(case, shared) for case in contents.cases]
    known = {name: measure.unranked() if name in contents.unranked else measure for name, measure in MEASURES.items()}
    _mark_best([case.group or case.record["case"] for case in contents.cases], cases, known)
    scored = {name for case in cases for name in case["scores"]}
    measures = [{"name": name, "label": measure.label, "heading": measure.heading, "decimals": measure.decimals}
                for name, measure in sorted(known.items(), key=lambda item: _stands_behind(item[1]))
                if name in scored]
    error = MEASURES[contents.error].label
    return {"title": contents.title, "version": VERSION, "tables": [_table(t) for t in contents.tables],
            "cases": cases, "shared": [json.loads(text) for text in shared], "measures": measures,
            "points": contents.points, "error": error, "plots": [_file(name) for name in contents.plots],
            "links": [_file(name) for name in contents.links]}


def _case(case: PageCase, shared: dict[str, int]) -> dict:
    record = dict(case.record)
    for name in SHARED:
        record[name] = shared.setdefault(json.dumps(record.get(name), sort_keys=True), len(shared))
    scores = {name: value for name, value in (record.pop("scores", None) or {}).items() if name in MEASURES}
    scores |= {"misfit": record.get("misfit"), "seconds": sum(record.get("seconds", {}).values())}
    return {"folder": _quoted(case.folder), "files": [_file(name) for name in case.files], "record": record,
            "scores": scores}


def _mark_best(names: Sequence[str], cases: Sequence[dict], measures: Mapping[str, Measure]) -> None:
    """Adds to the scores of each case their places in the group of its name: 1 the best, 2 the second, 0 others."""
    groups: dict[str, list[dict]] = {}
    for group_name, case in zip(names, cases):
        groups.setdefault(group_name, []).append(case)
    for group in groups.values():
        for name in {name for case in group for name in case["scores"]}:
            values = [case["scores"].get(name) for case in group]
            known = [math.nan if value is None else value for value in values]
            for case, place in zip(group, ranks(known, measures[name])):
                case.setdefault("places", {})[name] = place


def _stands_behind(measure: Measure) -> bool:
    """Whether a measure's column stands behind those of the first."""
    return measure.label not in FIRST


def _table(table: Table) -> dict:
    order = [0, *sorted(range(1, len(table.header)), key=lambda c: _stands_behind(table.measures[c - 1]))]
    rows = [[{"text": label, "value": None, "place": 0}] + [
        {"text": text, "value": None if value is None else float(value), "place": place}
        for (text, place), value in zip(cells, values)]
        for (label, _, values), cells in zip(table.lines, table.cells())]
    return {"title": table.title, "header": [table.header[c] for c in order],
            "rows": [[row[c] for c in order] for row in rows], "notes": table.notes}


def _file(name: str) -> dict:
    return {"name": name, "url": _quoted(name)}


def _quoted(path: str) -> str:
    """A path as part of an address, whatever bytes it is made of."""
    return quote(os.fsencode(path))
