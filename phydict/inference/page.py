"""The page of finished cases: made of what lies on disk, so that it can be made anew at any time."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType

from phydict.evaluation.fid import StoredFeatures
from phydict.evaluation.tables import FID_TITLE, Table, fid_tables
from phydict.inference.case_files import missing_page_files, remake_page_files
from phydict.inference.conditions import condition, condition_titles, format_settings, namesakes, told_apart
from phydict.inference.distances import distance_rows
from phydict.inference.protocols import protocol_of
from phydict.inference.results import FEATURES, MEANS, RECORD, RESULTS, score_row, score_table
from phydict.inference.scoring import FIDSettings
from phydict.page import Contents, PageCase, check_own_page, write_page
from phydict.runtime.files import in_between
from phydict.runtime.progress import CaseProgress
from phydict.runtime.warning import warn


def results_page(folder: Path, further: Sequence[Table] | None = None,
                 empty: Mapping[str, str] = MappingProxyType({}), note: str = "") -> Path:
    """Writes the page of a folder's finished cases, one method's or several methods' in a folder each; returns its
    path. What the page needs of a case and older results lack is made of their NIfTI files.

    further: tables behind that of the means; if left out, those of the Frechet distances of slices whose features lie
    in the cases' folders. empty: scores that may stay empty -> why. note: what is said beneath the means.
    Raises ValueError where there is no finished case, or where a page of someone else's is in its place.
    """
    check_own_page(folder, "folder")
    cases = _cases(folder)
    if not cases:
        raise ValueError(f"{folder} holds no results: give the folder that predict, test or ablate wrote to, which "
                         f"holds <case>/{RECORD}, <method>/<case>/{RECORD} or ablate's {RESULTS}")
    if further is None:
        further = _kept_distances(folder, cases)
    scored = [case.record for case in cases if case.record["scores"]]
    error = "mae_hu" if any("mae_hu" in record["scores"] for record in scored) else "misfit"
    titles = condition_titles([case.record for case in cases])
    points = [{"name": f"{case.record['case']}, {case.record['method']}",
               "series": _joined(case.record["method"], titles[_condition(case.record)]),
               "seconds": sum(case.record["seconds"].values()),
               "error": case.record["misfit"] if error == "misfit" else (case.record["scores"] or {}).get(error)}
              for case in cases]
    means = _mean_tables(scored, empty)
    if note and means:
        means[-1] = replace(means[-1], notes=[*means[-1].notes, note])
    tables = sorted({path.relative_to(folder).as_posix() for depth in ("", "*/") for name in (RESULTS, MEANS)
                     for path in folder.glob(depth + name)})
    return write_page(folder, Contents(f"Results in {folder.resolve().name}",
                                       [*means, *further], cases, points, error, links=tables, unranked=("seconds",)))


def _case_folders(folder: Path) -> list[Path]:
    """The folders of finished cases, those that are just being written, or lie in a hidden one, left out."""
    folders = {path.parent for depth in ("*", "*/*") for path in folder.glob(f"{depth}/{RECORD}")}
    return sorted(path for path in folders if not in_between(path.name) and (
        path.parent == folder or path.parent.name[:1] != "."))


def _cases(folder: Path) -> list[PageCase]:
    """The finished cases; files of the page that they lack are made, with progress."""
    paths, cases = _case_folders(folder), []
    lacking = {path for path in paths if missing_page_files(path)}
    with CaseProgress() as progress:
        if lacking:
            progress.begin("page", len(lacking), verb="prepare", out=folder)
        for path in paths:
            if path in lacking:
                progress.case(path.relative_to(folder).as_posix())
            if case := _case(folder, path):
                cases.append(case)
            if path in lacking:
                progress.finished("prepared" if case else "left out")
    return cases


def _case(folder: Path, path: Path) -> PageCase | None:
    """A finished case, None, with a warning, where its files are damaged. Behind the case and the method stand the
    names of their folders where these are others, as a copy's are."""
    try:
        record = json.loads((path / RECORD).read_text())
        score_row(record["case"], record | {"scores": record["scores"] or {}})
        float(record["misfit"] or 0), list(record["misfit_per_view"])
        group = json.dumps([record["case"], _data(record), _condition(record)])
        remake_page_files(path)
    except Exception as error:  # whatever a damaged record or volume leads to
        warn(f"{path} is left out of the page, since its files are damaged ({type(error).__name__}: {error})")
        return None
    if path.parent != folder and (given := path.parent.name) != record["method"]:
        record["method"] += f" ({given})"
    if path.name != record["case"]:
        record["case"] += f" ({path.name})"
    return PageCase(path.relative_to(folder).as_posix(), sorted(os.listdir(path)), record, group)


def _condition(record: Mapping) -> str:
    """What a case's scores are compared under, in words."""
    return format_settings(condition(record))


def _data(record: Mapping) -> tuple:
    """What a case of a name was measured on: its source, and the seed of the noise of its X-rays."""
    return record.get("source"), record.get("settings", {}).get("seed")


def _joined(*parts: str) -> str:
    return ", ".join(filter(None, parts))


def _mean_tables(scored: Sequence[Mapping], empty: Mapping[str, str]) -> list[Table]:
    """The means over scored cases by method, a table for each condition; cases of one name that are of other data or
    seeds are cases of their own."""
    groups: dict[str, list] = {}
    for record in scored:
        groups.setdefault(_condition(record), []).append(record)
    titles, tables = condition_titles(scored), []
    for words, of in groups.items():
        records = told_apart(of, _data)
        protocol = condition(records[0])["protocol"]
        table = score_table(records, protocol_of(protocol) if protocol else None, empty)
        tables += _noted([replace(table, title=_joined(table.title, titles[words]))], records)
    return tables


def _noted(tables: Sequence[Table], records: Sequence[Mapping]) -> list[Table]:
    """Tables of some cases, the last notes naming methods whose cases are of several settings, but for the seed, and
    cases of one name that are not compared."""
    settings: dict[str, set[str]] = {}
    for record in records:
        kind = json.dumps(record.get("settings", {}) | {"seed": None}, sort_keys=True)
        settings.setdefault(record["method"], set()).add(kind)
    several = ", ".join(method for method, kinds in settings.items() if len(kinds) > 1)
    note = [f"Cases of several settings, as their records tell, in one line: {several}."] if several else []
    if apart := namesakes(records):
        note.append(f"Of other data or another seed under one name, and so neither ranked nor paired: {apart}.")
    return [replace(table, notes=[*table.notes, *note]) for table in tables]


def _kept_distances(folder: Path, cases: Sequence[PageCase]) -> list[Table]:
    """The tables of Frechet distances that features in the cases' folders give, a line per method; those of other
    weights and of each condition are tables of their own."""
    found: dict[tuple, list[StoredFeatures]] = {}
    records: dict[tuple, list[Mapping]] = {}
    for case in cases:
        settings, file = case.record.get("settings", {}), folder / case.folder / FEATURES
        if (backbone := settings.get("fid_backbone")) and file.is_file():
            try:
                features = StoredFeatures(file, backbone)
            except ValueError as error:
                warn(f"a case is left out of the Frechet distances: {error}")
                continue
            fid = FIDSettings(backbone, maisi_voxels=settings.get("fid_maisi_voxels", False))
            measured = fid, settings.get("fid_weights_crc32"), _condition(case.record)
            found.setdefault(measured, []).append(features)
            records.setdefault(measured, []).append(case.record)
    titles = condition_titles([record for of in records.values() for record in of])
    tables: list[Table] = []
    for measured, kept in found.items():
        methods: dict[str, dict[str, StoredFeatures]] = {}
        for record, features in zip(of := told_apart(records[measured], _data), kept):
            methods.setdefault(record["method"], {})[record["case"]] = features
        tables += _noted(fid_tables(distance_rows(methods, measured[0]), _joined(FID_TITLE, titles[measured[-1]])), of)
    return tables
