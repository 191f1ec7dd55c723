"""The finished cases of one method on disk: each one a folder that appears whole or not at all."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterable
from pathlib import Path

from phydict.atomic import remove_leftovers, whole_folder
from phydict.evaluation import markdown, write_csv
from phydict.reading import not_written

RECORD = "reconstruction.json"
"""The file that marks a case as finished."""


class CaseResults:
    """Finished cases below `folder`, one folder each.

    A case is finished with certain settings and a certain source (what identifies its input); both are kept in its
    record, so that a result is never taken for that of other settings or of other data.
    """

    def __init__(self, folder: Path, overwrite: bool = False):
        self.folder, self.overwrite = folder, overwrite

    def unfinished(self, sources: dict[str, str], settings: dict) -> list[str]:
        """Of the cases, id -> source, those that remain to be done; all of them with `overwrite`.

        Raises ValueError for a folder in a case's place that holds no finished case, or one of another origin.
        """
        if self.overwrite:
            return list(sources)
        settings = json.loads(json.dumps(settings))
        left = []
        for case, source in sources.items():
            folder = self.folder / case
            if not folder.exists():
                left.append(case)
                continue
            record = self.read(case)
            for what, same in (("settings", record["settings"] == settings), ("data", record["source"] == source)):
                if not same:
                    raise ValueError(f"{folder} was finished with other {what}: set model.overwrite to true, or give "
                                     "another model.out")
        return left

    def read(self, case: str) -> dict:
        """The record of a finished case. Raises ValueError where there is none or it is damaged."""
        file = self.folder / case / RECORD
        try:
            record = json.loads(file.read_text())
            record["settings"], record["source"], record["scores"]
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise ValueError(f"{file.parent} is in the place of a case, but its {RECORD} is missing or damaged: "
                             "move that folder away, set model.overwrite to true, or give another model.out") from error
        return record

    def remove_leftovers(self) -> None:
        """Removes what processes of this machine that are no more had begun to write."""
        remove_leftovers(self.folder)

    def write(self, case: str, record: dict, write_files: Callable[[Path], None]) -> None:
        """Makes a case's folder: `write_files` fills it, the record completes it, then it takes its place.

        Raises OSError, in one sentence, where it cannot be written.
        """
        final = self.folder / case
        try:
            with whole_folder(final) as partial:
                write_files(partial)
                (partial / RECORD).write_text(json.dumps(record, indent=1))
        except OSError as error:
            raise not_written(f"the case {final}", error, "give another model.out") from error

    def discard(self, case: str) -> None:
        """Removes the older result, if any, of a case that was to be overwritten and has failed."""
        if self.overwrite:
            shutil.rmtree(self.folder / case, ignore_errors=True)

    def summarise(self, cases: Iterable[str]) -> list[dict]:
        """One row of scores per case that was scored; written as results.csv and results.md."""
        rows = []
        for case in cases:
            record = self.read(case)
            if record["scores"]:
                rows.append({"case": case, "method": record["method"], "views": record["views"],
                             "grid": "x".join(map(str, record["grid"]["shape"]))} | record["scores"] | {
                                 "seconds": sum(record["seconds"].values()), "network_calls": record["network_calls"],
                                 "projector_calls": record["projector_calls"],
                                 "precision": record.get("precision"),
                                 "instruction_set": record.get("instruction_set")})
        if rows:
            write_csv(self.folder / "results.csv", rows)
            (self.folder / "results.md").write_text(markdown(rows))
        return rows

