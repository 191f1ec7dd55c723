"""Under what conditions results were taken, in words: only those of equal X-rays and voxels are ranked together."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping, Sequence

from phydict.datasets.cts.ct_rate import patient_of
from phydict.grid import Grid
from phydict.inference.protocols import protocol_of
from phydict.inference.settings import PAPER
from phydict.inference.voxels import whole

PAPER_ORBIT = json.loads(json.dumps(PAPER.settings()))
"""The orbit of X-rays whose geometry is not named, as records hold it."""


def format_settings(*parts: str | Mapping) -> str:
    """Names, and settings in words, behind each other: "K = 8, iterations 50"."""
    return ", ".join(text for part in parts for text in (
        [part] if isinstance(part, str) else [_format_setting(*setting) for setting in part.items()]))


def _format_setting(name: str, value: object) -> str:
    if name == "simulator":
        return str(value)
    words = name.split(".", 1)[-1].replace("_", " ")
    if value is None:
        return f"no {words}"
    if isinstance(value, list):
        value = " x ".join(f"{part:g}" for part in value)
    value = f"{value:g}" if isinstance(value, float) else value
    return f"K = {value}" if name == "views" else f"{words} {value}"


def xrays_note(settings: Mapping, places: str | None) -> str:
    """How X-rays were made: settings in words, and of what voxels, where that is told."""
    shown = {name: value for name, value in settings.items()
             if name not in ("code_crc32", "simulation_voxels") and not isinstance(value, Mapping)}
    return f"X-rays: {format_settings(shown)}{f'; made on {places}' if places else ''}"


def simulated_on(simulation_voxels: int | None, protocol: str | None, box: Grid | None) -> str:
    """Of what voxels X-rays were made that are reconstructed on a box, or on a method's own voxels."""
    if simulation_voxels:
        return f"{simulation_voxels}^3 voxels"
    if protocol and protocol_of(protocol).cube:
        return "the protocol's voxels"
    if box and not (made := whole(box)).same_as(box):
        return f"{made.shape[0]}^3 voxels of {made.spacing[0]:g} mm"
    return "the voxels that are reconstructed, which is optimistic"


def simulated(data: Mapping) -> dict:
    """The settings of simulated X-rays, by name, as a record's `data` has them; what is not set is left out."""
    simulator = data.get("simulator", {})
    named = {"simulator": simulator.get("class")} | simulator | {
        name: value for name, value in data.items() if name not in ("simulator", "with_report", "protocol")}
    return {name: value for name, value in named.items() if name != "class" and value is not None}


def condition(record: Mapping) -> dict:
    """What a case's scores depend on beside the method and its seed: protocol, views, simulated X-rays and the voxels
    that are scored, those that a protocol fixes left out."""
    settings = record.get("settings", {})
    data = settings.get("data", {})
    protocol = data.get("protocol")
    stated = {"protocol": protocol, "views": record["views"]}
    if protocol is None:
        stated |= {name: value for name, value in simulated(data).items()
                   if name != "views" and PAPER_ORBIT.get(name) != value}
    elif voxels := data.get("simulation_voxels"):
        stated["simulation_voxels"] = voxels
    if protocol is None or not protocol_of(protocol).cube:
        stated["grid"] = voxels_in_words(Grid(**record["grid"]), settings.get("grid"))
    return stated


def told_apart(records: Iterable[Mapping], data: Callable[[Mapping], object]) -> list[dict]:
    """Records in which one case's name stands for one set of `data` alone, so that unlike data are neither averaged nor
    paired.

    The second of "anna" becomes "anna (2)", with the `namesake` "anna". Data None counts as the first.
    """
    found: dict[str, list] = {}
    apart = []
    for record in records:
        case, mine = str(record["case"]), data(record)
        known = found.setdefault(case, [])
        if mine is not None and mine not in known:
            known.append(mine)
        number = known.index(mine) + 1 if mine is not None else 1
        apart.append({**record} if number == 1 else {**record, "case": _another(case, number), "namesake": case})
    return apart


def _another(case: str, number: int) -> str:
    """The id of another case of the same name, and of the same patient."""
    patient = patient_of(case)
    return f"{case} ({number})" if patient in (case, case.split("__")[0]) else f"{patient}__{case} ({number})"


def namesakes(records: Iterable[Mapping]) -> str:
    """The cases of one name among records that were `told_apart`."""
    of: dict[str, dict[str, None]] = {}
    for record in records:
        of.setdefault(str(record.get("namesake", record["case"])), {})[str(record["case"])] = None
    return ", ".join(case for cases in of.values() if len(cases) > 1 for case in cases)


def voxels_in_words(grid: Grid, box: Mapping | None = None) -> str:
    """A grid in words, and where the box is that it was asked for, unless at the isocentre."""
    sides = [f"{mm:.3g}" for mm in grid.spacing]
    spacing = sides[0] if len(set(sides)) == 1 else " x ".join(sides)
    centre = ", ".join(f"{mm + 0:.3g}" for mm in Grid(**box).centre.round(3)) if box else "0, 0, 0"
    place = "" if centre == "0, 0, 0" else f" around ({centre})"
    return f"{'x'.join(map(str, grid.shape))} of {spacing} mm{place}"


def condition_titles(records: Sequence[Mapping]) -> dict[str, str]:
    """Each condition of records in words -> the settings that tell it from the others, in words; "" where
    there is only one."""
    found = {format_settings(given): given for given in map(condition, records)}
    names = dict.fromkeys(name for given in found.values() for name in given)
    told = [name for name in names if len({str(given[name]) for given in found.values() if name in given}) > 1]
    for name in names:
        if name not in told and len({_told(given, [*told, name]) for given in found.values()}) > len(
                {_told(given, told) for given in found.values()}):
            told.append(name)
    return {text: _told(given, [name for name in names if name in told]) for text, given in found.items()}


def _told(given: Mapping, names: Sequence[str]) -> str:
    return format_settings({name: given[name] for name in names if name in given})
