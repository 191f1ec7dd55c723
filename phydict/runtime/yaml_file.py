"""Settings in YAML as a stranger may write them: bounded, nothing taken silently, and every refusal names file and key.

Unlike YAML 1.1, dates are text and 1e3 is a number, as on the command line. Aliases and merges are obeyed as long as
they repeat little.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import NoReturn

import yaml

from phydict.runtime.reading import read_text, reason

MOST_DEEP, MOST_DIGITS, MOST_VALUES, MOST_REPEATED = 32, 100, 250_000, 10_000
"""Levels of nesting, characters of a number, values of a file, and how many of these aliases may repeat in all."""

TAG = "tag:yaml.org,2002:"
PLAIN = tuple(TAG + name for name in ("null", "bool", "int", "float", "str"))


class _Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
    """YAML's parser and its words for numbers and the like."""


_Loader.yaml_implicit_resolvers = {
    letter: [(tag, pattern) for tag, pattern in resolvers if tag != TAG + "timestamp"]
    for letter, resolvers in _Loader.yaml_implicit_resolvers.items()}
_Loader.add_implicit_resolver(TAG + "float", re.compile(r"[-+]?[0-9][0-9_]*(\.[0-9_]*)?[eE][-+]?[0-9]+$"),
                              list("-+0123456789"))


def read_yaml(path: str | Path) -> object:
    """What a YAML file holds: mappings, lists, text, numbers, true, false and null.

    Raises ValueError naming the file, and the key where there is one, for what is no YAML, no UTF-8, too long, too
    deep or repeats itself too often, for keys that are given twice, numbers of hundreds of digits and values of other
    kinds; OSError as `open` does.
    """
    return parse_yaml(read_text(path), path)


def parse_yaml(text: str, name: object) -> object:
    """What a text of YAML holds, as `read_yaml` reads that of a file; `name` is what to call it. Raises ValueError."""
    try:
        return _Reader(name, text).document()
    except yaml.YAMLError as error:
        tabs = [n for n, line in enumerate(text.splitlines(), 1) if "\t" in line[:len(line) - len(line.lstrip())]]
        if tabs:
            raise ValueError(f"{name} is not valid YAML: line {tabs[0]} is indented by a tab, where YAML wants "
                             "spaces") from error
        raise ValueError(f"{name} is not valid YAML: {' '.join(str(error).split())}") from error


class _Reader:
    """Builds the values of a file event by event, so that nothing is built that is refused."""

    def __init__(self, path: object, text: str):
        self.path, self.loader = path, _Loader(text)
        self.anchors: dict[str, tuple[object, int]] = {}
        self.values = self.repeated = 0

    def document(self) -> object:
        """The one document of the file, None where it is empty."""
        self.loader.get_event()
        if self.loader.check_event(yaml.StreamEndEvent):
            return None
        self.loader.get_event()
        value = self.value("", 0)
        self.loader.get_event()
        if not self.loader.check_event(yaml.StreamEndEvent):
            self.refuse("", "it holds several documents; keep one")
        return value

    def refuse(self, key: str, what: str) -> NoReturn:
        raise ValueError(f"{self.path}: `{key}` {what}" if key else f"{self.path}: {what}")

    def value(self, key: str, depth: int) -> object:
        """The next value, which belongs to `key`."""
        event = self.loader.get_event()
        if isinstance(event, yaml.AliasEvent):
            return self.alias(event, key)
        if depth > MOST_DEEP:
            self.refuse(key[:60], f"is nested more than {MOST_DEEP} levels deep; give a flat value")
        self.values += 1
        if self.values > MOST_VALUES:
            self.refuse("", f"it holds more than {MOST_VALUES:,} values; give a smaller file")
        before = self.values
        if isinstance(event, yaml.ScalarEvent):
            value = self.scalar(event, key)
        else:
            if event.tag not in (None, "!", TAG + "seq", TAG + "map"):
                self.refuse(key, f"is of the kind {event.tag}, which is not read; give a plain value")
            sequence = isinstance(event, yaml.SequenceStartEvent)
            value = self.sequence(key, depth) if sequence else self.mapping(key, depth)
            self.loader.get_event()
        if event.anchor:
            self.anchors[event.anchor] = value, self.values - before + 1
        return value

    def alias(self, event: yaml.AliasEvent, key: str) -> object:
        if (known := self.anchors.get(event.anchor or "")) is None:
            self.refuse(key, f"refers to *{event.anchor}, which nothing before it defines; write its value")
        value, size = known
        self.values += size
        self.repeated += size
        if self.repeated > MOST_REPEATED:
            self.refuse(key, f"repeats more than {MOST_REPEATED:,} values by aliases (*{event.anchor}); write out what "
                             "is meant")
        return value

    def scalar(self, event: yaml.ScalarEvent, key: str) -> object:
        tag = event.tag
        if tag in (None, "!"):
            tag = self.loader.resolve(yaml.ScalarNode, event.value, event.implicit)
            tag = tag if tag in PLAIN else TAG + "str"
        if tag not in PLAIN:
            self.refuse(key, f"is of the kind {tag}, which is not read; give a plain value")
        if tag in (TAG + "int", TAG + "float") and len(event.value) > MOST_DIGITS:
            self.refuse(key, f"is a number of {len(event.value)} characters; give one that can be meant")
        try:
            return self.loader.construct_object(yaml.ScalarNode(tag, event.value))
        except Exception as error:
            self.refuse(key, f"cannot be read ({reason(error)}); give a plain value")

    def sequence(self, key: str, depth: int) -> list:
        items: list[object] = []
        while not self.loader.check_event(yaml.SequenceEndEvent):
            items.append(self.value(f"{key}[{len(items)}]", depth + 1))
        return items

    def mapping(self, key: str, depth: int) -> dict:
        merged: dict = {}
        mapping: dict = {}
        while not self.loader.check_event(yaml.MappingEndEvent):
            event = self.loader.peek_event()
            merge = isinstance(event, yaml.ScalarEvent) and event.value == "<<" and event.implicit[0]
            name = self.value(key, depth + 1)
            if isinstance(name, list | dict):
                self.refuse(key, "has a list or a mapping as a key; give a name")
            inner = f"{key}.{name}" if key else f"{name}"
            if name in mapping:
                self.refuse(inner, "is given twice; keep one of them")
            value = self.value(inner, depth + 1)
            if not merge:
                mapping[name] = value
                continue
            for part in value if isinstance(value, list) else [value]:
                if not isinstance(part, dict):
                    self.refuse(inner, "merges what is no mapping; give a mapping")
                merged = part | merged
        return merged | mapping
