"""The table of results of a comparison, and the files that its rows leave beside it."""

from __future__ import annotations

import reprlib
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

from phydict.evaluation import read_csv, write_csv
from phydict.evaluation.metrics import MEASURES
from phydict.inference.results import RESULTS

TABLES, FID = ("tables.md", "tables.tex"), "fid.csv"
"""The tables that are made of a folder's results, and the Frechet distances."""

DETAILS = "details.json"
"""What is known of a row whose volume is kept and the table does not hold, beside that volume."""

FINISHED = ("ok", "refused", "diverged")
"""What a row's status may be that is not tried again; "failed" is, since its reason may lie outside: "refused" is what
the method itself raises a ValueError for."""

MEASURED = ("status", "error", "warning", *MEASURES, "seconds_prepare", "seconds_sample", "seconds_score",
            "seconds_network", "seconds_projector", "network_calls", "projector_calls", "peak_memory_mb", "device",
            "threads", "precision", "instruction_set")
"""Columns that a run fills; the others are the trial's. peak_memory_mb, in MiB, is that of the tensors on a
CUDA device, else of the process."""

WORDS = ("status", "error", "warning", "device", "precision", "instruction_set")
"""Those of MEASURED that are no numbers."""

IDENTIFYING = ("window", "data")
"""What tells apart rows of equal settings, and older rows lack: the HU window of the truth, and a short checksum of
what identifies the case's data."""


def is_measured(name: str) -> bool:
    """Whether a run fills a column: those of MEASURED, and the seconds of whatever stages a method has."""
    return name in MEASURED or name.startswith("seconds_")


class Results:
    """The table of results in a folder, of which this process alone writes while it is open.

    A row is known by its key (trials.key): rows of other settings or other data in the file are kept at its end.
    Raises ValueError where the file is damaged, is the table of another comparison, with no row in common, or is not
    there while what is made of it is, which then is someone else's.
    """

    def __init__(self, folder: Path, planned: Mapping[str, dict]):
        self.file, self.planned = folder / RESULTS, planned
        others = sorted(file.name for file in folder.glob("*") if file.suffix == ".png" or file.name in (*TABLES, FID))
        if others and not self.file.exists():
            raise ValueError(f"{folder} holds {', '.join(others)}, but no {RESULTS} of this command, and is not "
                             "written to: give another out, or move that away")
        stored: dict = {row.get("key"): row for row in read_csv(self.file)}
        if None in stored:
            raise ValueError(f"{self.file} has rows without a key, so that it is no table of this command: give "
                             "another out")
        if stored and not stored.keys() & planned.keys():
            differing = _differing(stored.values(), planned.values())
            raise ValueError(f"{self.file} is the table of another comparison, whose {len(stored)} rows are all of "
                             f"other settings or data{differing}: give another out, or remove "
                             f"{', '.join([RESULTS, *others])}")
        for name, row in stored.items():
            wrong = next((k for k in row if is_measured(k) and k not in WORDS and isinstance(row[k], str)), None)
            if wrong:
                raise ValueError(f"{self.file}: {wrong} of row {name} is {reprlib.repr(row[wrong])}, which is no "
                                 "number: remove that row, and it is run again")
        self.others = [row for name, row in stored.items() if name not in planned]
        self.done = {name: self._row(name, row) for name, row in stored.items()
                     if name in planned and row.get("status") in FINISHED}
        self.again: set[str] = set()

    def _row(self, name: str, measured: Mapping) -> dict:
        return self.planned[name] | {k: value for k, value in measured.items()
                                     if is_measured(k) and value is not None} | {"key": name}

    @property
    def rows(self) -> list[dict]:
        """The rows of what is planned, in its order."""
        return [self.done[name] for name in self.planned if name in self.done]

    @property
    def all_rows(self) -> list[dict]:
        """The rows of what is planned, in its order, where they are not there yet as not run."""
        return [self.done.get(name, columns | {"status": "not run", "error": "the run was stopped", "key": name})
                for name, columns in self.planned.items()]

    def add(self, name: str, measured: Mapping) -> None:
        """Adds a row and writes the table, in one step."""
        if measured["status"] == "ok" or name not in self.again:
            self.done[name] = self._row(name, measured)
        self.again.discard(name)
        self.write()

    def forget(self, lacking: Callable[[str], bool]) -> None:
        """Have rows run again, by their keys, whose volume was scored but lacks something; they stay until then."""
        self.again |= {name for name, row in self.done.items() if row["status"] == "ok" and lacking(name)}

    def finished(self, name: str) -> bool:
        """Whether nothing is to be run for a row."""
        return name in self.done and name not in self.again

    def write(self) -> None:
        """The table with the columns in one order, whatever order its rows came in."""
        order = dict.fromkeys(k for row in self.planned.values() for k in row) | dict.fromkeys((*MEASURED, "key"))
        write_csv(self.file, [{k: row.get(k) for k in order} | row for row in self.rows + self.others])


def _differing(stored: Iterable[dict], planned: Iterable[dict]) -> str:
    """In brackets, the columns of which no stored row has what a planned one has, with some of their values."""
    def some(values: Iterable[str]) -> str:
        first, rest = [*values][:3], [*values][3:]
        return ", ".join(first + (["..."] if rest else []))

    of_stored, of_planned = list(stored), list(planned)
    columns = dict.fromkeys(name for row in of_planned for name in row)
    differ = []
    for name in columns:
        there, here = (dict.fromkeys(str(row.get(name)) for row in rows) for rows in (of_stored, of_planned))
        unknown = name in IDENTIFYING and there.keys() == {"None"}
        if not there.keys() & here.keys() and not unknown:
            differ.append(f"{name} {some(there)} there and {some(here)} here")
    return f" ({'; '.join(differ)})" if differ else ""


def features_file(out: Path, key: str) -> Path:
    """Where the features of the slices of a row's volume are kept."""
    return out / "features" / f"{key}.safetensors"


def volume_folder(out: Path, key: str) -> Path:
    """Where a row's volume is kept, with what the page shows of it, if it is."""
    return out / "volumes" / key
