"""What a run ends with: the tables of its finished cases, their page, and the names of those that have failed."""

from __future__ import annotations

from collections.abc import Collection
from contextlib import suppress
from pathlib import Path

from rich.console import Console

from phydict.evaluation import Table
from phydict.evaluation.fid import StoredFeatures
from phydict.evaluation.tables import fid_tables
from phydict.inference.distances import distance_rows
from phydict.inference.page import results_page
from phydict.inference.protocols import Protocol
from phydict.inference.results import FEATURES, MEANS, RESULTS, CaseResults
from phydict.inference.scoring import Scoring
from phydict.runtime.progress_log import log_progress


def summarise(results: CaseResults, cases: list[str], name: str, scoring: Scoring, protocol: Protocol | None) -> None:
    """Prints and writes the scores of a run's cases by a method of this name. Raises ValueError, naming them, where
    some have failed."""
    missing = results.missing()
    finished = [case for case in cases if case not in missing]
    further = _distances(results, finished, name, scoring)
    tables, page = results.summarise(finished, further, protocol, scoring.empty, missing), None
    if finished:
        shared = any(file.parents[1] != results.folder for file in _features(results))
        page = results_page(results.folder.parent, None if shared else further, scoring.empty)
    console = Console()  # all is written before: whoever reads this may have read enough
    console.width = max(console.width, 80 if console.is_terminal else 120)
    for table in tables:
        console.print(table)
    if tables and (others := results.beside(cases)):
        log_progress(f"{RESULTS} and {MEANS} hold this run's cases, and {others} more that are finished in "
                     f"{results.folder} are left out: name all in one run, which keeps what is finished",
                     event="left_out", cases=others, out=str(results.folder))
    print(f"results in {results.folder}")
    if page:
        print(f"page: {page}")
    if missing:
        raise ValueError(f"{len(missing)} of {len(cases)} cases were not reconstructed "
                         f"({', '.join(missing)}): see the messages above, and {results.to_resume}")


def show_finished(results: CaseResults, cases: Collection[str], scoring: Scoring) -> None:
    """Writes the page where some of a stopped run's cases are finished, without the Frechet distances of slices, which
    take long, and prints where it is."""
    with suppress(ValueError, OSError):  # what stopped the run is the error to show
        if len(results.missing()) < len(cases):
            note = "The Frechet distances of slices are shown by: infer.py page <folder>." if _features(results) else ""
            print(f"page: {results_page(results.folder.parent, (), scoring.empty, note)}")


def _features(results: CaseResults) -> list[Path]:
    """The features of slices of finished cases, those by other methods in the same model.out included."""
    return list(results.folder.parent.glob(f"[!.]*/[!.]*/{FEATURES}"))


def _distances(results: CaseResults, cases: list[str], name: str, scoring: Scoring) -> list[Table]:
    """The table of Frechet distances over finished cases, where they are measured."""
    if scoring.network is None or not cases:
        return []
    features = {case: StoredFeatures(results.folder / case / FEATURES, scoring.fid.backbone) for case in cases}
    return fid_tables(distance_rows({name: features}, scoring.fid))
