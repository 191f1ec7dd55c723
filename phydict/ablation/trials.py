"""The trials of a comparison: one method each, with one set of settings, from which X-rays and onto which grid."""

from __future__ import annotations

import json
import math
import zlib
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields, replace
from functools import cache
from itertools import product
from types import MappingProxyType

from phydict.ablation.cases import Cases
from phydict.ablation.nested import changed, field_of, has_field, parsed, plain
from phydict.grid import Box, Grid
from phydict.inference.conditions import voxels_in_words
from phydict.inference.data import ReconstructionData
from phydict.inference.record import correction_checksums
from phydict.inference.settings import Orbit
from phydict.inference.voxels import Voxels
from phydict.methods import DEFAULT_GRID, METHODS, corrections_of
from phydict.posterior import Refinement, Sampler
from phydict.prior import find_prior, fingerprint, load_super_resolution, own_identity
from phydict.reconstruction import Reconstructor, describe
from phydict.rivals import TrainedRival
from phydict.runtime.own_code import imported
from phydict.runtime.precision import check_precision
from phydict.runtime.reading import naming, reason
from phydict.runtime.seeds import check_seed
from phydict.units import HUWindow
from phydict.xray import Ideal, Polychromatic, Simulator
from phydict.xray.orbits import PIXEL, PIXELS, SOURCE_TO_DETECTOR, SOURCE_TO_ISOCENTRE
from phydict.xray.projectors.own import projector_kind, projector_settings

SIDE = PIXELS * PIXEL
"""mm along each side of the simulated detector unless the size of its pixels is given."""

MOST_TRIALS = 2000
"""Combinations of the values of axes, of all products together."""

SIMULATORS: dict[str, Simulator] = {"ideal": Ideal(), "polychromatic": Polychromatic()}

SETTINGS: dict[str, tuple] = {
    "method": (str, None, "method"), "seed": (int, 0, "run"), "views": (int, 8, "orbit"),
    "detector": (int, PIXELS, "orbit"), "pixel": (float | None, None, "orbit"), "simulator": (str, "ideal", "X-rays"),
    "simulation_voxels": (int | None, None, "X-rays"), "source_to_detector": (float, SOURCE_TO_DETECTOR, "orbit"),
    "source_to_isocentre": (float, SOURCE_TO_ISOCENTRE, "orbit"), "geometry": (str | None, None, "X-rays"),
    "report": (bool, True, "prior"), "voxels": (int | tuple[int, int, int] | None, None, "box"),
    "side": (float | tuple[float, float, float], 384.0, "box"),
    "centre": (tuple[float, float, float], (0.0, 0.0, 0.0), "box"), "refine": (bool, True, "prior"),
    "super_resolution": (str | None, None, "prior"), "protocol": (str | None, None, "X-rays"),
    "prior": (str | None, None, "prior"), "guidance": (float, 1.0, "prior"), "samples": (int, 1, "prior"),
    "delta": (float | None, None, "prior"), "projector": (str, "auto", "method"), "precision": (str, "auto", "method")}
"""Type and default of what an axis may be, and what it belongs to: "method"; "prior", which means nothing to a method
without one; "box" of the result's voxels; "orbit", which means nothing beside a geometry file; "X-rays" else; or "run".
Beside these, method.<field> and simulator.<field>."""

DEFAULTS: dict = {name: default for name, (_, default, _) in SETTINGS.items()}


def settings_of(*owners: str) -> tuple[str, ...]:
    """The names of the settings that belong to one of these."""
    return tuple(name for name, (_, _, owner) in SETTINGS.items() if owner in owners)


PRECISION = "networks.precision"
"""The column of the setting precision, which is there where one is chosen; the column precision is what was computed
in."""

DEFAULT_COLUMNS = ("method", "views", "simulator", "detector", "seed", "guidance", "samples")
"""Settings that the table of results always has as columns; others where a specification gives them."""


@dataclass(frozen=True)
class Trial:
    """One method with one set of settings, to be run on every case.

    columns: what the table of results says of it; method, prior (a file, None where the method needs none), guidance,
    samples, seed: as in infer.py; data: the X-rays; like: for a method without a prior, the file of the prior whose
    grid and HU window it takes; box: the result's voxels, None for the method's own; refine: whether finer voxels than
    a prior's are met with the X-rays, or interpolated; super_resolution: a second stage's file; projector: the
    method's, as Projector's `method`; X-rays are made by the automatic one; precision: of the method's networks.
    """

    columns: dict
    method: Sampler | Reconstructor
    data: ReconstructionData
    prior: str | None
    guidance: float
    samples: int
    seed: int
    box: Box | None = None
    refine: bool = True
    super_resolution: str | None = None
    like: str | None = None
    projector: str | type = "auto"
    with_report: bool = True
    precision: str = "auto"

    @property
    def name(self) -> str:
        return self.columns["method"]

    @property
    def label(self) -> str:
        """The method and what was changed of it or of its X-rays; the number of views always."""
        return ", ".join([self.name, *(f"{name} {value}" for name, value in self.columns.items() if name == "views" or
                                       (name != "method" and ("." in name or value != DEFAULTS[name])))])

    def scene(self) -> tuple[Grid, HUWindow]:
        """The grid of the CT that X-rays are made of, and the HU window that it is clipped to."""
        file = self.prior or self.like
        return self.voxels.made, self.voxels.window(prior_of(file).window if file else HUWindow())

    @property
    def voxels(self) -> Voxels:
        return Voxels(self.first(), self.box.grid() if self.box else None, self.data.protocol)

    @property
    def bound(self) -> bool:
        """Whether the method has voxels of its own: a prior's, or those of its weights."""
        return isinstance(self.method, Sampler) or self.own is not None

    @property
    def own(self) -> Grid | None:
        """The voxels of a trained rival's weights, or of another Reconstructor that is bound to some; None for other
        methods, and where its row will say why its file cannot be read."""
        with suppress(ValueError):
            return self.method.grid if isinstance(self.method, Reconstructor) else None
        return None

    @property
    def fixed(self) -> Grid | None:
        """The grid of a protocol that has one."""
        return self.data.protocol.grid if self.data.protocol else None

    def first(self) -> Grid:
        """The grid of the method before it is refined: of its second stage, its prior or the one that it goes by; where
        it goes by none, or by a protocol that has voxels, of a rival's own weights, and else the protocol's."""
        if self.super_resolution:
            return stage_of(self.super_resolution).grid
        alone = isinstance(self.method, Reconstructor) and (self.fixed or not self.like)
        if alone and (grid := self.own or self.fixed):
            return grid
        file = self.prior or self.like
        return prior_of(file).grid if file else DEFAULT_GRID

    @property
    def followed(self) -> tuple[Grid, str] | None:
        """The grid, unlike the usual, that a method without one of its own takes, and the prior file it is of."""
        if self.like is None or self.bound or self.box or self.fixed or self.first().same_as(DEFAULT_GRID):
            return None
        return self.first(), self.like

    def scored_columns(self) -> dict[str, str]:
        """What a row says of the voxels and the HU window that its truth has: of voxels that are no cube as long as
        the usual one, and that no other setting tells, also their length and place."""
        grid, window = self.voxels.scored, self.scene()[1]
        told = self.box or self.fixed or grid.same_as(Grid.cube(grid.shape[0]))
        return {"grid": "x".join(map(str, grid.shape)) if told else voxels_in_words(grid),
                "window": f"[{window.low:g}, {window.high:g}]"}

    @property
    def refinement(self) -> Refinement:
        return Refinement() if self.refine else Refinement(None)

    @property
    def training(self) -> str | None:
        """What a trained rival's file tells of its training; None for other methods, and where its row will say why the
        file cannot be read."""
        with suppress(ValueError):
            return self.method.training if isinstance(self.method, TrainedRival) else None
        return None

    def identity(self) -> dict:
        """All that decides the numbers of a trial beside the case, as plain JSON values."""
        grid, window = self.scene()
        identity = {"name": self.name, "method": describe(self.method), "seed": self.seed, "grid": grid.to_dict(),
                    "window": describe(window), "data": {"with_report": self.with_report} | self.data.settings("test")}
        if self.prior is not None:
            prior_identity = own_identity(prior_of(self.prior), self.prior)
            identity |= {"prior_crc32": _crc(self.prior)} if prior_identity is None else {"prior": prior_identity}
            identity |= {"guidance": self.guidance, "samples": self.samples}
        if self.super_resolution:
            identity["super_resolution_crc32"] = _crc(self.super_resolution)
        if self.prior is not None and self.box and not self.first().same_as(self.box.grid()):
            identity["refinement"] = describe(self.refinement)
            files = corrections_of(self.method, self.box.grid()) if self.refine else []
            identity |= correction_checksums(files, _crc)
        if self.box and not self.box.grid().same_as(grid):
            identity["region"] = self.box.grid().to_dict()
        if self.projector != "auto":
            identity["projector"] = projector_settings(self.projector)
        if self.precision != "auto":
            identity["precision"] = self.precision
        return json.loads(json.dumps(identity))

    def acquisition(self) -> str:
        """Equal for trials whose X-rays, and voxels to score on, are the same."""
        grid, window = self.scene()
        settings = self.data.settings("test") | {"seed": self.seed}
        return json.dumps([settings, grid.to_dict(), self.voxels.scored.to_dict(), describe(window)], sort_keys=True)


def trials_of(base: dict, axes: dict, methods: Mapping, cases: Cases,
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
    trials, used = [], set()
    for values in product(*axes.values()):
        combination = dict(zip(axes, values))
        name = combination.get("method", base.get("method"))
        if not isinstance(name, str) or name not in methods:
            method_of(name, methods)
        changes = dotted(methods.get(name) or {})
        of = changes.pop("of", name)
        if clash := next((k for k in changes if k in combination and combination[k] != changes[k]), None):
            raise ValueError(f"methods.{name} gives {clash} {changes[clash]!r}, but an axis gives it "
                             f"{combination[clash]!r}: leave one of the two out, or give the method a product of its "
                             "own without that axis")
        trial, meant = _trial(of, base | changes | combination | {"method": name}, cases)
        check_used(changes, meant, [trial])
        trials.append(trial)
        used |= meant
    like = next((trial.prior for trial in trials if trial.prior), None)
    trials = [trial if trial.prior else replace(trial, like=like) for trial in trials]
    scenes = [trial.scene() for trial in trials]
    for trial, (grid, _) in zip(trials, scenes):
        if (voxels := trial.data.simulation_voxels) and voxels % grid.shape[0]:
            raise ValueError(f"simulation_voxels is a multiple of the {grid.shape[0]} voxels along each side that are "
                             f"scored, but {voxels} was given: give such a one, or leave it out")
    results = [trial.voxels.result for trial in trials] if not any(trial.data.protocol for trial in trials) else []
    if any(window != scenes[0][1] for _, window in scenes) or not all(
            grid.same_as(grids[0]) for grids in (results, [grid for grid, _ in scenes]) for grid in grids):
        raise ValueError("the methods of a product are compared on one grid and HU window, but their priors, second "
                         "stages, or voxels, side and centre, give several: give voxels, or make products of their own")
    return trials, used


def _trial(of: str, settings: Mapping, cases: Cases) -> tuple[Trial, set[str]]:
    """The trial of some settings, and the names of those that mean anything to it."""
    given = _checked(settings)
    method, simulator, changes = _changed(of, settings, given.get("simulator", "ideal"))
    given = _meant(given, method)
    if given.get("delta") is not None:
        method = refined_from(method, given["delta"], "method.ec_steps" in changes)
    value = DEFAULTS | given
    data = _data(value, given, simulator, cases)
    if value["protocol"] or value["geometry"]:
        value |= {"views": data.beam.views, "detector": data.beam.shape[0]}
    owners = {"method": method, "simulator": simulator}
    overrides = {f"{part}.{path}": plain(field_of(owners[part], path.split(".")))
                 for part, path in (name.split(".", 1) for name in changes)}
    with_prior = isinstance(method, Sampler)
    columns = {name: value[name] for name in DEFAULT_COLUMNS
               if name in given or with_prior or name not in settings_of("prior")}
    columns |= {name: given[name] for name in SETTINGS
                if name in given and name not in columns and name != "precision"} | overrides
    if value["precision"] != "auto":
        if (own := overrides.get("method.precision", value["precision"])) != value["precision"]:
            raise ValueError(f"{value['method']}: precision is {value['precision']}, but method.precision {own}: leave "
                             "one of the two out")
        columns[PRECISION] = value["precision"]
    prior = value["prior"] or str(method.default_prior) if isinstance(method, Sampler) else None
    box = None if value["voxels"] is None else Box(value["voxels"], value["side"], value["centre"])
    if box is None and (alone := {"side", "centre", "refine"} & set(given)):
        raise ValueError(f"{', '.join(sorted(alone))} of a box of voxels means nothing without voxels: give them too")
    trial = Trial(columns, method, data, prior, value["guidance"], value["samples"], value["seed"], box,
                  value["refine"], value["super_resolution"], projector=projector_kind(value["projector"]),
                  with_report=value["report"], precision=value["precision"])
    if box and data.protocol:
        data.protocol.check_voxels(box.grid(), trial.bound)
    return trial, set(given) | set(overrides)


def _checked(settings: Mapping) -> dict:
    """Those of SETTINGS that are given, as the values that they stand for. Raises ValueError where one cannot be."""
    given = {name: parsed(SETTINGS[name][0], value, name) for name, value in settings.items() if name in SETTINGS}
    for name, value in given.items():
        if isinstance(value, float) and not math.isfinite(value):
            raise ValueError(f"{name} must be a finite number, but {value} was given")
    for name in ("voxels", "side"):
        if isinstance(sides := given.get(name), tuple) and len(set(sides)) == 1:
            given[name] = sides[0]  # as which such a box is told
    check_seed(given.get("seed", 0))
    if (samples := given.get("samples", 1)) < 1:
        raise ValueError(f"samples is a number of draws, 1 or more, but {samples} was given")
    check_precision(given.get("precision", "auto"))
    return given


def _changed(of: str, settings: Mapping, simulated_by: str) -> tuple[Sampler | Reconstructor, Simulator, list[str]]:
    """A method and a simulator with those fields that are given of them, and the names of these settings."""
    method, simulator = method_of(of), SIMULATORS.get(simulated_by)
    if simulator is None:
        raise ValueError(f"there is no simulator {simulated_by!r}: use one of {', '.join(SIMULATORS)}")
    changes: dict[str, dict] = {"method": {}, "simulator": {}}
    for name, value in settings.items():
        part, _, path = name.partition(".")
        if path and part in changes and has_field({"method": method, "simulator": simulator}[part], path.split(".")):
            changes[part][path] = value
    with naming(settings["method"]):
        method = changed(method, changes["method"], "method")
        simulator = changed(simulator, changes["simulator"], "simulator")
    return method, simulator, [f"{part}.{path}" for part, paths in changes.items() for path in paths]


def _meant(given: Mapping, method: Sampler | Reconstructor) -> dict:
    """Those of the given settings that mean anything to a method, or, beside a geometry file, of the X-rays."""
    without: set[str] = set() if given.get("geometry") is None else {*settings_of("orbit")}
    if not isinstance(method, Sampler):
        without |= {*settings_of("prior"), *(() if has_field(method, ["precision"]) else ["precision"])}
    elif not has_field(method, ["ec_delta"]):
        without.add("delta")
    return {name: value for name, value in given.items() if name not in without}


def _data(value: Mapping, given: Mapping, simulator: Simulator, cases: Cases) -> ReconstructionData:
    """The cases' X-rays by the `value` of each setting, of which some were given."""
    if value["detector"] < 1:
        raise ValueError("detector is a number of pixels along each side, 1 or more, but "
                         f"{value['detector']} was given")
    pixel = SIDE / value["detector"] if value["pixel"] is None else value["pixel"]
    return cases.data(
        orbit=_orbit(given) if value["protocol"] or value["geometry"] else Orbit(
            value["views"], value["source_to_detector"], value["source_to_isocentre"], (value["detector"],) * 2,
            (pixel, pixel)),
        simulator=simulator, simulation_voxels=value["simulation_voxels"], geometry=value["geometry"],
        protocol=value["protocol"])


def _orbit(given: Mapping) -> Orbit:
    """The part of a protocol's orbit that is given beside it."""
    sizes: dict = {name: (given[name],) * 2 for name in ("detector", "pixel") if given.get(name) is not None}
    return Orbit(given.get("views"), given.get("source_to_detector"), given.get("source_to_isocentre"), **sizes)


def method_of(name: object, known: Iterable[str] = ()) -> Sampler | Reconstructor:
    """A named method, or one's own by the path of its class, such as my_module.MySampler, with its default settings.

    Raises ValueError, naming `known` beside the methods, where there is none, and where it lacks defaults.
    """
    if isinstance(name, str) and name in METHODS:
        return METHODS[name]
    if not (isinstance(name, str) and name.rpartition(".")[0]):
        raise ValueError(f"there is no method {name!r}: use one of {', '.join([*known, *METHODS])}, or the path of a "
                         "class, such as my_module.MySampler")
    try:
        kind = imported(name)
        if isinstance(kind, type) and issubclass(kind, Sampler | Reconstructor):
            return kind()
    except (Exception, SystemExit) as error:  # of whatever kind: another's code runs
        raise ValueError(f"the method {name} cannot be made ({reason(error)}): its module must be importable, and its "
                         "settings need defaults") from error
    raise ValueError(f"{name} is no method: derive it from phydict.posterior.Sampler or "
                     "phydict.reconstruction.Reconstructor, as a dataclass")


def refined_from(method, delta: float, keep_iterations: bool = False) -> Sampler:
    """A method with Extra Compute from `delta`, 0 for none, in steps of the length of the first pass' unless its
    number of steps is to be kept."""
    iterations = method.ec_steps if keep_iterations else max(1, round(delta * method.iterations))
    return replace(method, ec_delta=delta, ec_steps=iterations if delta else method.ec_steps)


prior_of, stage_of, _crc = cache(find_prior), cache(load_super_resolution), cache(fingerprint)
"""The prior in a file, or of a class, the second stage in a file, and a file's checksum, each read once."""


def key(trial: Trial, case: str, source: str, measured: Mapping = MappingProxyType({})) -> str:
    """What a row of results is known by: equal for equal settings and equal data (id, what identifies it) alone, and
    for equal further metrics."""
    text = json.dumps([trial.identity() | dict(measured), case, source], sort_keys=True)
    return f"k{zlib.crc32(text.encode()):08x}{zlib.adler32(text.encode()):08x}"


def dotted(settings: Mapping) -> dict:
    """Settings, their names without the init_args of infer.py's configuration files."""
    return {".".join(part for part in str(name).split(".") if part != "init_args"): value
            for name, value in settings.items()}


def check_used(names: Iterable[str], used: set[str], trials: Sequence[Trial]) -> None:
    """Raises ValueError for the first of `names` that is not among the settings that mean anything to the trials."""
    for name in names:
        if name not in used:
            part = name.partition(".")[0]
            owners = {type(trial.method) if part == "method" else type(trial.data.simulator): 0 for trial in trials}
            known = ", ".join(dict.fromkeys(f.name for kind in owners for f in fields(kind)))  # type: ignore[arg-type]
            raise ValueError(f"the setting {name} means nothing to any method or simulator here"
                             + (f", whose fields are {known}" if "." in name else ""))
