"""Reading what users give: no more than a file holds, and whatever is wrong with it in one sentence."""

from __future__ import annotations

import errno
import math
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

MOST_TEXT = 2**24
"""Bytes of the longest text that is read whole: a geometry, settings, a report, a list of ids."""

MOST_SQUEEZED = 1100
"""Times by which a file shrinks at most when it is compressed: deflate, the best of those that are read, 1032."""

MAX_MESSAGE = 800
"""Characters of a sentence about what cannot be read; it may quote a file."""


class Unreadable(ValueError):
    """A file of a user's that cannot be read, in one sentence that names it."""


@contextmanager
def reading(name: object, advice: str) -> Iterator[None]:
    """Whatever a library raises inside while it reads `name` becomes Unreadable: what is wrong, and `advice`.

    For the reading alone: errors of what is computed from a file stay as they are.
    """
    try:
        yield
    except Unreadable:
        raise
    except Exception as error:
        raise Unreadable(f"{name} cannot be read ({reason(error)}); {advice}") from error


@contextmanager
def refusing(name: object, advice: str) -> Iterator[None]:
    """As `reading`, around what has sentences of its own: a ValueError or OSError keeps its sentence, on one line that
    names `name`, at its start unless it does already. Their other kinds, such as UnicodeDecodeError, are no sentences.
    """
    try:
        yield
    except Exception as error:
        if type(error) not in (ValueError, Unreadable) and not isinstance(error, OSError):
            raise Unreadable(f"{name} cannot be read ({reason(error)}); {advice}") from error
        message = one_line(str(error) if str(name) in str(error) else f"{name}: {error}")
        if message == str(error):
            raise
        raise Unreadable(message) from error


@contextmanager
def naming(name: object) -> Iterator[None]:
    """A ValueError that is raised inside begins with `name`, such as the file that it is about."""
    try:
        yield
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from error


def one_line(text: str) -> str:
    """A text without line breaks, cut off after MAX_MESSAGE characters."""
    text = " ".join(text.split())
    return text if len(text) <= MAX_MESSAGE else f"{text[:MAX_MESSAGE]} ..."


def not_written(what: str, error: Exception, instead: str) -> OSError:
    """The error of `what` that could not be written: its reason, to free space where a disk is full, and `instead`."""
    full = getattr(error, "errno", None) in (errno.ENOSPC, errno.EDQUOT) or re.search(
        rf"os error ({errno.ENOSPC}|{errno.EDQUOT})\b", str(error))
    return OSError(f"{what} could not be written ({reason(error)}): {'free some space, or ' if full else ''}{instead}")


def reason(error: BaseException) -> str:
    """An error in a few words, its kind among them where that is not for users."""
    if isinstance(error, RecursionError):
        return "it is nested too deeply"
    message = " ".join(str(getattr(error, "strerror", None) or error).split())[:300]
    if isinstance(error, MemoryError):
        return "it asks for more memory than there is" + (f": {message}" if message else "")
    if isinstance(error, TypeError) and message.startswith("`"):  # Lightning's words on a setting of its own
        return message.rstrip(".")
    if isinstance(error, TypeError | AttributeError | IndexError):  # whose own words tell a user nothing
        unknown = re.search(r"unexpected keyword argument ('\w+')", message)
        return f"it has no setting {unknown[1]}" if unknown else "it holds something of another kind than expected"
    if wrong := re.search(r"^invalid literal for .*?: (.*)|^could not convert string to float: (.*)", message):
        return f"{wrong[1] or wrong[2]} stands where a number is needed"
    plain = isinstance(error, ValueError | OSError | EOFError | SyntaxError) or type(error).__module__ != "builtins"
    return message if message and plain else f"{type(error).__name__} {message}".strip()


def read_text(path: str | Path, most: int = MOST_TEXT) -> str:
    """The text of a UTF-8 file. Raises ValueError naming it where it is another or longer than `most` bytes, and
    OSError as `open` does."""
    path = Path(path)
    size = path.stat().st_size
    if size > most:
        raise Unreadable(f"{path} has {size:,} bytes, but no more than {most:,} of text are read; give another file")
    try:
        return path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise Unreadable(f"{path} is not UTF-8 text ({error}); save it as UTF-8") from error


def name_of(path: str | Path) -> str:
    """The last part of a path as text that can be written anywhere; what is no UTF-8 in it becomes a question mark."""
    return Path(path).name.encode(errors="replace").decode()


def read_ids(path: str | Path, option: str) -> list[str]:
    """The ids in a text file, one a line; `option` is what names the file. Raises as `read_text` does."""
    if not Path(path).is_file():
        raise FileNotFoundError(f"there is no file {path}: give another {option}, a text file of case ids")
    return [line.strip() for line in read_text(path).splitlines() if line.strip()]


def read_npy(path: str | Path) -> np.ndarray:
    """The array in a .npy file. For use inside `reading`: raises ValueError where the file is shorter than its header
    promises, before anything is made for it, and whatever a damaged one leads NumPy to."""
    with open(path, "rb") as stream:
        version = np.lib.format.read_magic(stream)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, _, kind = read(stream)
        promised, held = math.prod(shape) * kind.itemsize, os.fstat(stream.fileno()).st_size - stream.tell()
    if promised > held:
        raise ValueError(f"its header promises {promised:,} bytes, shape {shape}, but the file has {held:,}")
    return np.load(path, allow_pickle=False)


def check_held(promised: int, path: Path, what: str, times: int) -> None:
    """Raises ValueError where a file's header promises more of `what` than `times` as many as the file has bytes."""
    if promised > times * (size := path.stat().st_size):
        raise ValueError(f"its header promises {promised:,} {what} but the file has {size:,} bytes: it is truncated or "
                         "damaged")
