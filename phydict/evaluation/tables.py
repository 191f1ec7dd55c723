"""Tables of results as Markdown, as LaTeX and for the console, the best and the second of each measure marked.

A row of results is a dict {"case": id, "method": name, metric: value, ...}. Its "warning", if any, says why its numbers
are to be doubted.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

from rich.console import Console, ConsoleOptions, RenderResult
from rich.markup import escape
from rich.measure import Measurement
from rich.table import Table as ConsoleTable
from rich.text import Text

from phydict.evaluation.bootstrap import Estimate, patients
from phydict.evaluation.fid import NAMES
from phydict.evaluation.metrics import MEASURES, RANGE, SIGMA, TAPS, Measure, Summary, case_id, summarise
from phydict.evaluation.planes import PLANES
from phydict.units import HUWindow

Value = float | Summary | Estimate
"""What a table prints: a number, or a mean with its interval."""

IN_BRACKETS = "In brackets: 95 % interval"
"""How the notes on intervals begin."""

NAMED = "whom the first folder or CT-RATE's number names"
"""By what `patient_of` tells patients apart."""

NO_INTERVALS = f"No intervals: all cases are of one patient, {NAMED}."

FIRST_CALLS = "Seconds: first calls included, such as compiling; ablate leaves them out."

FID_TITLE = "Frechet distance of slices (FID)"

MARKDOWN = str.maketrans({"\\": "\\\\", "&": "&amp;", "<": "&lt;", ">": "&gt;", "$": "\\$", "*": "\\*", "`": "\\`",
                          "\n": " ", "\r": " "})
"""What Markdown takes for more than text, but for a pipe, which ends a cell."""

LATEX = str.maketrans({
    "\\": "\\textbackslash{}", "$": "\\$", "&": "\\&", "%": "\\%", "_": "\\_", "#": "\\#", "{": "\\{", "}": "\\}",
    "~": "\\textasciitilde{}", "^": "\\textasciicircum{}", "|": "\\textbar{}", "<": "\\textless{}",
    ">": "\\textgreater{}", "↑": "$\\uparrow$", "↓": "$\\downarrow$", "→": "$\\rightarrow$", "±": "$\\pm$", "–": "--",
    "\n": " ", "\r": " "})
"""What LaTeX takes for more than text, or has no letter for."""


@dataclass(frozen=True)
class Table:
    """title; header: names of the columns, the first that of the labels; measures: of each column but the first;
    lines: a label, whether it takes part in the ranking, and a value per measure, None for none; notes."""

    title: str
    header: list[str]
    measures: list[Measure]
    lines: Sequence[tuple[str, bool, Sequence[Value | None]]]
    notes: list[str]

    def markdown(self) -> str:
        """Best in bold, second underlined."""
        lines = self._marked(("{}", "**{}**", "<u>{}</u>"), _markdown_cell)
        rule = ["---", *["---:"] * len(self.measures)]
        table = "\n".join(f"| {' | '.join(line)} |" for line in [list(map(_markdown_cell, self.header)), rule, *lines])
        title, *notes = (text.translate(MARKDOWN) for text in (self.title, *self.notes))
        return "\n\n".join([f"### {title}", table, *notes]) + "\n\n"

    def latex(self) -> str:
        """A tabular with booktabs' rules: best in bold, second underlined."""
        lines = self._marked(("{}", "\\textbf{{{}}}", "\\underline{{{}}}"), escaped)
        header, *body = [" & ".join(line) + " \\\\" for line in [map(escaped, self.header), *lines]]
        body = [("{}" if line.lstrip()[0] in "[*" else "") + line for line in body]  # which \\ takes for its own
        notes = " ".join(map(escaped, [f"{self.title}.", *self.notes]))
        return "\n".join(["\\begin{table}", "\\centering", f"\\begin{{tabular}}{{l{'r' * len(self.measures)}}}",
                          "\\toprule", header, "\\midrule", *body, "\\bottomrule", "\\end{tabular}",
                          f"\\caption{{{notes}}}", "\\end{table}", ""])

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """For rich's console, without intervals, for which its lines are too short: best in bold, second underlined.
        Where measures do not fit beside each other, they stand below each other."""
        table, wide = self._console(), options.update(width=10_000)
        fits = Measurement.get(console, wide, table).maximum <= options.max_width
        yield table if fits else self._console(turned=True)
        yield Text("\n".join(note for note in self.notes if not note.startswith(IN_BRACKETS)), "table.caption")

    def _console(self, turned: bool = False) -> ConsoleTable:
        table = ConsoleTable(title=escape(self.title))
        plain = replace(self, lines=[(label, ranked, [_without_interval(value) for value in values])
                                     for label, ranked, values in self.lines])
        lines = [[escape(name) for name in self.header],
                 *plain._marked(("{}", "[bold]{}[/bold]", "[underline]{}[/underline]"), escape)]
        header, *lines = [list(line) for line in zip(*lines)] if turned else lines
        for i, name in enumerate(header):
            table.add_column(name, justify="right" if i else "left")
        for line in lines:
            table.add_row(*line)
        return table

    def cells(self) -> list[list[tuple[str, int]]]:
        """The values of each line as text, each with its place: 1 for the best, 2 for the second, else 0. Values that
        are printed alike share a place."""
        columns = []
        for c, measure in enumerate(self.measures):
            values = [values[c] for _, _, values in self.lines]
            places = ranks([float(value) if ranked and value is not None else math.nan
                            for (_, ranked, _), value in zip(self.lines, values)], measure)
            columns.append([("–" if value is None else f"{value:.{measure.decimals}f}", place)
                            for value, place in zip(values, places)])
        return [[column[n] for column in columns] for n in range(len(self.lines))]

    @property
    def ranks(self) -> bool:
        """Whether a value is marked."""
        return any(place for line in self.cells() for _, place in line)

    def _marked(self, marks: Sequence[str], printed: Callable[[str], str]) -> list[list[str]]:
        """The lines as text, each value in the mark of its place."""
        return [[printed(label), *(marks[place].format(printed(text)) for text, place in cells)]
                for (label, _, _), cells in zip(self.lines, self.cells())]


def _without_interval(value: Value | None) -> Value | None:
    return value._replace(low=math.nan, high=math.nan) if isinstance(value, Summary | Estimate) else value


def _markdown_cell(text: str) -> str:
    return text.translate(MARKDOWN).replace("|", "\\|")


def ranks(values: Sequence[float], measure: Measure) -> list[int]:
    """1 for the best by what is printed of a measure, 2 for the second best, 0 for others; the second is marked only
    where the best is alone; NaN takes no part, and none is marked where all others are alike."""
    if not measure.ranks:
        return [0] * len(values)
    worths = [round(measure.worth(round(value, measure.decimals)), measure.decimals) for value in values]
    known = sorted((worth for worth in worths if not math.isnan(worth)), reverse=True)
    if len(set(known)) < 2:
        return [0] * len(values)
    best, second = known[:2]
    return [1 if worth == best else 2 if worth == second else 0 for worth in worths]


def rankable(measure: Measure, cases: Iterable[Iterable[str]]) -> Measure:
    """A measure, unranked where the lines of a table, given by their cases, do not all have the same cases."""
    return measure if len({frozenset(of) for of in cases}) < 2 else measure.unranked()


def mean_table(rows: Iterable[Mapping], window: HUWindow = RANGE, empty: Mapping[str, str] = MappingProxyType({}),
               first_calls: bool = False) -> Table:
    """Mean ± standard deviation over cases, a line per method, ranked by what all of them have of the same cases; where
    rows have warnings, a last column counts their cases.

    window: the HU range of `volume_metrics`. empty: metric -> why it has no value, if it has none; it then has a column
    all the same, and a note. first_calls: whether seconds hold what only a first call costs, such as compiling: they
    are then not ranked and have no interval. The caption takes grid and views from the rows' columns of these names.
    """
    rows = list(rows)
    groups = summarise(rows)
    measured = [name for name in MEASURES if any(name in group for group in groups.values())]
    names = [name for name in MEASURES if name in measured or name in empty]
    measures = [MEASURES[name] for name in names]
    if first_calls and "seconds" in names:
        measures[names.index("seconds")] = MEASURES["seconds"].unranked()
    header = ["method", *(measure.heading for measure in measures)]
    measures = [rankable(measure, (group[name].cases for group in groups.values() if name in group))
                for name, measure in zip(names, measures)]
    lines: list[tuple[str, bool, list[Value | None]]] = [
        (label, True, [_without_interval(group.get(name)) if first_calls and name == "seconds" else group.get(name)
                       for name in names]) for label, group in groups.items()]
    if warned := warned_cases(rows):
        header.append("warned")
        measures.append(Measure("warned", None, 0))
        lines = [(label, ranked, [*values, len(warned.get(label, ()))]) for label, ranked, values in lines]
    of_group = {group: frozenset(case_id(row, n) for n, row in enumerate(
        row for row in rows if str(row["method"]) == group)) for group in groups}
    cases = set(of_group.values())
    unequal = " (not the same cases in every line)" if len(cases) > 1 else ""
    parts = partial_notes((label, len(of_group[label]), {name: len(summary.cases) for name, summary in group.items()})
                          for label, group in groups.items())
    number = span(map(len, cases))
    over = "One case" if number == "1" else f"Mean ± standard deviation over n = {number} cases"
    table = Table("Scores by method", header, measures, lines, [])
    timed = first_calls and "seconds" in measured
    return replace(table, notes=[
        caption(over + unequal, table.ranks, rows, {"Grid": "grid", "Views": "views"}, window),
        *interval_note(lines, cases), *([FIRST_CALLS] if timed else []), *parts, *empty_notes(empty, measured),
        *warning_notes(rows)])


def span(numbers: Iterable[int]) -> str:
    """The least and the largest of some numbers."""
    ordered = sorted(numbers)
    return " to ".join(map(str, dict.fromkeys((ordered[0], ordered[-1]))))


def fid_tables(rows: Sequence[Mapping], title: str = FID_TITLE) -> list[Table]:
    """The Frechet distances of `fid_rows`, a line each, with what they rest on; where they have intervals, a second
    table has their differences from the least distance of most cases."""
    paired = [row for row in rows if row.get("less")]
    alike = len(paired) == len(rows) - 1
    counts = dict.fromkeys(map(_counts, rows))
    note = (f"Backbone {rows[0]['fid_backbone']}, a scale of its own: {'; '.join(counts)}, all of each volume, against "
            f"the truth's of the same cases. {rows[0]['fid_normalisation']}, so that a wrong HU scale is not seen. "
            "FID: mean of the planes.")
    people = [row["patients"] for row in rows if "patients" in row]  # which older tables lack
    several = any(row.get("patients", row["cases"]) < row["cases"] for row in rows)
    measures = [Measure(f"FID-{name[4:].upper()}" if "_" in name else "FID", False, 3) for name in NAMES]
    header = ["method", *(measure.heading for measure in measures)]
    lines = [(row["method"], alike, _estimates(row, "")) for row in rows]
    if not has_intervals(lines):
        alone = several and max(people) < 2
        return [Table(title, header, measures, lines, [note, *([NO_INTERVALS] if alone else [])])]
    replicates, who = rows[0]["replicates"], f"{f'{span(people)} ' if people else ''}patients"
    tables = [Table(title, header, measures, lines, [
        note, f"{IN_BRACKETS}, {replicates} draws of {who}{f', {NAMED}' if several else ''}; repeated slices make it "
              "too high."])]
    if paired:
        less = [(row["method"], False, _estimates(row, "less_")) for row in paired]
        tables.append(Table(f"{title}: less {paired[0]['less']}, draw by draw", header, measures, less, [
            note, f"{IN_BRACKETS} of the difference: each of the {replicates} draws has the same patients for both."]))
    return tables


def _counts(row: Mapping) -> str:
    """What a row's distances rest on: its cases, their seeds and slices, and how many the truth has where it has
    others."""
    slices, truth = (", ".join(f"{plane.upper()} {row.get(f'{of}slices_{plane}')}" for plane in PLANES)
                     for of in ("", "truth_"))
    seeds = str(row.get("seeds", 1))
    return (f"{row['cases']} case{'s' if row['cases'] > 1 else ''}"
            + (f", {seeds} seeds each, with {slices} slices beside {truth} of the truth" if seeds != "1" else
               f" with {slices} slices"))


def _estimates(row: Mapping, of: str) -> list[Value | None]:
    """The distances of a row, or, `of` "less_", their differences."""
    return [Estimate(*(row.get(f"{of}{name}{end}", math.nan) for end in ("", "_low", "_high"))) for name in NAMES]


def caption(statistic: str, marked: bool, rows: Sequence[Mapping], columns: Mapping[str, str], window: HUWindow) -> str:
    """One line that says what the numbers of a table are: a statistic of scores in an HU range, of rows that have these
    values in some columns, label -> column; marked: whether some are marked as the best."""
    stated = "".join(f" {label}: {listed(rows, column) or 'not stated'}." for label, column in columns.items())
    marks = "; best in bold, second underlined" if marked else ""
    return (f"{statistic}{marks}. HU clipped to [{window.low:g}, {window.high:g}], data "
            f"range {2 * window.half_width:g} HU; SSIM 3-D on HU from the range's low end, Gaussian of {TAPS} taps, "
            f"sigma {SIGMA:g} voxels.{stated}")


def has_intervals(lines: Iterable[tuple[str, bool, Sequence[Value | None]]]) -> bool:
    """Whether some value of a table's lines has an interval."""
    return any(isinstance(value, Summary | Estimate) and not math.isnan(value.low + value.high)
               for _, _, line in lines for value in line)


def interval_note(lines: Iterable[tuple[str, bool, Sequence[Value | None]]],
                  cases: Iterable[Iterable[str]]) -> list[str]:
    """The note on the intervals of a table's lines, of these cases each: over how many patients they are, or that a
    single one has none."""
    each = [found for of in cases if (found := list(of))]
    several = any(patients(of) < len(of) for of in each)
    if has_intervals(lines):
        number = span(map(patients, each))
        return [f"{IN_BRACKETS} of the mean, bootstrap over {number} patients{f', {NAMED}' if several else ''}."]
    return [NO_INTERVALS] if several and all(patients(of) < 2 for of in each) else []


def empty_notes(empty: Mapping[str, str], measured: Iterable[str]) -> list[str]:
    """Why columns are empty: metric -> reason, of those that were not measured."""
    return [f"{MEASURES[name].label}: empty, since {reason}." for name, reason in empty.items() if name not in measured]


def partial_notes(lines: Iterable[tuple[str, int, Mapping[str, int]]]) -> list[str]:
    """Sentences on scores that are the mean of only some of a line's cases; lines: (label, number of cases, score ->
    number of cases that have it)."""
    parts: dict[str, list[str]] = {}
    for label, cases, counts in lines:
        for name, count in counts.items():
            if 0 < count < cases:
                parts.setdefault(f"{MEASURES[name].label}: of {count} of {cases} cases", []).append(label)
    return [f"{part} ({', '.join(labels)})." for part, labels in parts.items()]


def listed(rows: Sequence[Mapping], column: str) -> str:
    """The values of a column, each once."""
    return ", ".join(dict.fromkeys(str(row[column]) for row in rows if row.get(column) is not None))


def warned_cases(rows: Sequence[Mapping]) -> dict[str, list[str]]:
    """{method: its cases with a warning}, of methods that have any."""
    warned: dict[str, dict] = {}
    for row in rows:
        if row.get("warning"):
            warned.setdefault(str(row["method"]), {})[str(row.get("case", "a row"))] = None
    return {method: list(cases) for method, cases in warned.items()}


def warning_notes(rows: Sequence[Mapping]) -> list[str]:
    """The note on cases with a warning, where there are any."""
    warned = "; ".join(f"{method}: {', '.join(cases)}" for method, cases in warned_cases(rows).items())
    return [f"Doubtful cases, by the column warning: {warned}."] if warned else []


def escaped(text: str) -> str:
    """Text as LaTeX prints it."""
    return text.translate(LATEX)
