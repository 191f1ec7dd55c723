"""What --help shows of settings, which are nested dataclasses: each field, its value and its sentence."""

from __future__ import annotations

import shutil
import textwrap
from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass

from docstring_parser import parse
from jsonargparse import ArgumentParser, DefaultHelpFormatter

COLUMN = 24
"""Where the sentences begin."""

CONFIGURATION_HELP = "Path to a configuration file."
"""What jsonargparse says of an option that reads a whole group of settings from a file."""


class HelpFormatter(DefaultHelpFormatter):
    """Leaves out hidden actions, keeps a text's own line breaks, and adds nothing to a sentence that states its
    default."""

    def add_argument(self, action) -> None:
        if not getattr(action, "hidden", False):
            super().add_argument(action)

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        return text if "\n" in text else super()._fill_text(text, width, indent)

    def _get_help_string(self, action) -> str:
        return action.help if "(default: " in (action.help or "") else super()._get_help_string(action)


def arrange_help(parser: ArgumentParser, usage: str, sentences: Mapping[str, str], last: Mapping[str, str]) -> None:
    """Makes a parser's help readable. Hidden options are still accepted.

    usage: one line. sentences: option -> what it does, shown instead of the parser's own sentence. last: name -> title
    of a section that is moved to the end; of the options below such a name only those of `sentences` are shown.
    """
    parser.usage = usage
    for action in parser._actions:
        name = "config" if "--config" in action.option_strings else (action.option_strings or [action.dest])[0][2:]
        if name in sentences:
            action.help = sentences[name]
        elif name.partition(".")[0] in last or (action.help == CONFIGURATION_HELP and name != "config"):
            action.hidden = True  # type: ignore[attr-defined]
    for group in parser._action_groups:
        names = {action.dest.partition(".")[0] for action in group._group_actions}
        if names and names <= set(last):
            group.title = last[min(names)]
        if group.title == "Linked arguments":
            for action in group._group_actions:
                action.hidden = True  # type: ignore[attr-defined]
        if (group.description or "").startswith("Group '"):  # of which every option is tied to another
            group.title = group.description = None
    groups: list = parser._action_groups  # type: ignore[assignment]
    groups.sort(key=lambda group: group.title in last.values())


def show_settings(parser: ArgumentParser, name: str, settings: object, prefix: str) -> None:
    """Puts a section with a method's nested settings, their values and what they mean, before the other sections."""
    width = max(72, min(shutil.get_terminal_size().columns, 120) - 2)
    lines = [line for option, value, sentence in settings_of(settings, prefix)
             for line in _laid_out(f"  {option} {value}".rstrip(), sentence, width)]
    parser.add_argument_group(f"settings of {name}, a {type(settings).__name__}, and their values", "\n".join(lines))
    groups: list = parser._action_groups  # type: ignore[assignment]
    groups.insert(0, groups.pop())


def settings_of(settings: object, prefix: str) -> Iterator[tuple[str, object, str]]:
    """Of nested dataclasses, each field's dotted name, its value, a class where it is settings itself, and its sentence
    in the class's docstring."""
    sentences = {entry.arg_name: " ".join((entry.description or "").split())
                 for entry in parse(type(settings).__doc__ or "").params}
    for field in fields(settings):  # type: ignore[arg-type]
        value, name = getattr(settings, field.name), f"{prefix}.{field.name}"
        nested = is_dataclass(value)
        shown = type(value).__name__ if nested else "null" if value is None else str(value).lower() if isinstance(
            value, bool) else value
        yield name, shown, sentences.get(field.name, "")
        if nested:
            yield from settings_of(value, name)


def _laid_out(option: str, sentence: str, width: int) -> list[str]:
    lines = textwrap.wrap(sentence, width - COLUMN, break_long_words=False, break_on_hyphens=False)
    indented = [" " * COLUMN + line for line in lines]
    if len(option) > COLUMN - 2 or not lines:
        return [option, *indented]
    return [option.ljust(COLUMN) + lines[0], *indented[1:]]
