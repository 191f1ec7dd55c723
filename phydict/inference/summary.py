"""What a run ends with: the tables of its finished cases, their page, and the names of those that have failed."""

from __future__ import annotations

from collections.abc import Collection
from contextlib import suppress

from rich.console import Console

from phydict.evaluation import Table
from phydict.evaluation.fid import StoredFeatures
from phydict.evaluation.tables import fid_tables
from phydict.inference.distances import distance_rows
from phydict.inference.page import results_page
from phydict.inference.protocols import Protocol
from phydict.inference.results import FEATURES, CaseResults
from phydict.inference.scoring import Scoring


def summarise(results: CaseResults, cases: list[str], name: str, scoring: Scoring, protocol: Protocol | None) -> None:
    """Prints and writes the scores of a run's cases by a method of this name. Raises ValueError, naming them, where
    some have failed."""
    missing = results.missing()
    finished = [case for case in cases if case not in missing]
    console = Console()
    console.width = max(console.width, 80 if console.is_terminal else 120)
    further = _distances(results, finished, name, scoring)
    for table in results.summarise(finished, further, protocol, scoring.empty):
        console.print(table)
    print(f"results in {results.folder}")
    if finished:
        print(f"page: {results_page(results.folder.parent, further, scoring.empty)}")
    if missing:
        raise ValueError(f"{len(missing)} of {len(cases)} cases were not reconstructed "
                         f"({', '.join(missing)}): see the messages above, and {results.to_resume}")


def show_finished(results: CaseResults, cases: Collection[str], scoring: Scoring) -> None:
    """Writes the page where some of a stopped run's cases are finished, without the Frechet distances of slices, which
    take long, and prints where it is."""
    with suppress(ValueError, OSError):  # what stopped the run is the error to show
        if len(results.missing()) < len(cases):
            print(f"page: {results_page(results.folder.parent, (), scoring.empty)}")


def _distances(results: CaseResults, cases: list[str], name: str, scoring: Scoring) -> list[Table]:
    """The table of Frechet distances over finished cases, where they are measured."""
    if scoring.network is None or not cases:
        return []
    features = {case: StoredFeatures(results.folder / case / FEATURES, scoring.fid.backbone) for case in cases}
    return fid_tables(distance_rows({name: features}, scoring.fid))
