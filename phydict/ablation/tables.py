"""Tables of an ablation as Markdown and LaTeX, the best and the second of each measure marked."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from phydict.ablation.run import TABLES
from phydict.ablation.summary import SHOWN_MEASURES, Entry, best_settings, conditions, format_settings
from phydict.evaluation.metrics import RANGE, SIGMA, TAPS, Measure
from phydict.runtime.files import atomic_write

OF_METHODS = ("ssim", "psnr", "mae_hu", "misfit", "seconds", "network_calls")
"""Columns of the table of methods."""

OF_VIEWS = ("ssim", "psnr", "seconds")
"""Measures that are tabled against the number of views."""

OF_DELTA = ("ssim", "misfit", "psnr", "mae_hu", "seconds")
"""Columns of the table of Extra Compute, the misfit beside SSIM: what looks better may fit the X-rays worse."""


@dataclass(frozen=True)
class Table:
    """title; header: names of the columns, the first that of the lines; measures: of each column but the first;
    lines: a label, whether it takes part in the ranking, and a value per column, NaN for none; notes."""

    title: str
    header: list[str]
    measures: list[Measure]
    lines: list[tuple[str, bool, list[float]]]
    notes: list[str]

    def places(self) -> list[list[int]]:
        """Per line and column 1 for the best, 2 for the second, else 0. Values that are printed alike share a place,
        and the next one is the second only where the best is alone."""
        columns = [ranks([round(values[c], measure.decimals) if ranked else math.nan
                          for _, ranked, values in self.lines], measure.higher_is_better)
                   for c, measure in enumerate(self.measures)]
        return [[column[i] for column in columns] for i in range(len(self.lines))]

    def markdown(self) -> str:
        """Best in bold, second underlined."""
        marks = ("{}", "**{}**", "<u>{}</u>")
        lines = ["| " + " | ".join(self.header) + " |", "| --- |" + " ---: |" * len(self.measures)]
        for (label, _, values), places in zip(self.lines, self.places()):
            cells = [marks[place].format(text) for text, place in zip(self._texts(values), places)]
            lines.append("| " + " | ".join([label.replace("|", "\\|"), *cells]) + " |")
        return f"### {self.title}\n\n" + "\n".join(lines) + "\n\n" + "".join(f"{note}\n\n" for note in self.notes)

    def latex(self) -> str:
        """A tabular with booktabs' rules: best in bold, second underlined."""
        marks = ("{}", "\\textbf{{{}}}", "\\underline{{{}}}")
        lines = [" & ".join(map(escaped, self.header)) + " \\\\"]
        for (label, _, values), places in zip(self.lines, self.places()):
            cells = [marks[place].format(escaped(text)) for text, place in zip(self._texts(values), places)]
            lines.append(" & ".join([escaped(label), *cells]) + " \\\\")
        body = "\n".join([lines[0], "\\midrule", *lines[1:]])
        notes = " ".join(map(escaped, [self.title + ".", *self.notes]))
        return (f"\\begin{{table}}\n\\centering\n\\begin{{tabular}}{{l{'r' * len(self.measures)}}}\n\\toprule\n{body}\n"
                f"\\bottomrule\n\\end{{tabular}}\n\\caption{{{notes}}}\n\\end{{table}}\n")

    def _texts(self, values: Sequence[float]) -> list[str]:
        return ["–" if math.isnan(value) else f"{value:.{measure.decimals}f}"
                for value, measure in zip(values, self.measures)]


def ranks(values: Sequence[float], higher_is_better: bool | None) -> list[int]:
    """1 for the best, 2 for the second best, 0 for others; NaN takes no part, and neither does a lone value."""
    known = [value for value in values if not math.isnan(value)]
    if higher_is_better is None or len(known) < 2:
        return [0] * len(values)
    order = sorted(known, reverse=higher_is_better)
    second = order[1] if order[1] != order[0] else None
    return [1 if value == order[0] else 2 if value == second else 0 for value in values]


def method_table(found: Sequence[Entry], title: str, notes: Sequence[str] = ()) -> Table:
    """Method x measures, under one condition."""
    measures = [SHOWN_MEASURES[name] for name in OF_METHODS]
    lines = [(entry.label, entry.complete, [entry.means.get(name, math.nan) for name in OF_METHODS])
             for entry in found]
    return Table(title, ["method", *map(headed, measures)], measures, lines, [*notes, *reasons(found)])


def views_tables(found: Sequence[Entry], notes: Sequence[str] = ()) -> list[Table]:
    """Method x number of views, a table for each measure and each other condition: the form of the paper's Table 3."""
    tables = []
    for rest, group in conditions(found, without="views"):
        views = sorted({entry.condition["views"] for entry in group})
        for name in OF_VIEWS:
            measure, lines = SHOWN_MEASURES[name], {}
            for entry in group:
                ranked, values = lines.setdefault(", ".join([entry.method, *format_settings(entry.settings)]), ([], {}))
                ranked.append(entry.complete or not entry.cases)
                values[entry.condition["views"]] = entry.means.get(name, math.nan)
            title = ", ".join([f"{headed(measure)} against the number of views", *format_settings(rest)])
            tables.append(Table(title, ["method", *(f"K = {k}" for k in views)], [measure] * len(views),
                                [(label, all(ranked), [values.get(k, math.nan) for k in views])
                                 for label, (ranked, values) in lines.items()], [*notes, *reasons(group)]))
    return tables


def delta_tables(found: Sequence[Entry], notes: Sequence[str] = ()) -> list[Table]:
    """Extra Compute's delta x measures, a table for each method, its other settings and condition: the form of the
    paper's Table 2, with the misfit beside SSIM."""
    tables = []
    for label, group in deltas(found):
        measures = [SHOWN_MEASURES[name] for name in OF_DELTA]
        lines = [(f"{entry.settings['delta']:g}" + ("" if entry.complete else f" ({entry.cases} of {entry.of} cases)"),
                  entry.complete, [entry.means.get(name, math.nan) for name in OF_DELTA]) for entry in group]
        tables.append(Table(f"Extra Compute's delta: {label}", ["delta", *map(headed, measures)], measures, lines,
                            [*notes, *reasons(group)]))
    return tables


def deltas(found: Sequence[Entry]) -> list[tuple[str, list[Entry]]]:
    """What has a curve over delta: a label, and its entries from delta 0 up."""
    groups: dict[str, list] = {}
    for entry in found:
        if "delta" in entry.settings:
            others = {name: value for name, value in entry.settings.items() if name != "delta"}
            label = ", ".join([entry.method, *format_settings(others), *format_settings(entry.condition)])
            groups.setdefault(label, []).append(entry)
    return [(label, sorted(group, key=lambda entry: entry.settings["delta"])) for label, group in groups.items()]


def all_tables(found: Sequence[Entry], rows: Sequence[dict]) -> list[Table]:
    """Every table that the entries of some rows allow."""
    note, tables = [caption(rows), *doubts(rows)], []
    for condition, group in conditions(found):
        where = ", ".join(format_settings(condition)) or ", ".join(format_settings({k: rows[0][k] for k in ("views", "simulator")}))
        best = best_settings(group)
        if len(best) < len(group):
            tables.append(method_table(best, f"Methods, {where}: each at its setting of highest mean PSNR", [
                *note, "The settings were chosen by these cases' own PSNR."]))
        tables.append(method_table(group, f"Methods, {where}" + (": all settings" if len(best) < len(group) else ""),
                                   note))
    if any("views" in entry.condition for entry in found):
        tables += views_tables(found, note)
    if any("delta" in entry.settings for entry in found):
        tables += delta_tables(found, note)
    return tables


def write_tables(folder: Path, tables: Sequence[Table]) -> list[Path]:
    """tables.md and tables.tex in a folder."""
    markdown, latex = (folder / name for name in TABLES)
    files = {markdown: "\n".join(table.markdown() for table in tables),
             latex: "% needs \\usepackage{booktabs}\n" + "\n".join(table.latex() for table in tables)}
    for path, text in files.items():
        with atomic_write(path) as part:
            part.write_text(text)
    return list(files)


def caption(rows: Sequence[dict]) -> str:
    """What the numbers of tables were taken from."""
    cases = len({row["case"] for row in rows})
    listed = {name: ", ".join(dict.fromkeys(str(row[name]) for row in rows if name in row))
              for name in ("grid", "device", "threads", "seed", "precision", "instruction_set")}
    how = " on ".join(listed[name] for name in ("precision", "instruction_set") if listed[name])
    return (f"Mean over {cases} {'case' if cases == 1 else 'cases'}; best in bold, second underlined. HU clipped to "
            f"[{RANGE.low:g}, {RANGE.high:g}], data range {2 * RANGE.half_width:g} HU; SSIM 3-D on HU from the range's "
            f"low end, Gaussian of {TAPS} taps, sigma {SIGMA:g} voxels. Grid: {listed['grid']}. Seeds: "
            f"{listed['seed']}. Seconds: one reconstruction after a warm-up, {listed['device'] or 'none'}, threads "
            f"{listed['threads'] or 'none'}{how and f', {how}'}; loading and scoring excluded.")


def reasons(found: Sequence[Entry]) -> list[str]:
    """Why entries lack cases, each reason once."""
    return list(dict.fromkeys(f"{entry.method}: {entry.error}" for entry in found if entry.error))


def doubts(rows: Sequence[dict]) -> list[str]:
    """Which cases have warnings, and with which methods."""
    warned: dict[str, dict] = {}
    for row in rows:
        if row.get("warning"):
            warned.setdefault(row["case"], {})[row["method"]] = None
    told = "; ".join(f"{case} ({', '.join(methods)})" for case, methods in warned.items())
    return [f"Doubtful, by what the column warning of results.csv says: {told}."] if warned else []


def headed(measure: Measure) -> str:
    """A measure with the direction in which it is better."""
    return measure.label + {True: " ↑", False: " ↓", None: ""}[measure.higher_is_better]


def escaped(text: str) -> str:
    """Text as LaTeX prints it."""
    for plain, printed in (("\\", "\\textbackslash "), ("&", "\\&"), ("%", "\\%"), ("_", "\\_"), ("#", "\\#"),
                           ("{", "\\{"), ("}", "\\}"), ("~", "\\textasciitilde "), ("^", "\\textasciicircum "),
                           ("↑", "$\\uparrow$"), ("↓", "$\\downarrow$"), ("–", "--")):
        text = text.replace(plain, printed)
    return text
