"""What is compared: a YAML file of settings and of lists of their values, read into trials."""

from __future__ import annotations

import json
import reprlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from phydict.ablation.cases import Cases, check_path
from phydict.ablation.nested import changed as changed_settings
from phydict.ablation.nested import has_field, parsed
from phydict.ablation.trials import Trial, check_used, dotted, method_of, trials_of
from phydict.datasets import CTSource
from phydict.inference.scoring import CLIPSettings, FIDSettings
from phydict.runtime.reading import naming, refusing
from phydict.runtime.shipped import configuration
from phydict.runtime.yaml_file import parse_yaml, read_yaml


@dataclass(frozen=True)
class Specification:
    """What an ablation runs and where its results go."""

    out: Path
    cases: Cases
    trials: list[Trial]
    metrics: tuple[str, ...] = ("volume",)
    fid: FIDSettings = FIDSettings()
    clip: CLIPSettings = CLIPSettings()


def read_specification(file: str | Path, changes: Sequence[str] | None = None, **given) -> Specification:
    """The specification in a YAML file, or in a shipped one by its name; `given` (out, cts, phantoms, only, reports,
    source, metrics), where not None, takes the place of what the file says, and so do `changes`: settings as
    "name=value", also in place of those of changed methods, of which a list of values is an axis, or as
    "method.setting=value" of one of the file's changed methods.

    Its keys: out; cts or phantoms, only, source: which CTs of the folder are taken, as data.source in infer.py test,
    and reports, short for source.reports; metrics, fid, clip: what is measured, as there; methods: names for changed
    methods, each a mapping of settings and `of`, the method that is changed, by its name or the path of its class;
    base: settings of all trials; axes: setting -> list of values, of which every combination is a trial; or products: a
    list of such bases and axes. A setting that means nothing to a method is left out for it, and what then is the same
    is run once. Raises ValueError, in one sentence, on what cannot be meant.
    """
    content = read_yaml(configuration(file, ("ablate",)))
    changed = {}
    for text in changes or ():
        name, equals, value = text.partition("=")
        if not equals or not name:
            raise ValueError(f"a setting is changed as name=value, such as views=[2,8], but '{text}' was given")
        changed[name] = parse_yaml(value, f"the value of {name}")
    with refusing(file, "correct it"):
        return _specification(content, {k: v for k, v in given.items() if v is not None}, dotted(changed))


def _specification(content, given: Mapping, changed: dict) -> Specification:
    keys = ("out", "cts", "phantoms", "only", "reports", "source", "metrics", "fid", "clip", "methods", "base", "axes",
            "products")
    _check_keys(content, keys, "a specification")
    if "products" in content and "axes" in content:
        raise ValueError("give axes, or products, each with axes of its own, but not both")
    if "cts" in given or "phantoms" in given:
        content = {k: v for k, v in content.items() if k not in ("cts", "phantoms", "only", "reports", "source")}
    source = {**_mapping(content.get("source"), "source"), **given.get("source", {})}
    content = content | given | {"source": source}
    methods = {name: {setting: value for setting, value in _mapping(changes, f"methods.{name}").items()
                      if setting == "method" or not dotted({setting: value}).keys() & changed.keys()}
               for name, changes in _mapping(content.get("methods"), "methods").items()}
    for name in list(changed):
        of_methods = [method for method in methods if name.startswith(f"{method}.")]  # names may hold dots
        if method := max(of_methods, key=len, default=None):
            methods[method] = {**methods[method], name.removeprefix(f"{method}."): changed.pop(name)}
    for name, changes in methods.items():
        if "method" in changes:
            raise ValueError(f"methods.{name} gives method {reprlib.repr(changes['method'])}, but what is changed is "
                             "called `of`, and each of its settings method.<field>, such as method.iterations: 2")
        with naming(f"methods.{name}.of"):
            method_of(changes.get("of", name))
    cases = Cases(content.get("cts"), content.get("phantoms"), content.get("only"), _source(content))
    if content.get("out") is None:
        raise ValueError("there is no folder for the results: give out, in the file or as --out")
    check_path(content["out"], "out")
    products = content.get("products", [{"axes": content.get("axes", {})}])
    if not isinstance(products, list) or not products:
        raise ValueError(f"products is a list of bases and axes, but {products!r} was given")
    common = dotted(_mapping(content.get("base"), "base")) | {
        name: value for name, value in changed.items() if not isinstance(value, list)}
    lists = {name: value for name, value in changed.items() if isinstance(value, list)}
    trials, used, planned = dict[str, Trial](), set[str](), list[Trial]()
    for entry in products:
        _check_keys(entry, ("base", "axes"), "a product")
        base, axes = ({setting: value for setting, value in dotted(_mapping(entry.get(name), name)).items()
                      if setting not in changed} for name in ("base", "axes"))
        axes |= lists
        product, meant = trials_of(common | base, axes, methods, cases, len(planned))
        check_used([*base, *axes], meant, product)
        used, planned = used | meant, planned + product
        for trial in product:
            trials.setdefault(json.dumps(trial.identity(), sort_keys=True), trial)
    check_used(common, used, planned)
    metrics = parsed(list[str], content.get("metrics", ["volume"]), "metrics")
    fid, clip = (_settings(kind(), content.get(name), name) for kind, name in ((FIDSettings, "fid"),
                                                                              (CLIPSettings, "clip")))
    return Specification(Path(content["out"]), cases, list(trials.values()), tuple(metrics), fid, clip)


def _source(content: Mapping) -> CTSource:
    """Which CTs of the folder are taken."""
    source, reports = _settings(CTSource(), content.get("source"), "source"), content.get("reports")
    check_path(reports, "reports")
    if reports is not None and source.reports is not None:
        raise ValueError("the table of reports is given as reports and as source.reports: leave one of the two out")
    return replace(source, reports=reports or source.reports)


def _settings(default, value, name: str):
    """A group of settings, `default` with what a mapping changes."""
    for key in _mapping(value, name):
        if not has_field(default, [key]):
            raise ValueError(f"{name} has no setting {key!r}: use {', '.join(vars(default))}")
    return changed_settings(default, _mapping(value, name), name)


def _mapping(value, name: str) -> Mapping:
    if value is None:
        return {}
    if not isinstance(value, dict):
        raise ValueError(f"{name} is a mapping of names to values, but {reprlib.repr(value)} was given")
    return value


def _check_keys(value, keys: Sequence[str], what: str) -> None:
    if not isinstance(value, dict):
        raise ValueError(f"{what} is a mapping with the keys {', '.join(keys)}, but {reprlib.repr(value)} was given")
    if unknown := [name for name in value if name not in keys]:
        raise ValueError(f"{what} has no key {unknown[0]!r}: use {', '.join(keys)}")
