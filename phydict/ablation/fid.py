"""Tables and a CSV of the Frechet distance of slices, made of the features that a comparison's rows have left."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

from phydict.ablation.run import features_file
from phydict.ablation.summary import Entry, conditions, format_settings
from phydict.datasets import patient_of
from phydict.evaluation import read_csv, write_csv
from phydict.evaluation.backbones import NORMALISATION
from phydict.evaluation.bootstrap import Estimate
from phydict.evaluation.fid import Distances, StoredFeatures
from phydict.evaluation.tables import Table, fid_tables
from phydict.inference.distances import told_distances
from phydict.inference.scoring import FIDSettings, Scoring

FID = "fid.csv"
"""The distances in a folder of results."""


def comparison_tables(out: Path, entries: Sequence[Entry], scoring: Scoring) -> list[Table]:
    """The tables of each condition, with a line per entry, and FID with the same numbers; none where the distance is
    not measured."""
    if scoring.network is None:
        return []
    tables, rows = _tables(out, entries, scoring.fid.backbone, scoring.fid.replicates)
    write_csv(out / FID, rows)
    return tables


def kept_tables(out: Path, entries: Sequence[Entry]) -> list[Table]:
    """The same tables, of a comparison that measured the distance and whose features lie there still; otherwise
    none."""
    measured = read_csv(out / FID)
    rows = [row for entry in entries for row in entry.counted]
    if not measured or not all(features_file(out, row["key"]).is_file() for row in rows):
        return []
    return _tables(out, entries, measured[0]["fid_backbone"],
                   int(measured[0].get("replicates", FIDSettings().replicates)))[0]


def _tables(out: Path, entries: Sequence[Entry], backbone: str, replicates: int) -> tuple[list[Table], list[dict]]:
    """The tables, and the rows of FID, of what has its features there. Of several seeds of a case each counts as a case
    of the same patient."""
    tables: list[Table] = []
    rows: list[dict] = []
    for condition, group in conditions(entries):
        there = {entry.label: [row for row in entry.counted if features_file(out, row["key"]).is_file()]
                 for entry in group}
        features = {label: {name: StoredFeatures(features_file(out, key), backbone) for name, key in _named(kept)}
                    for label, kept in there.items() if kept}
        if features:
            found = told_distances(features, replicates)
            title = format_settings("Frechet distance of slices (FID)", condition)
            tables += fid_tables(found, backbone, replicates, title)
            rows += [{"method": label} | condition | _origin(one, backbone, replicates) | _numbers(one.estimates())
                     for label, one in found.items()]
    return tables, rows


def _origin(found: Distances, backbone: str, replicates: int) -> dict:
    """What distances rest on; the truth has as many slices as the reconstructions, of the same cases."""
    return {"fid_backbone": backbone, "fid_normalisation": NORMALISATION, "replicates": replicates,
            "cases": len(found.cases)} | {f"{of}slices_{plane}": count for of in ("", "truth_")
                                          for plane, count in found.slices.items()}


def _numbers(estimates: Mapping[str, Estimate]) -> dict[str, float]:
    """Each distance, and the ends of its interval where it has one."""
    return {f"{name}{end}": number for name, estimate in estimates.items()
            for end, number in zip(("", "_low", "_high"), estimate) if not math.isnan(number)}


def _named(rows: Sequence[Mapping]) -> list[tuple[str, str]]:
    """A name for each row of a case, of the case's patient (`patient_of`), and the row's key."""
    cases = [row["case"] for row in rows]
    repeats = [cases[:i].count(case) for i, case in enumerate(cases)]
    return [(f"{patient_of(case)}__{case}__{n}" if n else case, row["key"])
            for case, n, row in zip(cases, repeats, rows)]
