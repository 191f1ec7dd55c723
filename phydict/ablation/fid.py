"""Tables and a CSV of the Frechet distance of slices, made of the features that a comparison's rows have left."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from phydict.ablation.results import FID, features_file
from phydict.ablation.summary import Entry, conditions, xrays
from phydict.evaluation import read_csv, write_csv
from phydict.evaluation.fid import CaseFeatures, SeedFeatures, StoredFeatures
from phydict.evaluation.tables import FID_TITLE, Table, fid_tables
from phydict.inference.conditions import format_settings
from phydict.inference.distances import distance_rows
from phydict.inference.scoring import FIDSettings, Scoring


def write_distances(out: Path, entries: Sequence[Entry], scoring: Scoring) -> None:
    """Writes FID, the distances of each condition's entries, of those that have their features there, where the
    distance is measured."""
    if scoring.network is None:
        return
    backbone, rows = scoring.fid.backbone, []
    for condition, group in conditions(entries):
        there = {entry.label: [row for row in entry.counted if features_file(out, row["key"]).is_file()]
                 for entry in group}
        features = {label: _features(out, kept, backbone) for label, kept in there.items() if kept}
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
            tables += [replace(table, notes=[*table.notes, xrays(group)]) for table in fid_tables(
                of, format_settings(FID_TITLE, condition))]
    return tables


def _text(row: Mapping, name: str) -> str:
    """A setting as FID has it, empty where there is none."""
    return "" if row.get(name) is None else str(row[name])


def _features(out: Path, rows: Sequence[Mapping], backbone: str) -> dict[str, CaseFeatures]:
    """Case -> the features that its rows, of a seed each, have left."""
    seeds: dict[str, list[StoredFeatures]] = {}
    for row in rows:
        seeds.setdefault(row["case"], []).append(StoredFeatures(features_file(out, row["key"]), backbone))
    return {case: SeedFeatures(of) if len(of) > 1 else of[0] for case, of in seeds.items()}
