"""From rows of results to what tables and plots show: conditions, settings of methods, and means over cases."""

from __future__ import annotations

import json
import math
import re
from ast import literal_eval
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from phydict.ablation.nested import field_of, has_field, plain
from phydict.ablation.results import IDENTIFYING, is_measured
from phydict.ablation.trials import DEFAULTS, PRECISION, SIDE, SIMULATORS, settings_of
from phydict.evaluation.bootstrap import Estimate, estimate
from phydict.evaluation.metrics import MEASURES, Measure, case_values
from phydict.grid import Box, Grid
from phydict.inference.conditions import format_settings, simulated, simulated_on, told_apart, xrays_note
from phydict.inference.protocols import protocol_of
from phydict.inference.settings import Orbit
from phydict.reconstruction import describe
from phydict.xray import Ideal, Simulator

SHOWN_MEASURES = MEASURES | {"network_calls": Measure("network calls", None, 0),
                             "projector_calls": Measure("projector calls", None, 0),
                             "peak_memory_mb": Measure("peak memory (MiB)", False, 0)}
"""How the columns of results are printed."""

SCORES = MEASURES.keys() - {"seconds"}
"""The measures of how good a volume is, whose means have intervals."""

NON_SETTING_COLUMNS = (*IDENTIFYING, "case", "namesake", "key", "seed", "grid", "training")
"""Columns beside the measured ones that are no settings."""

SCORED = ("grid", "window")
"""What volumes were scored on, which parts rows that no setting of the X-rays parts."""

METHOD_SETTINGS = (*settings_of("method", "prior"), PRECISION)
"""Settings of the method, as method.<field> are; the others are of the X-rays."""

XRAY_SETTINGS = settings_of("orbit", "X-rays")
"""Settings of simulated X-rays beside the simulator's own, which `xrays` tells."""

BOX_SETTINGS = settings_of("box")
"""Settings of the voxels of the result, which are the method's where a protocol has voxels of its own to score on."""


@dataclass(frozen=True)
class Entry:
    """The mean over cases of one method's settings under one condition.

    settings: those that differ among the method's entries, beside its name; values: measure -> {case: value}, the
    seeds of a case averaged, of those cases that have it with each seed, and of what is no score only where all have
    it; cases, of: how many cases it has, with all of their seeds, and how many it was to have; rows: of results; error:
    why one of them does not count.
    """

    method: str
    settings: dict
    condition: dict
    values: dict[str, dict[str, float]]
    cases: int
    of: int
    rows: Sequence[Mapping]
    error: str | None = None

    @property
    def counted(self) -> list[Mapping]:
        """The rows that its values are of."""
        return _of_whole_cases(self.rows)

    @property
    def case_ids(self) -> frozenset[str]:
        """The cases that its values are of."""
        return frozenset(str(row["case"]) for row in self.counted)

    @cached_property
    def means(self) -> dict[str, float]:
        """Measure -> mean over cases."""
        return {name: float(np.mean(list(values.values()))) for name, values in self.values.items()}

    def estimate(self, name: str) -> float | Estimate | None:
        """The mean of a measure, of a score of several patients with its interval; None where it was not measured."""
        interval = estimate(self.values[name]) if name in SCORES & self.values.keys() else None
        return self.means.get(name) if interval is None or math.isnan(interval.low) else interval

    @property
    def complete(self) -> bool:
        return 0 < self.cases == self.of

    @property
    def name(self) -> str:
        """The method with its settings."""
        return format_settings(self.method, self.settings)

    @property
    def lacking(self) -> str:
        """How many cases it has, where some are missing."""
        return f" ({self.cases} of {self.of} cases)" if 0 < self.cases < self.of else ""

    @property
    def label(self) -> str:
        """The method with its settings, and how many cases it has where some are missing."""
        return self.name + self.lacking


def summarise(rows: Iterable[Mapping]) -> list[Entry]:
    """One entry per method, settings and condition, in the order of the rows.

    The condition of an entry is what differs among the rows' X-rays, a setting that is not given taken for its default,
    and, among rows of equal X-rays, of what they were scored on. Rows of a case of other data are another case's.
    """
    parts = [(row, *_parted(row)) for row in told_apart(rows, lambda row: row.get("data"))]
    apart = _conditions([(row, xrays) for row, _, xrays in parts])
    changed = {method: _varying([settings for _, settings, _ in parts if settings["method"] == method])
               for method in dict.fromkeys(row["method"] for row, _, _ in parts)}
    groups: dict[tuple, list] = {}
    for (row, settings, _), condition in zip(parts, apart):
        of_method = changed[row["method"]]
        place = (row["method"], *(settings.get(name) for name in of_method), *condition.items())
        groups.setdefault(place, []).append((row, {name: settings[name] for name in of_method if name in settings},
                                             condition))
    return [_entry([row for row, _, _ in group], *group[0][1:]) for group in groups.values()]


def without_repeats(rows: Iterable[Mapping]) -> list[Mapping]:
    """The first of those rows of a case that have the same method, settings and seed: `ablate` writes the rows of other
    weights or data, which it keeps, behind its own. Older rows that do not tell their HU window are of any."""
    kept: dict[frozenset, dict[object, Mapping]] = {}
    for row in rows:
        windows = kept.setdefault(frozenset((name, value) for name, value in row.items() if not (
            is_measured(name) or name in (*IDENTIFYING, "key", "training"))), {})
        if not windows or (row.get("window") is not None and None not in windows):
            windows.setdefault(row.get("window"), row)
    return [row for windows in kept.values() for row in windows.values()]


def _conditions(rows: Sequence[tuple[Mapping, Mapping]]) -> list[dict]:
    """Each row's condition: the settings that tell it from rows of other conditions. A setting that no row of the same
    condition states is left out. rows: with the settings of their X-rays."""
    names = dict.fromkeys(name for _, given in rows for name, value in given.items() if value is not None)
    meant = [_meant(row, given, names) for row, given in rows]
    varying = [name for name in names if len({meaning.get(name) for meaning in meant}) > 1]
    places = [tuple(meaning.get(name) for name in varying) for meaning in meant]
    told: dict[tuple, set[str]] = {}
    for place, (_, given) in zip(places, rows):
        told.setdefault(place, set()).update(name for name in varying if given.get(name) is not None)
    found = [{name: meaning[name] for name in varying if name in told[place] and name in meaning}
             for place, meaning in zip(places, meant)]
    for column in SCORED:
        values: dict[tuple, set] = {}
        for (row, _), condition in zip(rows, found):
            values.setdefault(tuple(condition.items()), set()).add(row.get(column))
        if any(len(of - {None}) > 1 for of in values.values()):
            found = [condition | ({} if row.get(column) is None else {column: row[column]})
                     for (row, _), condition in zip(rows, found)]
    return found


def _meant(row: Mapping, given: Mapping, names: Iterable[str]) -> dict:
    """The settings `names` of a row's X-rays, those that it does not give at their defaults."""
    simulator, orbit = _made(row)
    defaults = {name: value for name, value in DEFAULTS.items() if name not in settings_of("orbit")}
    if orbit is not None:
        defaults |= {name: value[0] if isinstance(value, list | tuple) else value
                     for name, value in orbit.settings().items()}
    if cube := re.fullmatch(r"(\d+)x\1x\1", str(row.get("grid"))):  # the method's own, over the usual length
        defaults["voxels"] = int(cube[1])
    meant = {}
    for name in names:
        part, _, path = name.partition(".")
        if (value := given.get(name)) is None:
            is_field = part == "simulator" and path and has_field(simulator, path.split("."))
            value = plain(field_of(simulator, path.split("."))) if is_field else defaults.get(name)
        if value is not None:
            meant[name] = value if type(value) in (int, float) else str(value)  # as a CSV holds it
    return meant


def conditions(entries: Sequence[Entry], without: Sequence[str] = ()) -> list[tuple[dict, list[Entry]]]:
    """The entries under each condition, or under what is left of it `without` some of its parts."""
    groups: dict[tuple, list] = {}
    for entry in entries:
        groups.setdefault(tuple((k, v) for k, v in entry.condition.items() if k not in without), []).append(entry)
    return [(dict(condition), group) for condition, group in groups.items()]


def compared_views(entries: Sequence[Entry]) -> list[tuple[dict, list[Entry]]]:
    """The entries under each other condition that has several numbers of views."""
    return _along(entries, "views", ("views",))


def compared_geometries(entries: Sequence[Entry]) -> list[tuple[dict, list[Entry]]]:
    """The entries under each other condition that has several geometry files, which fix views and detector."""
    return _along(entries, "geometry", ("geometry", "views", "detector"))


def _along(entries: Sequence[Entry], axis: str, without: Sequence[str]) -> list[tuple[dict, list[Entry]]]:
    groups = conditions([entry for entry in entries if entry.condition.get(axis) is not None], without)
    return [(rest, group) for rest, group in groups if len({entry.condition[axis] for entry in group}) > 1]


def alike(entries: Sequence[Entry]) -> list[Entry]:
    """The entries that are compared in marks and plots: those with all of their cases. Where none has all, as when a CT
    cannot be read, those of one set of cases: the largest, and of equal ones the most frequent."""
    if complete := [entry for entry in entries if entry.complete]:
        return complete
    sets = Counter(entry.case_ids for entry in entries if entry.cases)
    most = max(sets, key=lambda cases: (len(cases), sets[cases]), default=None)
    return [entry for entry in entries if entry.case_ids == most]


def best_settings(entries: Sequence[Entry]) -> list[Entry]:
    """Of each method the entry with the highest mean PSNR, those that are `alike` first."""
    best: dict[str, Entry] = {}
    rank = ranking(entries)
    for entry in entries:
        other = best.get(entry.method)
        if other is None or rank(entry) > rank(other):
            best[entry.method] = entry
    return list(best.values())


def ranking(entries: Sequence[Entry]) -> Callable[[Entry], tuple[bool, float]]:
    """What orders entries by their mean PSNR, those that are `alike` above others."""
    among = set(map(id, alike(entries)))
    return lambda entry: (id(entry) in among, entry.means.get("psnr", -math.inf))


def deltas(entries: Sequence[Entry]) -> list[tuple[str, list[Entry]]]:
    """What has a curve over Extra Compute's delta: a label, and its entries from delta 0 up."""
    groups: dict[str, list] = {}
    for entry in entries:
        if entry.settings.get("delta") is not None:  # none given is the method's own
            others = {name: value for name, value in entry.settings.items() if name != "delta"}
            groups.setdefault(format_settings(entry.method, others, entry.condition), []).append(entry)
    return [(label, sorted(group, key=lambda entry: entry.settings["delta"])) for label, group in groups.items()]


def fixed_settings(entries: Sequence[Entry]) -> str:
    """The settings that all rows of entries share, in words, without those of the X-rays, defaults, and what an entry's
    name or condition already says."""
    settings = [xrays | own for entry in entries for own, xrays in map(_parted, entry.rows)]
    told = {"method", *XRAY_SETTINGS, *_varying(settings)}.union(
        *(entry.settings.keys() | entry.condition.keys() for entry in entries))
    return format_settings({name: value for name, value in settings[0].items() if name not in told
                            and not name.startswith("simulator.") and value is not None
                            and str(value) != str(DEFAULTS.get(name))})


def xrays(entries: Sequence[Entry]) -> str:
    """How the X-rays of entries' rows were made, what differs among the rows left out."""
    distinct = {repr(_settings(row)): row for entry in entries for row in entry.rows}  # those of many cases and seeds
    first, *others = [_simulated(row) | {"places": _places(row)} for row in distinct.values()]
    shared = {name: value for name, value in first.items() if all(other.get(name) == value for other in others)}
    return xrays_note(shared, shared.pop("places", None)) + "."


def _simulated(row: Mapping) -> dict:
    """The settings of a row's X-rays, as a record of `test` names them."""
    simulator, orbit = _made(row)
    settings = {"views": row["views"], "geometry": row["geometry"]} if orbit is None else orbit.settings()
    fields = {name.removeprefix("simulator."): value for name, value in row.items() if name.startswith("simulator.")}
    return simulated(json.loads(json.dumps(settings | {"simulator": describe(simulator) | fields})))


def _made(row: Mapping) -> tuple[Simulator, Orbit | None]:
    """What a row's X-rays were made by, the simulator's own settings left out, and their orbit, None where a geometry
    file gives it."""
    given = {name: default if row.get(name) is None else row[name] for name, default in DEFAULTS.items()}
    if given["protocol"]:
        protocol = protocol_of(given["protocol"])
        return Ideal(noise=protocol.noise), Orbit(given["views"]).filled(protocol.orbit)
    if given["geometry"]:
        return SIMULATORS[given["simulator"]], None
    pixel = given["pixel"] or SIDE / given["detector"]
    return SIMULATORS[given["simulator"]], Orbit(given["views"], given["source_to_detector"], given[
        "source_to_isocentre"], (given["detector"],) * 2, (pixel,) * 2)


def _places(row: Mapping) -> str:
    """Of what voxels a row's X-rays were made."""
    box: Grid | None = None
    if row.get("voxels") is not None:
        given = {name: literal_eval(str(row[name])) for name in BOX_SETTINGS if row.get(name) is not None}
        box = Box(**given).grid()
    return simulated_on(row.get("simulation_voxels"), row.get("protocol"), box)


def _settings(row: Mapping) -> dict:
    """All settings of a row."""
    return {name: value for name, value in row.items() if not is_measured(name) and name not in NON_SETTING_COLUMNS}


def _parted(row: Mapping) -> tuple[dict, dict]:
    """The settings of a row that are its method's, and those of its X-rays."""
    protocol = row.get("protocol")
    own = METHOD_SETTINGS + (BOX_SETTINGS if protocol is not None and protocol_of(protocol).grid else ())
    settings = _settings(row)
    of_method = {name for name in settings if name in own or name.startswith("method.")}
    return ({name: value for name, value in settings.items() if name in of_method},
            {name: value for name, value in settings.items() if name not in of_method})


def _of_whole_cases(rows: Sequence[Mapping]) -> list[Mapping]:
    """The rows of those cases of which each seed is ok."""
    lacking = {row["case"] for row in rows if row["status"] != "ok"}
    return [row for row in rows if row["case"] not in lacking]


def _entry(rows: Sequence[Mapping], settings: dict, condition: dict) -> Entry:
    good = _of_whole_cases(rows)
    cases = len({row["case"] for row in good})
    stages = {name for row in good for name in row if name.startswith("seconds_")}
    values = {name: scores for name in [*SHOWN_MEASURES, *stages]
              if (scores := case_values(good, name)) and (name in SCORES or len(scores) == cases)}
    error = next((f"{row['status']}: {row['error']}" for row in rows if row["status"] != "ok"), None)
    return Entry(rows[0]["method"], settings, condition, values, cases, len({row["case"] for row in rows}), rows, error)


def _varying(settings: Sequence[Mapping]) -> list[str]:
    """The names whose values differ."""
    names = dict.fromkeys(name for given in settings for name in given)
    return [name for name in names if len({given.get(name) for given in settings}) > 1]
