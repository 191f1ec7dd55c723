"""Is real prose understood? How well what a prior draws for real reports tells labelled from unlabelled ones.

    python tests/benchmark/report_labels.py <folder with csv tables> [prior.safetensors ...] [--only val.csv]

Without a prior, the shipped one. A table has a row per report, its text in a column of REPORT_COLUMNS, and labels of 0
and 1 in columns of LABELS, as CT-RATE's; denials are part of the texts. A report's score for a label is the mean of
what the map of kinds draws for it. Nothing is trained. Writes report_labels.csv beside this file: the area under the
ROC curve, and its interval of 95 % over 2,000 bootstrap samples of the reports. Figures alone, no text.
"""

import argparse
import csv
import sys
from pathlib import Path

import numpy as np
import scipy
import torch

import phydict
from phydict.datasets import format_report
from phydict.evaluation import write_csv
from phydict.prior import DEFAULT_PRIOR, Prior

LABELS = {"Pleural effusion": "effusion", "Consolidation": "consolidation", "Lung opacity": "opacity",
          "Lung nodule": "nodule", "Emphysema": "emphysema", "Cardiomegaly": "cardiomegaly",
          "Pericardial effusion": "pericardial effusion", "Atelectasis": "atelectasis"}
"""The labels that phantoms know, and their kinds."""

REPORT_COLUMNS = ("report_text", "Findings_EN", "Impressions_EN")
SAMPLES = 2000


def roc_area(scores: np.ndarray, labels: np.ndarray) -> float:
    """The share of pairs of a labelled and an unlabelled report whose scores lie in that order, ties counted half."""
    ranks, positive = scipy.stats.rankdata(scores), labels.sum()
    return float((ranks[labels].sum() - positive * (positive + 1) / 2) / (positive * (~labels).sum()))


def interval(scores: list[np.ndarray], labels: list[np.ndarray]) -> tuple[float, float]:
    """The 95 % bootstrap interval of the mean area of some labels, over samples of the reports."""
    draw, areas = np.random.default_rng(0), []
    while len(areas) < SAMPLES:
        picked = draw.integers(len(labels[0]), size=len(labels[0]))
        if all(0 < own[picked].sum() < len(picked) for own in labels):
            areas.append(np.mean([roc_area(s[picked], own[picked]) for s, own in zip(scores, labels)]))
    return tuple(np.quantile(areas, [0.025, 0.975]))


def read_reports(table: Path) -> tuple[list[str], dict[str, np.ndarray]]:
    """Reports, and for each of the LABELS that a table has, which reports it is given to."""
    csv.field_size_limit(2**30)
    with table.open(encoding="utf-8-sig", newline="") as lines:
        rows = list(csv.DictReader(lines))
    reports = [format_report(" ".join(row[c] for c in REPORT_COLUMNS if row.get(c))) for row in rows]
    labels = {name: np.array([float(row[name]) > 0 for row in rows]) for name in LABELS if rows and name in rows[0]}
    return reports, {name: own for name, own in labels.items() if 0 < own.sum() < len(own)}


@torch.no_grad()
def drawn(prior: Prior, reports: list[str]) -> np.ndarray:
    """How much of each kind a prior draws for reports (N, kinds)."""
    kinds = prior.network.text_map
    return torch.cat([kinds(prior.context([report])).mean((2, 3, 4)) for report in reports]).numpy()


def measured(file: Path, table: Path) -> list[dict]:
    """A row for each label, and one for their mean."""
    prior, (reports, labels) = phydict.load_prior(file), read_reports(table)
    if not hasattr(prior.network.text_map, "kinds"):
        sys.exit(f"{file} draws no kinds of findings: give a prior whose text was taught by this version, or renewed")
    if not labels:
        sys.exit(f"{table} has no label of {', '.join(LABELS)} that some reports have and others lack")
    scores = drawn(prior, reports)
    scores = {name: scores[:, prior.network.text_map.kinds.index(LABELS[name])] for name in labels}
    rows = []
    for name in (*labels, "mean"):
        names = list(labels) if name == "mean" else [name]
        low, high = interval([scores[n] for n in names], [labels[n] for n in names])
        area = np.mean([roc_area(scores[n], labels[n]) for n in names])
        rows.append({"prior": file.stem, "table": table.stem, "label": name, "reports": len(reports),
                     "labelled": "" if name == "mean" else int(labels[name].sum()),
                     "roc_area": round(float(area), 4), "low": round(float(low), 4), "high": round(float(high), 4)})
    return rows


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("tables", type=Path, help="a folder with CSV tables of labelled reports")
    parser.add_argument("priors", nargs="*", type=Path, default=[DEFAULT_PRIOR])
    parser.add_argument("--only", help="one table of the folder")
    parser.add_argument("--out", type=Path, default=Path(__file__).with_suffix(".csv"))
    given = parser.parse_args()
    tables = sorted(given.tables.glob(given.only or "*.csv"))
    if not tables:
        sys.exit(f"there is no table {given.only or '*.csv'} in {given.tables}: give a folder with CSV tables")
    rows = [row for file in given.priors for table in tables for row in measured(file, table)]
    write_csv(given.out, rows)
    for row in rows:
        print(f"{row['prior']}, {row['table']}, {row['label']:22s} {row['roc_area']:.3f} "
              f"[{row['low']:.3f}, {row['high']:.3f}]")
