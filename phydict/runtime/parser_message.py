"""What the command line's parser says of a setting that it refuses, as a sentence for a user."""

from __future__ import annotations

import inspect
import re
from argparse import ArgumentError, ArgumentParser
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from difflib import get_close_matches
from pydoc import locate

from phydict.runtime.own_code import imported

KINDS = {"int": "a whole number", "float": "a number", "bool": "true or false", "str": "a text", "list": "a list",
         "tuple": "a list", "dict": "a mapping of settings"}
"""How sentences name the types of settings."""

UNLOADED = re.compile(r"""Parser key "([^"]+)": Unable to load config (['"])(.*?)\2 - (Parser key .*)""")
NESTED = re.compile(r"""Problem with given class_path '[^']*': Parser key "([^"]+)": (.*)""")
PROBLEM = re.compile(r"Problem with given class_path '([^']*)': (.*?)(?= - | Given value type: |$)")
UNION = "Does not validate against any of the Union subtypes"
PARSERS = re.compile(r"Import path|Expected an? |Problem with given|Not a valid|Does not validate|Parser key|Unable to")
"""The parser's own words on one of several types, unlike those of a class that refuses its settings."""

GIVEN = re.compile(r"(?:Got|Given) value: (.*?)(?= Given value type: | Subclass types expect | - [A-Z]\w+ |$)|"
                   r"Expected a path but (.*?) either not ")


UNKNOWN = re.compile(r"unrecognized arguments: (\S+)|Subcommand '\w+' does not accept option '(.*)'")
"""What the parser says of an option, on the command line or in a configuration, that it does not know."""


@contextmanager
def naming_unknown_options(*parsers: ArgumentParser) -> Iterator[None]:
    """An option that parsers refuse inside as unknown is raised as a ValueError that names the nearest of theirs."""
    try:
        yield
    except ArgumentError as error:
        unknown = UNKNOWN.search(str(error))
        if unknown is None:
            raise
        given = unknown[1] or f"--{unknown[2]}"
        known = [option for parser in parsers for option in parser._option_string_actions]
        meant = _meant(given.partition("=")[0], known)
        raise ValueError(f"there is no option {_short(given)}: {meant}--help lists what there is") from error


def _meant(given: str, known: Collection[str]) -> str:
    """Asks whether the known name with the same last part was meant, else one of as many parts that is spelled nearly
    alike; empty where there is none."""
    last = given.lstrip("-").split(".")[-1]
    named = [name for name in known if len(last) > 1 and name.lstrip("-").split(".")[-1] == last]
    deep = [name for name in known if name.count(".") == given.count(".")]
    near = get_close_matches(given, named, 1, 0) or get_close_matches(given, deep, 1, 0.75)
    return f"did you mean {near[0]}? " if near else ""


def plain(message: str) -> str:
    """jsonargparse's message about one setting as a sentence: its name, what it may be and what was given. Empty for
    any other message."""
    text = " ".join(message.split())
    if flag := re.fullmatch(r"argument (--\S+): ignored explicit argument '(.*)'", text):
        return f"{flag[1]} takes no value, but {_short(flag[2])} was given"
    if unloaded := UNLOADED.match(text):
        return (f"{unloaded[1]} is a mapping of settings, but {_short(unloaded[3])} was given"
                if ": Unable to load config " in unloaded[4] else plain(unloaded[4]))
    start = re.match(r'Parser key "([^"]+)": ', text)
    reasons = re.split(r"\n\s*- ", message.partition("Given value type")[0])[1:] if UNION in text else []
    ours = "; ".join(dict.fromkeys(" ".join(reason.split()) for reason in reasons if not PARSERS.match(reason)))
    if not start:
        return ours
    key = start[1]
    if nested := NESTED.search(text):
        inside = "" if "phydict.grid.Box" in text else ".init_args"
        return plain(f'Parser key "{key}{inside}.{nested[1]}": {nested[2]}')
    if problem := PROBLEM.search(text):
        return _of_class(key, problem[1], problem[2])
    given = next((value[1] or value[2] for value in GIVEN.finditer(text)), "something else")
    given = _short(re.sub(r"^NestedArg\(key='\w+', val=(.*)\)$", r"\1", given))
    if "is abstract" in text and "." not in given:
        return f"{key} is the path of a class, but {given} was given: settings of a method come after its name"
    if "is abstract" in text:
        return f"{key} is the path of a class that can be used, but {given} is abstract: give one derived from it"
    wanted = _wanted(text)
    if not wanted and (fault := _import_fault(given, ours)):
        return f"{key} is the path of a class, but {given} cannot be imported: {fault}"
    return f"{key} is {wanted}, but {given} was given" if wanted else f"{key}: {ours or text[len(start[0]):]}"


def _of_class(key: str, path: str, reason: str) -> str:
    if option := re.fullmatch(r"Option '(.*)' is not accepted", reason):
        known = inspect.signature(kind).parameters if callable(kind := locate(path)) else ()
        return f"{key}: {path} has no setting {option[1]}: {_meant(option[1], known)}--help lists what it has"
    if reason.endswith("has no attribute 'keys'"):
        return f"{key}.init_args is a mapping of the settings of {path}, but something else was given"
    fault = _import_fault(path, reason)
    return f"{key} is the path of a class, but {path} cannot be imported: {fault}" if fault else f"{key}: {reason}"


def _import_fault(path: str, reason: str) -> str:
    """Why a class cannot be imported, where the parser's reason is the same; empty where that is another."""
    try:
        imported(path)
    except ValueError as error:
        told = " ".join(str(error.__cause__ or "").split())
        return str(error) if told == reason or "has no attribute" in reason else ""
    return ""


def _wanted(text: str) -> str:
    """What a setting holds, by all types that the parser tried."""
    kinds = [KINDS[kind] for kind in re.findall(r"Expected an? <class '(\w+)'>", text) if kind in KINDS]
    kinds += [f"a list of {size}" for size in re.findall(r"Expected a tuple with (\d+) elements", text)]
    if "phydict.grid.Box" in text:
        return " or ".join([*kinds, KINDS["dict"]])
    kinds += ["the path of a class"] * bool(re.search("dot import path|import path format", text))
    kinds += [f"the path of a {name}" for name in re.findall(r"(?:to a|valid) subclass of (\w+)", text)]
    names = [name.strip(" '") for listed in re.findall(r"Expected a typing\.Literal\[(.*?)\]", text)
             for name in listed.split(",")]
    kinds += [f"one of {', '.join(dict.fromkeys(names))}"] * bool(names)
    return " or ".join(dict.fromkeys(kinds))


def _short(text: str) -> str:
    text = text.strip("'\"")
    return text if len(text) <= 80 else f"{text[:40]}...{text[-30:]}"
