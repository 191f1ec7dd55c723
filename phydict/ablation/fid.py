"""Tables of the Frechet distance of slices, made of the features that the rows of a comparison have left."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from phydict.ablation.run import features_file
from phydict.ablation.summary import Entry, conditions, format_settings
from phydict.datasets import patient_of
from phydict.evaluation.fid import load_features
from phydict.evaluation.tables import Table, fid_table
from phydict.inference.scoring import Scoring


def fid_tables(out: Path, entries: Sequence[Entry], scoring: Scoring) -> list[Table]:
    """A table for each condition, with a line per entry; none where the distance is not measured.

    Of several seeds of a case each counts as a case of the same patient.
    """
    if scoring.network is None:
        return []
    tables, backbone = [], scoring.fid.backbone
    for condition, group in conditions(entries):
        features = {entry.label: {name: load_features(features_file(out, key), backbone)
                                  for name, key in _named(entry.rows)} for entry in group if entry.rows}
        if features:
            tables.append(fid_table(features, backbone, scoring.fid.replicates,
                                    format_settings("Frechet distance of slices (FID)", condition)))
    return tables


def _named(rows: Sequence[tuple[str, str]]) -> list[tuple[str, str]]:
    """A name for each row of a case and a key, of the case's patient (`patient_of`), and the key."""
    repeats = [sum(other == case for other, _ in rows[:i]) for i, (case, _) in enumerate(rows)]
    return [(f"{patient_of(case)}__{case}__{n}" if n else case, key) for (case, key), n in zip(rows, repeats)]
