"""Tables and a CSV of the Frechet distance of slices, made of the features that a comparison's rows have left."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from phydict.ablation.run import FID, features_file
from phydict.ablation.summary import Entry, conditions, format_settings
from phydict.datasets import patient_of
from phydict.evaluation import read_csv, write_csv
from phydict.evaluation.fid import StoredFeatures
from phydict.evaluation.tables import Table, fid_tables
from phydict.inference.distances import distance_rows
from phydict.inference.scoring import FIDSettings, Scoring


def write_distances(out: Path, entries: Sequence[Entry], scoring: Scoring) -> None:
    """Writes FID, the distances of each condition's entries, of those that have their features there, where the
    distance is measured. Of several seeds of a case each counts as a case of the same patient."""
    if scoring.network is None:
        return
    backbone, rows = scoring.fid.backbone, []
    for condition, group in conditions(entries):
        there = {entry.label: [row for row in entry.counted if features_file(out, row["key"]).is_file()]
                 for entry in group}
        features = {label: {name: StoredFeatures(features_file(out, key), backbone) for name, key in _named(kept)}
                    for label, kept in there.items() if kept}
        if features:
            rows += [{"method": row["method"]} | condition | row for row in distance_rows(features, scoring.fid)]
    write_csv(out / FID, rows)


def distance_tables(out: Path, entries: Sequence[Entry]) -> list[Table]:
    """The tables that FID in a folder gives, for each condition of the entries; none where there is no such file."""
    rows = read_csv(out / FID)
    tables: list[Table] = []
    names = {name for entry in entries for name in entry.condition}
    for condition, group in conditions(entries):
        labels = {entry.label for entry in group}
        of = [{"replicates": FIDSettings().replicates} | row for row in rows
              if row["method"] in labels and all(_text(row, name) == _text(condition, name) for name in names)]
        if of:
            tables += fid_tables(of, format_settings("Frechet distance of slices (FID)", condition))
    return tables


def _text(row: Mapping, name: str) -> str:
    """A setting as FID has it, empty where there is none."""
    return "" if row.get(name) is None else str(row[name])


def _named(rows: Sequence[Mapping]) -> list[tuple[str, str]]:
    """A name for each row of a case, of the case's patient (`patient_of`), and the row's key."""
    cases = [row["case"] for row in rows]
    repeats = [cases[:i].count(case) for i, case in enumerate(cases)]
    return [(f"{patient_of(case)}__{case}__{n}" if n else case, row["key"])
            for case, n, row in zip(cases, repeats, rows)]
