"""Rows of results as a CSV that loses no digit and is never half written."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Mapping
from pathlib import Path

from phydict.runtime.files import atomic_write
from phydict.runtime.reading import Unreadable, reading

TEXT_COLUMNS = ("case", "method")
"""Columns that are text even where they look like numbers."""


def write_csv(path: str | Path, rows: Iterable[Mapping]) -> None:
    """Write `rows` as CSV: the columns are the union of their keys, case and method first, then as they first appear.

    A value that is None or left out becomes an empty field; numbers keep all their digits; what is no UTF-8 in a name
    becomes a question mark.
    The file is replaced in one step, so that a killed process leaves the old file or the new one, never a part.
    To append: `write_csv(path, read_csv(path) + new_rows)`.
    """
    rows = list(rows)
    keys = dict.fromkeys(key for row in rows for key in row)
    columns = [name for name in TEXT_COLUMNS if name in keys] + [name for name in keys if name not in TEXT_COLUMNS]
    with atomic_write(Path(path)) as part, part.open("w", newline="", encoding="utf-8", errors="replace") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        writer.writerows([_to_text(row.get(name)) for name in columns] for row in rows)


def read_csv(path: str | Path) -> list[dict]:
    """Rows of a CSV by `write_csv`, numbers as int or float; empty fields are left out; no file gives no rows.

    Text that only resembles a number ("007") stays text, and so do the columns case and method. A mark of UTF-8 at the
    beginning, as spreadsheets write it, is left out.
    Raises ValueError naming the file where it is no table, two columns have one name, or a row's number of fields is
    not the header's, as in a file cut off by another program.
    """
    path = Path(path)
    if not path.exists():
        return []
    with reading(f"the table {path}", "repair or remove it"), open(path, newline="", encoding="utf-8-sig") as file:
        reader = csv.reader(file)
        columns = next(reader, [])
        if twice := next((name for n, name in enumerate(columns) if name in columns[:n]), None):
            raise Unreadable(f"{path} has the column {twice!r} twice, and which one counts is not known; remove one of "
                             "the two")
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
