"""Result tables: a tidy CSV with one row per case and method, and its summary as Markdown or for the console.

A row is a dict {"case": id, "method": name, metric: value, ...}; `metrics.MEASURES` says how metrics are printed. Its
"warning", if any, says why its numbers are to be doubted.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from rich.markup import escape
from rich.table import Table

from phydict.atomic import whole_file
from phydict.evaluation.metrics import MEASURES, RANGE, SIGMA, TAPS, Measure
from phydict.grid import Grid
from phydict.reading import Unreadable, reading
from phydict.units import HUWindow

TEXT_COLUMNS = ("case", "method")
"""Columns that are text even where they look like numbers."""


def write_csv(path: str | Path, rows: Iterable[Mapping]) -> None:
    """Write `rows` as CSV: the columns are the union of their keys, case and method first, then as they first appear.

    A value that is None or left out becomes an empty field; numbers keep all their digits.
    The file is replaced in one step, so that a killed process leaves the old file or the new one, never a part.
    To append: `write_csv(path, read_csv(path) + new_rows)`.
    """
    rows = list(rows)
    seen = dict.fromkeys(key for row in rows for key in row)
    columns = [name for name in TEXT_COLUMNS if name in seen] + [name for name in seen if name not in TEXT_COLUMNS]
    with whole_file(Path(path)) as part, part.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        writer.writerows([_to_text(row.get(name)) for name in columns] for row in rows)


def read_csv(path: str | Path) -> list[dict]:
    """Rows of a CSV by `write_csv`, numbers as int or float; empty fields are left out; no file gives no rows.

    Text that only resembles a number ("007") stays text, and so do the columns case and method.
    Raises ValueError naming the file where it is no table, or a row's number of fields is not the header's, as in a
    file cut off by another program.
    """
    path = Path(path)
    if not path.exists():
        return []
    with reading(f"the table {path}", "repair or remove it"), open(path, newline="", encoding="utf-8") as file:
        reader = csv.reader(file)
        columns = next(reader, [])
        rows = []
        for fields in reader:
            if len(fields) != len(columns):
                raise Unreadable(f"line {reader.line_num} of {path} has {len(fields)} fields, but its header has "
                                 f"{len(columns)}; the file was cut off or edited, remove or repair that line")
            rows.append({name: field if name in TEXT_COLUMNS else _from_text(field)
                         for name, field in zip(columns, fields) if field != ""})
    return rows


def _to_text(value) -> str:
    if value is None:
        return ""
    value = value.item() if hasattr(value, "item") else value
    return repr(value) if isinstance(value, float) else str(value)


def _from_text(field: str) -> int | float | str:
    for kind in (int, float):
        try:
            value = kind(field)
        except ValueError:
            continue
        if repr(value) == field:
            return value
    return field


class Summary(NamedTuple):
    """One metric of one group: mean and sample standard deviation over `cases` cases (std NaN for one case)."""

    mean: float
    std: float
    cases: int


def summarise(rows: Iterable[Mapping], by: str = "method",
              metrics: Sequence[str] | None = None) -> dict[str, dict[str, Summary]]:
    """{group: {metric: Summary}} over cases, groups in order of appearance.

    Rows of one group and case (several seeds) are averaged first, so that each case counts once; rows without
    the key "case" count as a case each. metrics: names, or None for every known metric that some row has.
    Raises ValueError when there is no row, a row lacks `by`, or no row has one of `metrics`.
    """
    rows = list(rows)
    if not rows:
        raise ValueError("there are no rows to summarise; evaluate at least one case first")
    if lacking := next((row for row in rows if by not in row), None):
        raise ValueError(f"every row needs the column {by!r} to be grouped by, but one has only {sorted(lacking)}")
    present = {name for row in rows for name, value in row.items() if value is not None}
    if metrics is None:
        metrics = [name for name in MEASURES if name in present]
    if absent := [name for name in metrics if name not in present]:
        raise ValueError(f"no row has the metrics {absent}; the rows have {sorted(present)}")
    result = {}
    for group in dict.fromkeys(row[by] for row in rows):
        mine = [(row.get("case", f"row {n}"), row) for n, row in enumerate(rows) if row[by] == group]
        result[str(group)] = {}
        for name in metrics:
            cases = {}
            for case, row in mine:
                if row.get(name) is not None:
                    cases.setdefault(case, []).append(float(row[name]))
            if cases:
                with np.errstate(invalid="ignore"):
                    values = np.array([np.mean(repeats) for repeats in cases.values()])
                    std = float(values.std(ddof=1)) if len(values) > 1 else math.nan
                    result[str(group)][name] = Summary(float(values.mean()), std, len(values))
    return result


def markdown(rows: Iterable[Mapping], by: str = "method", metrics: Sequence[str] | None = None,
             window: HUWindow = RANGE, grid: Grid | None = None, views: int | None = None) -> str:
    """Markdown table of mean ± standard deviation over cases, a line per group, the best of each metric in bold; where
    rows have warnings, a last column counts their cases.

    by, metrics: as in `summarise`. window: the HU range of `volume_metrics`. grid, views: what was scored, for the
    caption line; None takes a `grid` or `views` column of the rows, and says "not stated" where there is none.
    """
    rows = list(rows)
    header, lines = _cells(rows, by, metrics)
    text = [[f"**{cell}**" if best else cell.replace("|", "\\|") for cell, best in line] for line in lines]
    rule = ["---"] + ["---:"] * (len(header) - 1)
    table = "\n".join("| " + " | ".join(line) + " |" for line in [header, rule, *text])
    return f"{table}\n\n{caption(rows, by, window, grid, views)}\n"


def rich_table(rows: Iterable[Mapping], by: str = "method", metrics: Sequence[str] | None = None,
               window: HUWindow = RANGE, grid: Grid | None = None, views: int | None = None) -> Table:
    """The table of `markdown` as a rich Table for the console; same arguments."""
    rows = list(rows)
    header, lines = _cells(rows, by, metrics)
    table = Table(caption=escape(caption(rows, by, window, grid, views)))
    for name in header:
        table.add_column(name, justify="left" if name == by else "right")
    for line in lines:
        table.add_row(*[f"[bold]{cell}[/bold]" if best else cell.replace("[", "\\[") for cell, best in line])
    return table


def caption(rows: Sequence[Mapping], by: str = "method", window: HUWindow = RANGE,
            grid: Grid | None = None, views: int | None = None) -> str:
    """One line that says what the numbers of a table were taken from: cases, HU range, SSIM window, grid, views, and
    which cases have warnings."""
    counts = {}
    for n, row in enumerate(rows):
        counts.setdefault(row[by], set()).add(row.get("case", f"row {n}"))
    cases = sorted({len(ids) for ids in counts.values()})
    over = f"n = {cases[0]} cases" if len(cases) == 1 else f"n = {cases[0]} to {cases[-1]} cases"
    unequal = " (not the same cases in every line)" if len({frozenset(ids) for ids in counts.values()}) > 1 else ""
    warned = dict.fromkeys(str(row.get("case", "a row")) for row in rows if row.get("warning"))
    doubtful = f" Doubtful, by what the rows' warning says: {', '.join(warned)}." if warned else ""
    voxels = None if grid is None else f"{_product(grid.shape)} voxels of {_product(grid.spacing)} mm"
    return (f"Mean ± standard deviation over {over}{unequal}; best in bold. "
            f"HU clipped to [{window.low:g}, {window.high:g}], data range {2 * window.half_width:g} HU; "
            f"SSIM 3-D on HU from the range's low end, Gaussian of {TAPS} taps, sigma {SIGMA:g} voxels. "
            f"Grid: {voxels or _listed(rows, 'grid')}. Views: {views or _listed(rows, 'views')}.{doubtful}")


def _product(numbers: Sequence[float]) -> str:
    return " x ".join(f"{n:g}" for n in numbers)


def _listed(rows: Sequence[Mapping], column: str) -> str:
    found = dict.fromkeys(str(row[column]) for row in rows if row.get(column) is not None)
    return ", ".join(found) or "not stated"


def _cells(rows: Sequence[Mapping], by: str,
           metrics: Sequence[str] | None) -> tuple[list[str], list[list[tuple[str, bool]]]]:
    """Header, and per group its cells as (text, whether it is the best); means equal as printed share the place."""
    summaries = summarise(rows, by, metrics)
    names = list(dict.fromkeys(name for group in summaries.values() for name in group))
    header, lines = [by], [[(group, False)] for group in summaries]
    for name in names:
        measure = MEASURES.get(name, Measure(name, None, 3))
        arrow = {True: " ↑", False: " ↓", None: ""}[measure.higher_is_better]
        header.append(measure.label + arrow)
        printed = [round(group[name].mean, measure.decimals) if name in group else math.nan
                   for group in summaries.values()]
        ranked = [value for value in printed if not math.isnan(value)]
        best = None
        if measure.higher_is_better is not None and len(summaries) > 1 and ranked:
            best = max(ranked) if measure.higher_is_better else min(ranked)
        for line, group, value in zip(lines, summaries.values(), printed):
            line.append((_value(group.get(name), measure.decimals), value == best))
    if any(row.get("warning") for row in rows):
        header.append("warned")
        for line, group in zip(lines, summaries):
            line.append((str(len({row.get("case") for row in rows if str(row[by]) == group and row.get("warning")})),
                         False))
    return header, lines


def _value(summary: Summary | None, decimals: int) -> str:
    if summary is None:
        return "–"
    spread = "" if math.isnan(summary.std) else f" ± {summary.std:.{decimals}f}"
    return f"{summary.mean:.{decimals}f}{spread}"
