"""What is compared: a YAML file of settings and of lists of their values, and the trials that it stands for."""

from __future__ import annotations

import json
import math
import reprlib
import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from functools import cache, lru_cache
from itertools import product
from pathlib import Path
from types import NoneType
from typing import get_args, get_type_hints

from jsonargparse import ArgumentError, ArgumentParser

from phydict.datasets import CTSource
from phydict.grid import Grid
from phydict.inference.data import ReconstructionData
from phydict.inference.settings import Orbit
from phydict.methods import METHODS
from phydict.posterior import Sampler
from phydict.prior import DEFAULT_PRIOR, fingerprint, load_prior
from phydict.reconstruction import Reconstructor, describe
from phydict.runtime.renamed import check_setting
from phydict.runtime.seeds import check_seed
from phydict.runtime.shipped import configuration
from phydict.runtime.yaml_file import read_yaml
from phydict.units import HUWindow
from phydict.xray import Ideal, Polychromatic, Simulator

SIDE = 560.0
"""mm along each side of the simulated detector unless the size of its pixels is given."""

MOST_TRIALS = 2000
"""Combinations of the values of axes, of all products together."""

SIMULATORS: dict[str, Simulator] = {"ideal": Ideal(), "polychromatic": Polychromatic()}

SETTINGS: dict[str, tuple[type, object]] = {
    "method": (str, None), "seed": (int, 0),
    "views": (int, 8), "detector": (int, 448), "pixel": (float | None, None), "simulator": (str, "ideal"),
    "simulation_voxels": (int | None, None), "source_to_detector": (float, 1020.0),
    "source_to_isocentre": (float, 740.0),
    "report": (bool, True), "voxels": (int, 64), "side": (float, 384.0),
    "prior": (str, str(DEFAULT_PRIOR)), "guidance": (float, 1.0), "samples": (int, 1),
    "delta": (float | None, None)}
"""Type and default of what an axis may be; beside these, method.<field> and simulator.<field>."""

PRIOR_SETTINGS = ("prior", "guidance", "samples", "delta", "report")
"""Settings that mean nothing to a method without a prior."""

DEFAULT_COLUMNS = ("method", "views", "simulator", "detector", "seed", "guidance", "samples")
"""Settings that the table of results always has as columns; others where a specification gives them."""


@dataclass(frozen=True)
class Cases:
    """Where the cases come from: a folder of CTs, or a number of phantoms; `only` and `reports` as in infer.py."""

    cts: str | None = None
    phantoms: int | None = None
    only: str | None = None
    reports: str | None = None

    def __post_init__(self):
        if (self.cts is None) == (self.phantoms is None):
            raise ValueError("the cases are those of a folder, cts, or a number of phantoms: give exactly one of the "
                             "two, in the file or on the command line")
        if self.phantoms is not None and type(self.phantoms) is not int:
            raise ValueError(f"phantoms is a whole number without quotes, but {self.phantoms!r} was given")
        for name in ("cts", "only", "reports"):
            _check_path(getattr(self, name), name)

    def data(self, **settings) -> ReconstructionData:
        """The simulated X-rays of these cases."""
        if self.phantoms is not None:
            return ReconstructionData(cts="phantom", phantoms=self.phantoms, **settings)
        return ReconstructionData(cts=self.cts, only=self.only, source=CTSource(self.reports), **settings)


@dataclass(frozen=True)
class Trial:
    """One method with one set of settings, to be run on every case.

    columns: what the table of results says of it; method, prior (a file, None where the method needs none), guidance,
    samples, seed: as in infer.py; data: the X-rays; like: for a method without a prior, the file of the prior whose
    grid and HU window it takes; voxels, side: its grid where there is none.
    """

    columns: dict
    method: Sampler | Reconstructor
    data: ReconstructionData
    prior: str | None
    guidance: float
    samples: int
    seed: int
    voxels: int
    side: float
    like: str | None = None

    @property
    def name(self) -> str:
        return self.columns["method"]

    @property
    def label(self) -> str:
        """The method and what was changed of it or of its X-rays; the number of views always."""
        return ", ".join([self.name, *(f"{name} {value}" for name, value in self.columns.items() if name == "views" or
                                       (name != "method" and ("." in name or value != SETTINGS[name][1])))])

    def scene(self) -> tuple[Grid, HUWindow]:
        """The grid of the volume and the HU window that the truth is clipped to."""
        file = self.prior or self.like
        if file is None:
            return Grid.cube(self.voxels, self.side), HUWindow()
        return prior_of(file).grid, prior_of(file).window

    def identity(self) -> dict:
        """All that decides the numbers of a trial beside the case, as plain JSON values."""
        grid, window = self.scene()
        mine = {"name": self.name, "method": describe(self.method), "seed": self.seed, "grid": grid.to_dict(),
                "window": describe(window), "data": self.data.settings("test")}
        if self.prior is not None:
            mine |= {"prior_crc32": _crc(self.prior), "guidance": self.guidance, "samples": self.samples}
        return json.loads(json.dumps(mine))

    def acquisition(self) -> str:
        """Equal for trials whose X-rays are the same."""
        grid, window = self.scene()
        settings = self.data.settings("test") | {"with_report": None, "seed": self.seed}
        return json.dumps([settings, grid.to_dict(), describe(window)], sort_keys=True)


@dataclass(frozen=True)
class Specification:
    """What an ablation runs and where its results go."""

    out: Path
    cases: Cases
    trials: list[Trial]


def read_specification(file: str | Path, **given) -> Specification:
    """The specification in a YAML file, or in a shipped one by its name; `given` (out, cts, phantoms, only, reports),
    where not None, takes the place of what the file says.

    Its keys: out; cts or phantoms, only, reports; methods: names for changed methods, each a mapping of settings and
    `of`, the method that is changed; base: settings of all trials; axes: setting -> list of values, of which every
    combination is a trial; or products: a list of such bases and axes. A setting that means nothing to a method is left
    out for it, and what then is the same is run once. Raises ValueError, in one sentence, on what cannot be meant.
    """
    content = read_yaml(configuration(file, ("ablate",)))
    try:
        return _specification(content, {k: v for k, v in given.items() if v is not None})
    except ValueError as error:
        raise ValueError(f"{file}: {error}") from error


def _specification(content, given: Mapping) -> Specification:
    keys = ("out", "cts", "phantoms", "only", "reports", "methods", "base", "axes", "products")
    _check_keys(content, keys, "a specification")
    if "products" in content and "axes" in content:
        raise ValueError("give axes, or products, each with axes of its own, but not both")
    if "cts" in given or "phantoms" in given:
        content = {k: v for k, v in content.items() if k not in ("cts", "phantoms", "only", "reports")}
    content = content | given
    methods = _mapping(content.get("methods"), "methods")
    for name, changes in methods.items():
        of = _mapping(changes, f"methods.{name}").get("of", name)
        if not isinstance(of, str) or of not in METHODS:
            raise ValueError(f"methods.{name}: there is no method {of!r} to change: give `of`, one of "
                             f"{', '.join(METHODS)}")
    cases = Cases(*(content.get(name) for name in ("cts", "phantoms", "only", "reports")))
    if content.get("out") is None:
        raise ValueError("there is no folder for the results: give out, in the file or as --out")
    _check_path(content["out"], "out")
    products = content.get("products", [{"axes": content.get("axes", {})}])
    if not isinstance(products, list) or not products:
        raise ValueError(f"products is a list of bases and axes, but {products!r} was given")
    common = _dotted(_mapping(content.get("base"), "base"))
    trials, used, found = {}, set(), []
    for entry in products:
        _check_keys(entry, ("base", "axes"), "a product")
        own, axes = (_dotted(_mapping(entry.get(name), name)) for name in ("base", "axes"))
        mine, meant = _trials(common | own, axes, methods, cases, len(found))
        _check_used([*own, *axes], meant, mine)
        used, found = used | meant, found + mine
        for trial in mine:
            trials.setdefault(json.dumps(trial.identity(), sort_keys=True), trial)
    _check_used(common, used, found)
    return Specification(Path(content["out"]), cases, list(trials.values()))


def _trials(base: Mapping, axes: Mapping, methods: Mapping, cases: Cases,
            before: int) -> tuple[list[Trial], set[str]]:
    """The trials of one product, those that come out the same still among them, and the settings that mean anything
    to one of them; of other products there are `before` trials."""
    for name in base | axes:
        if name not in SETTINGS and not name.startswith(("method.", "simulator.")):
            raise ValueError(f"there is no setting {name!r}: use one of {', '.join(SETTINGS)}, method.<field> or "
                             "simulator.<field>")
    if "method" not in base | axes:
        if not methods:
            raise ValueError("there is no method: give it as an axis or in the base")
        axes = axes | {"method": list(methods)}
    for name, values in axes.items():
        if not isinstance(values, list) or not values:
            raise ValueError(f"the axis {name} is a list of at least one value, but {values!r} was given")
    if (count := before + math.prod(map(len, axes.values()))) > MOST_TRIALS:
        raise ValueError(f"the axes stand for {count:,} combinations, but at most {MOST_TRIALS:,} are run: shorten "
                         "them")
    found, used = [], set()
    for values in product(*axes.values()):
        mine = dict(zip(axes, values))
        name = mine.get("method", base.get("method"))
        if not isinstance(name, str) or (name not in methods and name not in METHODS):
            raise ValueError(f"there is no method {name!r}: use one of {', '.join([*methods, *METHODS])}")
        changes = _dotted(methods.get(name) or {})
        of = changes.pop("of", name)
        trial, meant = _trial(of, base | changes | mine | {"method": name}, cases)
        _check_used(changes, meant, [trial])
        found.append(trial)
        used |= meant
    like = next((trial.prior for trial in found if trial.prior), None)
    found = [trial if trial.prior else replace(trial, like=like) for trial in found]
    scenes = [trial.scene() for trial in found]
    asked = [Grid.cube(trial.voxels, trial.side) for trial in found if {"voxels", "side"} & trial.columns.keys()]
    if any(window != scenes[0][1] for _, window in scenes) or not all(
            grid.same_as(scenes[0][0]) for grid in [*asked, *(grid for grid, _ in scenes)]):
        raise ValueError("the methods of a product are compared on one grid and HU window, but their priors, or voxels "
                         "and side, give several: leave voxels and side out, or make products of their own")
    return found, used


def _trial(of: str, settings: Mapping, cases: Cases) -> tuple[Trial, set[str]]:
    """The trial of some settings, and the names of those that mean anything to it."""
    given = {name: parsed(SETTINGS[name][0], value, name) for name, value in settings.items() if name in SETTINGS}
    for name, value in given.items():
        if isinstance(value, float) and not math.isfinite(value):
            raise ValueError(f"{name} must be a finite number, but {value} was given")
    check_seed(given.get("seed", 0))
    base = METHODS[of]
    simulator = SIMULATORS.get(given.get("simulator", "ideal"))
    if simulator is None:
        raise ValueError(f"there is no simulator {given['simulator']!r}: use one of {', '.join(SIMULATORS)}")
    own = {"method": base, "simulator": simulator}
    changes: dict[str, dict] = {"method": {}, "simulator": {}}
    for name, value in settings.items():
        part, _, path = name.partition(".")
        if path and part in own and has_field(own[part], path.split(".")):
            changes[part][path] = value
    try:
        method, simulator = (changed(own[part], changes[part], part) for part in own)
    except ValueError as error:
        raise ValueError(f"{settings['method']}: {error}") from error
    if not isinstance(method, Sampler) or not has_field(method, ["ec_delta"]):
        given.pop("delta", None)
    if given.get("delta") is not None:
        method = refined_from(method, given["delta"], "ec_steps" in changes["method"])
    if not isinstance(method, Sampler):
        given = {name: value for name, value in given.items() if name not in PRIOR_SETTINGS}
    value = {name: default for name, (_, default) in SETTINGS.items()} | given
    if value["detector"] < 1:
        raise ValueError("detector is a number of pixels along each side, 1 or more, but "
                         f"{value['detector']} was given")
    pixel = SIDE / value["detector"] if value["pixel"] is None else value["pixel"]
    data = cases.data(
        with_report=value["report"],
        orbit=Orbit(value["views"], value["source_to_detector"], value["source_to_isocentre"], (value["detector"],) * 2,
                    (pixel, pixel)),
        simulator=simulator, simulation_voxels=value["simulation_voxels"])
    with_prior = isinstance(method, Sampler)
    overrides = {f"{part}.{path}": plain(field_of({"method": method, "simulator": simulator}[part], path.split(".")))
                 for part, paths in changes.items() for path in paths}
    columns = {name: value[name] for name in DEFAULT_COLUMNS
               if name in given or name not in PRIOR_SETTINGS or with_prior}
    columns |= {name: given[name] for name in SETTINGS if name in given and name not in columns} | overrides
    trial = Trial(columns, method, data, value["prior"] if with_prior else None, value["guidance"], value["samples"],
                  value["seed"], value["voxels"], value["side"])
    meant = set(given) | set(overrides)
    return trial, meant | ({"voxels", "side"} & set(settings))


def refined_from(method: Sampler, delta: float, keep_iterations: bool = False) -> Sampler:
    """A method with Extra Compute from `delta`, 0 for none, in steps of the length of the first pass' unless its
    number of steps is to be kept."""
    iterations = method.ec_steps if keep_iterations else max(1, round(delta * method.iterations))
    return replace(method, ec_delta=delta, ec_steps=iterations if delta else method.ec_steps)


def has_field(settings, path: Sequence[str]) -> bool:
    """Whether `path` leads to a field of nested settings."""
    if not is_dataclass(settings) or path[0] not in {f.name for f in fields(settings)}:
        return False
    return len(path) == 1 or has_field(getattr(settings, path[0]), path[1:])


def field_of(settings, path: Sequence[str]):
    """The field of nested settings that `path` leads to."""
    return settings if not path else field_of(getattr(settings, path[0]), path[1:])


def changed(settings, changes: Mapping[str, object], name: str):
    """Nested settings with the values of `changes`, dotted path -> value, in place of their own, all at once.

    Raises ValueError naming the setting where a value is none that its field can have.
    """
    mine = {}
    for first in dict.fromkeys(path.partition(".")[0] for path in changes):
        value, hint = getattr(settings, first), get_type_hints(type(settings))[first]
        if first in changes:
            value = parsed(hint, changes[first], f"{name}.{first}")
        deeper = {path.partition(".")[2]: v for path, v in changes.items() if path.startswith(first + ".")}
        mine[first] = changed(value, deeper, f"{name}.{first}") if deeper else value
    return replace(settings, **mine) if mine else settings


def parsed(hint, value, name: str):
    """`value`, as YAML gives it, as the type `hint`. Raises ValueError naming the setting where it is none."""
    return (_parsed_once if isinstance(value, str | int | float) else _parsed)(hint, value, name)


def _parsed(hint, value, name: str):
    parser = ArgumentParser(exit_on_error=False)
    parser.add_argument("--value", type=hint)
    try:
        if value is None and NoneType not in get_args(hint):
            raise TypeError
        return parser.instantiate_classes(parser.parse_object({"value": value})).value
    except (ArgumentError, TypeError, ValueError) as error:
        wanted = getattr(hint, "__name__", str(hint))
        raise ValueError(f"{name} takes a value of type {wanted}, but {reprlib.repr(value)} was given") from error


def plain(value):
    """A setting as one field of a table, where an empty field means that it is the method's own."""
    return json.dumps(describe(value)) if is_dataclass(value) else "none" if value is None else value


_parsed_once = lru_cache(10_000, typed=True)(_parsed)
"""A product has each of its values in many trials."""


@cache
def prior_of(file: str):
    """The prior in a file, read once."""
    return load_prior(file)


@cache
def _crc(file: str) -> int:
    return fingerprint(file)


def key(trial: Trial, case: str, source: str) -> str:
    """What a row of results is known by: equal for equal settings and equal data (id, what identifies it) alone."""
    text = json.dumps([trial.identity(), case, source], sort_keys=True)
    return f"k{zlib.crc32(text.encode()):08x}{zlib.adler32(text.encode()):08x}"


def _dotted(settings: Mapping) -> dict:
    """Settings, their names without the init_args of infer.py's configuration files. Raises ValueError for old
    names."""
    check_setting("", settings)
    return {".".join(part for part in str(name).split(".") if part != "init_args"): value
            for name, value in settings.items()}


def _check_used(names: Iterable[str], used: set[str], trials: Sequence[Trial]) -> None:
    """Raises ValueError for the first of `names` that is not among the settings that mean anything to the trials."""
    for name in names:
        if name not in used:
            part = name.partition(".")[0]
            owners = {type(trial.method) if part == "method" else type(trial.data.simulator): 0 for trial in trials}
            known = ", ".join(dict.fromkeys(f.name for owner in owners for f in fields(owner)))
            raise ValueError(f"the setting {name} means nothing to any method or simulator here"
                             + (f", whose fields are {known}" if "." in name else ""))


def _mapping(value, name: str) -> Mapping:
    if value is None:
        return {}
    if not isinstance(value, dict):
        raise ValueError(f"{name} is a mapping of names to values, but {reprlib.repr(value)} was given")
    return value


def _check_path(value, name: str) -> None:
    if not isinstance(value, str | None):
        raise ValueError(f"{name} is the name of a file or folder, but {reprlib.repr(value)} was given")


def _check_keys(value, keys: Sequence[str], what: str) -> None:
    if not isinstance(value, dict):
        raise ValueError(f"{what} is a mapping with the keys {', '.join(keys)}, but {reprlib.repr(value)} was given")
    if unknown := [name for name in value if name not in keys]:
        raise ValueError(f"{what} has no key {unknown[0]!r}: use {', '.join(keys)}")
