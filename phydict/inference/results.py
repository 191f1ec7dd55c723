"""The finished cases of one method on disk: each one a folder that appears whole or not at all."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

from phydict.evaluation import RANGE, Table, mean_table, write_csv
from phydict.grid import Grid
from phydict.inference.conditions import simulated, simulated_on, xrays_note
from phydict.inference.protocols import Protocol
from phydict.page import CASE_FILES
from phydict.runtime.files import atomic_directory, atomic_write, check_replaceable, remove_leftovers, undisturbed
from phydict.runtime.reading import not_written
from phydict.runtime.strict_json import strict_json

RECORD = "reconstruction.json"
"""The file that marks a case as finished."""

UNLISTED = ("volume.nii.gz", "deviation.nii.gz", "panel.png")
"""The files, beside the record, of cases whose record does not list them, as older ones do not."""

COARSE = "coarse.nii.gz"
"""The coarse volume of a case, where one was made and is kept."""

RESULTS, MEANS = "results.csv", "results.md"
"""The table of scores, a row per case, and that of their means."""

FEATURES = "slice_features.safetensors"
"""Of a case the features of its slices, where the Frechet distance is measured."""


class Finished(NamedTuple):
    """A finished case: its record, and which file that is, by which two results of the same differ."""

    record: dict
    file: tuple[int, int]


class CaseResults:
    """Finished cases below `folder`, one folder each.

    A case is finished with certain settings and a certain source (what identifies its input); both are kept in its
    record, so that a result is never taken for that of other settings or of other data. A result takes the place of
    another only with `overwrite`, only when it is complete, and only where that one was there when the work began and
    its folder holds nothing but what its record lists.
    """

    def __init__(self, folder: Path, overwrite: bool = False):
        self.folder, self.overwrite = folder, overwrite
        self.to_resume = "run the same command again" + (
            ", which with --model.overwrite true does the finished cases again as well" if overwrite else "")
        self._sources: dict[str, str] = {}
        self._settings: dict = {}
        self._keep_coarse = False
        self._before: dict[str, Finished | None] = {}

    def unfinished(self, sources: dict[str, str], settings: dict, keep_coarse: bool = False) -> list[str]:
        """Of the cases, id -> source, those that remain to be done; all of them with `overwrite`. keep_coarse: those
        that lack a coarse volume, but made one, are to be done again.

        Removes what killed processes left. Raises ValueError where what is in the place of a case or of the table must
        stay: what this project did not write, and without `overwrite` a result of other settings or another source.
        """
        remove_leftovers(self.folder)
        self._check_table()
        self._sources, self._settings = sources, json.loads(strict_json(settings))  # as records hold them
        self._keep_coarse = keep_coarse
        with undisturbed(self.folder):
            self._before = {case: self._there(case) for case in sources}
        left = []
        for case, there in self._before.items():
            if there and not self.overwrite and (other := self._other(case, there)):
                raise ValueError(f"{self.folder / case} was finished with other {other}: add --model.overwrite true, "
                                 "or give another --model.out")
            if there and not self.overwrite and not self._lacks_coarse(case, there):
                continue
            if there:
                self._check_own(case, there)
            left.append(case)
        return left

    def missing(self) -> list[str]:
        """Of the cases given to `unfinished`, those that are not finished as they should be by now."""
        with undisturbed(self.folder):
            now = {case: self._there(case) for case in self._sources}
        return [case for case, there in now.items()
                if not there or self._other(case, there) or self._lacks_coarse(case, there)
                or (self.overwrite and self._is_unchanged(case, there))]

    def write(self, case: str, record: dict, write_files: Callable[[Path], None]) -> None:
        """Makes a case's folder: `write_files` fills it, the record, which lists them, completes it, then it takes its
        place, unless another process has finished the same case since `unfinished`.

        Raises OSError, in one sentence, where it cannot be written, and ValueError where something else has come to be
        in its place.
        """
        final = self.folder / case
        try:
            with atomic_directory(final, lambda: self._is_free(case)) as partial:
                write_files(partial)
                files = sorted(file.name for file in partial.iterdir())
                (partial / RECORD).write_text(strict_json(record | {"files": files}, indent=1))
        except OSError as error:
            raise not_written(f"the case {final}", error, "give another model.out") from error

    def summarise(self, cases: Iterable[str], further: Sequence[Table] = (),
                  protocol: Protocol | None = None, empty: Mapping[str, str] = MappingProxyType({}),
                  missing: Sequence[str] = ()) -> list[Table]:
        """The tables of the finished cases that were scored, and further ones behind them; written as results.csv, with
        one row per case, and results.md. None where no case was scored. protocol: what the scores were taken by;
        empty: scores that may stay empty -> why; missing: cases that have failed, which the first table then tells."""
        records = []
        for case in cases:
            there = self._there(case)
            if there and there.record["scores"]:
                records.append(there.record | {"case": case})
        if not records:
            return []
        table = score_table(records, protocol, empty)
        if missing:
            table = replace(table, notes=[*table.notes, f"Not reconstructed, and so not in the means: "
                                          f"{', '.join(missing)}."])
        tables = [table, *further]
        write_csv(self.folder / RESULTS, [score_row(record["case"], record) for record in records])
        with atomic_write(self.folder / MEANS) as part:
            part.write_text("\n".join(table.markdown() for table in tables), "utf-8", "replace")
        return tables

    def beside(self, cases: Iterable[str]) -> int:
        """How many finished cases the folder holds beside these."""
        return len({file.parent.name for file in self.folder.glob(f"[!.]*/{RECORD}")} - set(cases))

    def _there(self, case: str) -> Finished | None:
        """The finished case in its place, None where nothing is. Raises ValueError for anything else."""
        folder = self.folder / case
        if not os.path.lexists(folder):
            return None
        try:
            stat = (folder / RECORD).stat()
            record = json.loads((folder / RECORD).read_text())
            record["settings"], record["source"], set(record.get("files", UNLISTED))
            if record["scores"]:
                score_row(case, record)
        except Exception as error:  # whatever a damaged record leads to
            raise ValueError(f"{folder} is in the place of a case, but its {RECORD} is missing or damaged, and it is "
                             "not replaced: move it away, or give another model.out") from error
        return Finished(record, (stat.st_ino, stat.st_mtime_ns))

    def _other(self, case: str, there: Finished) -> str:
        """In what a finished case differs from the request; empty where it does not."""
        same = {"settings": there.record["settings"] == self._settings,
                "data": there.record["source"] == self._sources[case]}
        return " and ".join(what for what in same if not same[what])

    def _lacks_coarse(self, case: str, there: Finished) -> bool:
        """Whether a finished case lacks a coarse volume that is to be kept; of older ones none says that none was made.
        """
        return self._keep_coarse and there.record.get("coarse", True) and not (self.folder / case / COARSE).is_file()

    def _is_unchanged(self, case: str, there: Finished) -> bool:
        """Whether a finished case is the one that was there when `unfinished` looked."""
        before = self._before[case]
        return before is not None and before.file == there.file

    def _check_own(self, case: str, there: Finished) -> None:
        """Raises ValueError where a finished case's folder is not this project's alone, so that it must stay."""
        check_replaceable(self.folder / case, {RECORD, *CASE_FILES, *there.record.get("files", UNLISTED)}, "model.out")

    def _is_free(self, case: str) -> bool:
        """Whether a result takes its place: not where another process has put the same there. Raises ValueError where
        something else has come to be there."""
        there = self._there(case)
        if there is None:
            return True
        if self._is_unchanged(case, there):
            self._check_own(case, there)
            return True
        if other := self._other(case, there):
            raise ValueError(f"another process has finished {self.folder / case} with other {other} in the meantime, "
                             "and that result stays: give another model.out")
        return False

    def _check_table(self) -> None:
        """Raises ValueError where a table of someone else's would be replaced."""
        table, page = self.folder / RESULTS, self.folder / MEANS
        if table.is_file():
            with table.open("rb") as file:
                replaceable = file.read(12) == b"case,method,"
        else:
            replaceable = not os.path.lexists(page)
        if not replaceable:
            raise ValueError(f"{table if table.is_file() else page} is no table of this command, and is not replaced: "
                             "move it away, or give another model.out")


def score_table(records: Sequence[dict], protocol: Protocol | None, empty: Mapping[str, str]) -> Table:
    """The means of records' scores by method, with notes on the files of networks, how their X-rays were made and the
    protocol, if any, that they were taken by; empty: scores that may stay empty -> why."""
    rows = [score_row(record["case"], record) for record in records]
    table = mean_table(rows, window=protocol.window if protocol else RANGE, empty=empty, first_calls=True)
    made = dict.fromkeys(_xrays(record["settings"]) for record in records
                         if "simulator" in record["settings"].get("data", {}))
    files = dict.fromkeys(f"{record['method']} with {' and '.join(of)}" for record in records
                          if (of := _files(record["settings"])))
    told = [f"Files: {', '.join(files)}."] if files else []
    return replace(table, notes=[*table.notes, *told, *made, *([protocol.note] if protocol else [])])


def _files(settings: Mapping) -> list[str]:
    """The files of a prior, a second stage and a trained rival that decided a result, each with its checksum."""
    named = [(settings[role], settings[f"{role}_crc32"]) for role in ("prior", "super_resolution")
             if f"{role}_crc32" in settings]
    method = settings.get("method", {})
    if method.get("weights_crc32"):
        named.append((Path(method["file"]).name, method["weights_crc32"]))
    return [f"{file} (CRC-32 {crc:08x})" for file, crc in named]


def _xrays(settings: Mapping) -> str:
    """How the X-rays of a scored case were made."""
    data = settings["data"]
    places = simulated_on(data.get("simulation_voxels"), data.get("protocol"),
                          Grid(**settings["grid"]) if "grid" in settings else None)
    return f"{xrays_note(simulated(data), places)}; seed {settings['seed']}."


def score_row(case: str, record: dict) -> dict:
    """The row of scores of a record; of whatever kind the error where it lacks what a record holds."""
    if not isinstance(record["method"], str) or not isinstance(record["views"], int):
        raise TypeError
    row = {"case": case, "method": record["method"], "views": record["views"],
           "grid": "x".join(map(str, record["grid"]["shape"]))}
    scores = {name: None if score is None else float(score) for name, score in (record["scores"] or {}).items()
              if name not in row}
    return row | scores | {
        "seconds": float(sum(record["seconds"].values())),
        "network_calls": int(record["network_calls"]), "projector_calls": int(record["projector_calls"]),
        "precision": record.get("precision"), "instruction_set": record.get("instruction_set"),
        "warning": "; ".join(record.get("warnings", [])) or None}
