"""The tables of an ablation: methods under each condition, against the views, by geometry, and Extra Compute."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from phydict.ablation.run import TABLES
from phydict.ablation.summary import (
    SHOWN_MEASURES,
    Entry,
    best_settings,
    compared_geometries,
    compared_views,
    conditions,
    deltas,
    format_settings,
)
from phydict.evaluation.tables import Table, caption, doubts, listed
from phydict.runtime.files import atomic_write

OF_METHODS = ("ssim", "psnr", "mae_hu", "ssim_body", "psnr_body", "mae_hu_body", "misfit", "seconds", "network_calls")
"""Columns of the table of methods."""

OF_VIEWS = ("ssim", "psnr", "ssim_body", "psnr_body", "seconds")
"""Measures that are tabled against the number of views and by geometry."""

OF_DELTA = ("ssim", "misfit", "psnr", "mae_hu", "ssim_body", "psnr_body", "mae_hu_body", "seconds")
"""Columns of the table of Extra Compute, the misfit beside SSIM: what looks better may fit the X-rays worse."""


def all_tables(found: Sequence[Entry], rows: Sequence[dict]) -> list[Table]:
    """Every table that the entries of some rows allow."""
    notes, tables = [_caption(rows), *doubts(rows)], []
    for condition, group in conditions(found):
        title = format_settings("Methods", condition or {name: rows[0][name] for name in ("views", "simulator")})
        best = best_settings(group)
        if len(best) < len(group):
            tables.append(_method_table(f"{title}: each at its setting of highest mean PSNR", best,
                                        [*notes, "The settings were chosen by these cases' own PSNR."]))
            title += ": all settings"
        tables.append(_method_table(title, group, notes))
    for rest, places in compared_views(found):
        columns = {f"K = {k}": places[k] for k in sorted(places)}
        tables += _axis_tables("against the number of views", rest, columns, notes)
    for rest, places in compared_geometries(found):
        tables += _axis_tables("by geometry", rest, places, notes)
    return tables + [_delta_table(label, group, notes) for label, group in deltas(found)]


def write_tables(folder: Path, tables: Sequence[Table]) -> list[Path]:
    """tables.md and tables.tex in a folder."""
    markdown, latex = (folder / name for name in TABLES)
    files = {markdown: "\n".join(table.markdown() for table in tables),
             latex: "% needs \\usepackage{booktabs}\n" + "\n".join(table.latex() for table in tables)}
    for path, text in files.items():
        with atomic_write(path) as part:
            part.write_text(text)
    return list(files)


def _method_table(title: str, found: Sequence[Entry], notes: Sequence[str]) -> Table:
    """Method x measures, under one condition."""
    return _entry_table(title, "method", OF_METHODS, [(entry.label, entry) for entry in found], notes)


def _delta_table(label: str, found: Sequence[Entry], notes: Sequence[str]) -> Table:
    """Extra Compute's delta x measures: the form of the paper's Table 2, with the misfit beside SSIM."""
    return _entry_table(f"Extra Compute's delta: {label}", "delta", OF_DELTA,
                        [(f"{entry.settings['delta']:g}{entry.lacking}", entry) for entry in found], notes)


def _entry_table(title: str, first: str, names: Sequence[str], lines: Sequence[tuple[str, Entry]],
                 notes: Sequence[str]) -> Table:
    names = _measured(names, [entry for _, entry in lines])
    measures = [SHOWN_MEASURES[name] for name in names]
    return Table(title, [first, *(measure.heading for measure in measures)], measures,
                 [(label, entry.complete, [entry.means.get(name) for name in names]) for label, entry in lines],
                 [*notes, *_reasons([entry for _, entry in lines])])


def _axis_tables(title: str, rest: dict, columns: Mapping[str, Sequence[Entry]], notes: Sequence[str]) -> list[Table]:
    """Method x what is compared, a table for each measure: the form of the paper's Table 3."""
    tables, group = [], [entry for entries in columns.values() for entry in entries]
    lines: dict[str, dict[str, Entry]] = {}
    for column, entries in columns.items():
        for entry in entries:
            lines.setdefault(entry.name, {})[column] = entry
    for name in _measured(OF_VIEWS, group):
        measure = SHOWN_MEASURES[name]
        tables.append(Table(
            format_settings(f"{measure.heading} {title}", rest),
            ["method", *columns], [measure] * len(columns),
            [(label, all(entry.complete or not entry.cases for entry in line.values()),
              [line[k].means.get(name) if k in line else None for k in columns]) for label, line in lines.items()],
            [*notes, *_reasons(group)]))
    return tables


def _measured(names: Sequence[str], found: Sequence[Entry]) -> list[str]:
    """The measures without those in the body where no entry has them, as in results of 0.2.0 and before."""
    return [name for name in names if not name.endswith("_body") or any(name in entry.means for entry in found)]


def _caption(rows: Sequence[dict]) -> str:
    """What the numbers of the tables were taken from."""
    count = len({row["case"] for row in rows})
    over = f"Mean over {count} {'case' if count == 1 else 'cases'}"
    how = " on ".join(filter(None, (listed(rows, name) for name in ("precision", "instruction_set"))))
    return caption(over, rows, {"Grid": "grid", "Seeds": "seed"}) + (
        f" Seconds: one reconstruction after a warm-up, {listed(rows, 'device') or 'none'}, threads "
        f"{listed(rows, 'threads') or 'none'}{how and f', {how}'}; loading and scoring excluded.")


def _reasons(found: Sequence[Entry]) -> list[str]:
    """Why entries lack cases, each reason once."""
    return list(dict.fromkeys(f"{entry.method}: {entry.error}" for entry in found if entry.error))
