"""Files and folders that appear whole or not at all, whatever stops the process that writes them."""

from __future__ import annotations

import errno
import os
import shutil
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def whole_file(final: Path) -> Iterator[Path]:
    """A path to write to; when the block ends well that file takes `final`'s place, else it is removed."""
    final.parent.mkdir(parents=True, exist_ok=True)
    part = final.with_name(f".{final.name}.{os.getpid()}.part")
    try:
        yield part
        part.replace(final)
    finally:
        part.unlink(missing_ok=True)


@contextmanager
def whole_folder(final: Path) -> Iterator[Path]:
    """A folder to fill; when the block ends well that folder takes `final`'s place, else it is removed."""
    partial = final.with_name(f".{final.name}.{socket.gethostname()}.{os.getpid()}.partial")
    try:
        partial.mkdir(parents=True, exist_ok=True)
        yield partial
        _take_place(partial, final)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def remove_leftovers(folder: Path) -> None:
    """Removes what processes of this machine that are no more had begun to write as folders below `folder`."""
    for partial in folder.glob(".*.partial"):
        host, _, process = partial.name.removesuffix(".partial").rpartition(".")
        if host.endswith("." + socket.gethostname()) and process.isdigit() and not _runs(int(process)):
            shutil.rmtree(partial, ignore_errors=True)


def _take_place(partial: Path, final: Path) -> None:
    while True:  # another process may have finished the same folder in the meantime, with the same result
        try:
            partial.rename(final)
            return
        except OSError as error:
            if error.errno not in (errno.EEXIST, errno.ENOTEMPTY):
                raise
            shutil.rmtree(final)


def _runs(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        pass
    return True
