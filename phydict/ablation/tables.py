"""The tables of an ablation: methods under each condition, against the views, by geometry, and Extra Compute."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType

from phydict.ablation.results import TABLES
from phydict.ablation.summary import (
    SHOWN_MEASURES,
    Entry,
    alike,
    best_settings,
    compared_geometries,
    compared_views,
    conditions,
    deltas,
    fixed_settings,
    ranking,
    xrays,
)
from phydict.ablation.trials import PRECISION
from phydict.evaluation.bootstrap import Estimate, difference
from phydict.evaluation.metrics import MEASURES, RANGE
from phydict.evaluation.tables import (
    Table,
    caption,
    empty_notes,
    has_intervals,
    interval_note,
    listed,
    partial_notes,
    rankable,
    span,
    warning_notes,
)
from phydict.inference.conditions import format_settings, namesakes
from phydict.inference.protocols import Protocol, protocol_of
from phydict.prior.contract import OWN_PRECISION
from phydict.runtime.files import atomic_write

FURTHER = tuple(name for name in MEASURES if name not in ("ssim", "psnr", "mae_hu", "misfit", "seconds"))
"""Measures that have a column only where they were taken."""

OF_METHODS = ("ssim", "psnr", "mae_hu", *FURTHER, "misfit", "seconds", "network_calls")
"""Columns of the table of methods."""

OF_VIEWS = ("ssim", "psnr", *FURTHER, "seconds")
"""Measures that are tabled against the number of views and by geometry."""

OF_DIFFERENCES = ("ssim", "psnr", "mae_hu", *(name for name in FURTHER if name != "dice_lung_ct"), "misfit")
"""Measures whose differences between methods are tabled; one that is of the CT alone has none."""

OFF_TARGET = "Off 1: |value - 1|, whose differences below 0 are for the better."
"""The note on differences of measures whose right value is 1."""

OF_DELTA = ("ssim", "misfit", "psnr", "mae_hu", *FURTHER, "seconds")
"""Columns of the table of Extra Compute, the misfit beside SSIM: what looks better may fit the X-rays worse."""


def all_tables(entries: Sequence[Entry], empty: Mapping[str, str] = MappingProxyType({})) -> list[Table]:
    """Every table that entries allow; empty: scores that may stay empty -> why they then do."""
    tables = []
    for condition, group in conditions(entries):
        title = format_settings("Methods", condition or {name: group[0].rows[0][name]
                                                         for name in ("views", "simulator")})
        best = best_settings(group)
        if len(best) < len(group):
            tables.append(_method_table(f"{title}: each at its setting of highest mean PSNR", best, empty,
                                        ["The settings were chosen by these cases' own PSNR."]))
            title += ": all settings"
        tables.append(_method_table(title, group, empty))
        tables += _difference_tables(title.removesuffix(": all settings"), best if len(best) > 1 else group)
    for rest, group in compared_views(entries):
        columns = {k: f"K = {k}" for k in sorted({entry.condition["views"] for entry in group})}
        tables += _axis_tables("against the number of views", rest, group, columns, "views")
    for rest, group in compared_geometries(entries):
        columns = {file: Path(file).stem for file in dict.fromkeys(entry.condition["geometry"] for entry in group)}
        tables += _axis_tables("by geometry", rest, group, columns, "geometry")
    return tables + [_delta_table(label, group, empty) for label, group in deltas(entries)]


def write_tables(folder: Path, tables: Sequence[Table]) -> list[Path]:
    """tables.md and tables.tex in a folder."""
    markdown, latex = (folder / name for name in TABLES)
    files = {markdown: "\n".join(table.markdown() for table in tables),
             latex: "% needs \\usepackage{booktabs}\n" + "\n".join(table.latex() for table in tables)}
    for path, text in files.items():
        with atomic_write(path) as part:
            part.write_text(text, "utf-8", "replace")
    return list(files)


def _method_table(title: str, entries: Sequence[Entry], empty: Mapping[str, str], notes: Sequence[str] = ()) -> Table:
    """Method x measures, under one condition."""
    return _entry_table(title, "method", OF_METHODS, [(entry.label, entry) for entry in entries], empty, notes)


def _difference_tables(title: str, entries: Sequence[Entry]) -> list[Table]:
    """What each method, or setting of the only one, has more than that of highest mean PSNR on the same cases; none
    without a second one."""
    compared = [entry for entry in entries if entry.cases]
    if len(compared) < 2:
        return []
    best, names = max(compared, key=ranking(compared)), _measured(OF_DIFFERENCES, entries)
    others = [entry for entry in compared if entry is not best]
    lines: list[tuple[str, bool, list]] = [(entry.label, False, [_less(entry, best, name) for name in names])
                                           for entry in others]
    if not has_intervals(lines):
        return []
    measures = [SHOWN_MEASURES[name].off_target() for name in names]
    off = [OFF_TARGET] if measures != [SHOWN_MEASURES[name] for name in names] else []
    common = [entry.case_ids & best.case_ids for entry in others]
    parts = partial_notes((entry.label, len(of), {
        name: len(entry.values.get(name, {}).keys() & best.values.get(name, {})) for name in names})
        for entry, of in zip(others, common))
    return [Table(f"{title}: less {best.name}, case by case", ["method", *(m.heading for m in measures)], measures,
                  lines, [*interval_note(lines, common), *parts, *off, *_origins(entries)])]


def _less(entry: Entry, other: Entry, name: str) -> Estimate | None:
    """By how much an entry's measure is above another's, or further off its target."""
    target = SHOWN_MEASURES[name].target
    one, two = ({case: value if target is None else abs(value - target) for case, value in of.values[name].items()}
                if name in of.values else {} for of in (entry, other))
    return difference(one, two)


def _delta_table(label: str, entries: Sequence[Entry], empty: Mapping[str, str]) -> Table:
    """Extra Compute's delta x measures: the form of the paper's Table 2, with the misfit beside SSIM."""
    return _entry_table(f"Extra Compute's delta: {label}", "delta", OF_DELTA,
                        [(f"{entry.settings['delta']:g}{entry.lacking}", entry) for entry in entries], empty)


def _entry_table(title: str, first: str, names: Sequence[str], lines: Sequence[tuple[str, Entry]],
                 empty: Mapping[str, str], notes: Sequence[str] = ()) -> Table:
    entries = [entry for _, entry in lines]
    names = _measured(names, entries, empty)
    measures = [SHOWN_MEASURES[name] for name in names]
    among = alike(entries)
    printed = [(label, any(entry is other for other in among), [entry.estimate(name) for name in names])
               for label, entry in lines]
    why = empty_notes(empty, {name for entry in entries for name in entry.values}) + partial_notes(
        (label, entry.cases, {name: len(entry.values.get(name, ())) for name in names}) for label, entry in lines)
    ranked = [rankable(measure, (entry.values[name] for entry in among if name in entry.values))
              for name, measure in zip(names, measures)]
    table = Table(title, [first, *(measure.heading for measure in measures)], ranked, printed, [])
    return replace(table, notes=[_caption(entries, table.ranks), *why, *_origins(entries), *notes,
                                 *interval_note(printed, (entry.case_ids for entry in entries)), *_reasons(entries)])


def _axis_tables(title: str, rest: dict, group: Sequence[Entry], columns: Mapping[object, str],
                 axis: str) -> list[Table]:
    """Method x values of an axis, a table for each measure: the form of the paper's Table 3. columns: value ->
    heading."""
    tables: list[Table] = []
    lines: dict[str, dict[object, Entry]] = {}
    for entry in group:
        lines.setdefault(entry.name, {})[entry.condition[axis]] = entry
    among = {id(entry) for k in columns for entry in alike([line[k] for line in lines.values() if k in line])}
    marked = {label for label, line in lines.items()
              if all(id(entry) in among or not entry.cases for entry in line.values())}
    lacking = [f"{label}, {columns[k]}{entry.lacking}" for label, line in lines.items() for k, entry in line.items()
               if entry.lacking]
    for name in _measured(OF_VIEWS, group):
        measure = SHOWN_MEASURES[name]
        printed = [(label, label in marked, [line[k].estimate(name) if k in line else None for k in columns])
                   for label, line in lines.items()]
        ranked = [rankable(measure, (lines[label][k].values[name] for label in marked
                                     if k in lines[label] and name in lines[label][k].values)) for k in columns]
        table = Table(format_settings(f"{measure.heading} {title}", rest), ["method", *columns.values()], ranked,
                      printed, [])
        parts = partial_notes((f"{label}, {columns[k]}", entry.cases, {name: len(entry.values.get(name, ()))})
                              for label, line in lines.items() for k, entry in line.items())
        tables.append(replace(table, notes=[
            _caption(group, table.ranks), *_origins(group),
            *interval_note(printed, (entry.case_ids for entry in group)), *_reasons(group), *parts,
            *([f"Not of all cases: {'; '.join(lacking)}."] if lacking else [])]))
    return tables


def _measured(names: Sequence[str], entries: Sequence[Entry], empty: Iterable[str] = ()) -> list[str]:
    """The measures without those of FURTHER that no entry has, unless they are to be shown `empty`."""
    return [name for name in names if name not in FURTHER or name in empty
            or any(name in entry.values for entry in entries)]


def _caption(entries: Sequence[Entry], marked: bool) -> str:
    """What the numbers of a table of entries were taken from; marked: whether some are marked as the best."""
    rows = [row for entry in entries for row in entry.rows]
    of, seeds = len({row["case"] for row in rows}), len({row.get("seed") for row in rows})
    count = len({case for entry in entries for case in entry.case_ids}) or of
    sets = {entry.case_ids for entry in entries if entry.complete}
    unlike = " (not the same everywhere)" if len(sets) > 1 else ""
    among = span(map(len, sets)) if unlike else f"{count} of {of}" if count < of else str(count)
    over = (f"Mean over {among} cases" if among != "1" else "One case" if seeds == 1 else
            "Mean over the seeds of one case") + unlike
    how = " on ".join(filter(None, (listed(rows, name) for name in ("precision", "instruction_set"))))
    window = next((protocol.window for protocol in _protocols(rows)), RANGE)
    return caption(over, marked, rows, {"Grid": "grid", "Seeds": "seed"}, window) + (
        f" Seconds: one reconstruction after a warm-up, {listed(rows, 'device') or 'none'}, threads "
        f"{listed(rows, 'threads') or 'none'}{how and f', {how}'}; loading and scoring excluded.")


def _origins(entries: Sequence[Entry]) -> list[str]:
    """The protocol and the X-rays that the rows of a table's entries were taken by, the settings that its title and
    labels do not tell, how long trained rivals among them have learnt, the cases that are doubtful, and what was not
    computed or measured alike."""
    rows = [row for entry in entries for row in entry.rows]
    trained = dict.fromkeys(f"{row['method']} {row['training']}" for row in rows if row.get("training"))
    fixed, apart, precisions = fixed_settings(entries), namesakes(rows), _precisions(entries)
    return [*(protocol.note for protocol in _protocols(rows)), xrays(entries),
            *([f"Fixed settings: {fixed}."] if fixed else []), *warning_notes(rows),
            *([f"Trained rivals, as their files tell: {'; '.join(trained)}."] if trained else []),
            *([f"Of other data under one name, and so neither ranked nor paired: {apart}."] if apart else []),
            *([f"Networks computed in several precisions: {precisions}; the setting precision fixes one."]
              if precisions else [])]


def _precisions(entries: Sequence[Entry]) -> str:
    """The methods whose rows were computed in several precisions, where no setting tells these apart."""
    found: dict[str, dict[str, None]] = {}
    for entry in entries:
        if PRECISION not in entry.settings:
            found.setdefault(entry.method, {}).update(
                {row["precision"]: None for row in entry.counted if row.get("precision") not in (None, OWN_PRECISION)})
    return "; ".join(f"{method} {', '.join(of)}" for method, of in found.items() if len(of) > 1)


def _protocols(rows: Sequence[Mapping]) -> list[Protocol]:
    return [protocol_of(name) for name in dict.fromkeys(row.get("protocol") for row in rows) if name is not None]


def _reasons(entries: Sequence[Entry]) -> list[str]:
    """Why entries lack cases, each reason once."""
    return list(dict.fromkeys(f"{entry.method}: {entry.error}" for entry in entries if entry.error))
