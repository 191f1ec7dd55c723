"""The page of a comparison: its tables and plots, and every row that counts in them."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path

from phydict.ablation.fid import distance_tables
from phydict.ablation.results import DETAILS, volume_folder
from phydict.ablation.summary import Entry, summarise, without_repeats
from phydict.ablation.tables import all_tables
from phydict.evaluation import read_csv
from phydict.evaluation.metrics import MEASURES
from phydict.evaluation.tables import Table
from phydict.inference.case_files import remake_page_files
from phydict.inference.conditions import format_settings
from phydict.inference.results import RESULTS
from phydict.page import Contents, PageCase, check_own_page, write_page
from phydict.runtime.progress_log import log_progress
from phydict.runtime.reading import reason
from phydict.runtime.warning import warn


def is_comparison(folder: Path) -> bool:
    """Whether a folder holds a table of ablate's."""
    return any("key" in row for row in read_csv(folder / RESULTS))


def page_anew(folder: Path) -> Path:
    """Writes the page of a folder's table; returns its path. Of rows that differ in no setting the first counts, and
    how many others there are is logged."""
    stored = read_csv(folder / RESULTS)
    rows = without_repeats(stored)
    if repeats := len(stored) - len(rows):
        log_progress(f"{repeats} of the {len(stored)} rows in {folder / RESULTS} are left out, each of the case, "
                     "method, settings and seed of an earlier row but of other weights or data: give methods that are "
                     "to be compared names of their own", event="others", cases=repeats, out=str(folder / RESULTS))
    entries = summarise(rows)
    return comparison_page(folder, entries, all_tables(entries) + distance_tables(folder, entries))


def comparison_page(folder: Path, entries: Sequence[Entry], tables: Sequence[Table],
                    plots: Sequence[Path] | None = None) -> Path:
    """Writes the page of entries, with their rows, tables and plots, None for all in the folder; returns its path.
    Raises ValueError where a page of someone else's is in its place."""
    check_own_page(folder, "out")
    cases = [_case(folder, entry, row) for entry in entries for row in entry.counted]
    points = [{"name": format_settings(entry.label, entry.condition), "series": entry.method,
               "seconds": entry.means["seconds"], "error": entry.means.get("mae_hu")}
              for entry in entries if "seconds" in entry.means]
    plots = [*folder.glob("*.png")] if plots is None else plots
    kept = sorted(path.name for path in folder.iterdir() if path.suffix in (".csv", ".md", ".tex"))
    return write_page(folder, Contents(f"Comparison in {folder.resolve().name}", tables, cases, points,
                                       plots=sorted(path.name for path in plots), links=kept))


def _case(folder: Path, entry: Entry, row: Mapping) -> PageCase:
    """A row as a case, known by its method, settings and seed, with its volume and details where these were kept."""
    scores = {name: row[name] for name in MEASURES if row.get(name) is not None}
    record = {name: value for name, value in row.items() if name not in scores and value is not None}
    group = format_settings(str(row["case"]), entry.condition)
    kept, place, files, details = volume_folder(folder, str(row.get("key"))), "", list[str](), dict()
    if kept.is_dir():
        _complete(kept)
        place, files = kept.relative_to(folder).as_posix(), sorted(os.listdir(kept))
        details = _details(kept / DETAILS) if DETAILS in files else {}
    return PageCase(place, files, record | details | {
        "method": format_settings(entry.name, entry.condition, {"seed": row.get("seed", 0)}),
        "scores": scores, "misfit": row.get("misfit"), "seconds": {"all": row["seconds"]} if "seconds" in row else {},
        "warnings": [row["warning"]] if row.get("warning") else []}, group)


def _complete(folder: Path) -> None:
    """Makes what the page shows of a volume and its folder lacks, with a warning where that cannot be."""
    try:
        remake_page_files(folder)
    except Exception as error:  # whatever a damaged volume leads to
        warn(f"the volume in {folder} is not shown, since it is damaged ({reason(error)})")


def _details(file: Path) -> dict:
    """What is known of a row beyond the table, nothing, with a warning, where its file is damaged."""
    try:
        return dict(json.loads(file.read_text()))
    except (ValueError, TypeError) as error:
        warn(f"{file} is left out of the page, since it is damaged ({reason(error)})")
        return {}
