"""Files and folders that appear whole or not at all, whatever stops the process that writes them, and that replace
nothing of someone else's."""

from __future__ import annotations

import errno
import os
import shutil
import socket
import sys
import zlib
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

if sys.platform != "win32":  # on which nothing is locked, synced or taken for left over
    import fcntl

ASIDE = ".set-aside-by-phydict"
"""What the name of a folder ends in while another takes its place."""

NUMBERING = Path("/proc/self/ns/pid")
"""What Linux has another of where the numbers of processes mean others, as in a container."""


@contextmanager
def atomic_write(final: Path) -> Iterator[Path]:
    """A path of the same ending to write to; when the block ends well that file takes `final`'s place, else it is
    removed. Whoever may read the user's other files may read it, even where a library writes for its owner alone."""
    final.parent.mkdir(parents=True, exist_ok=True)
    part = final.with_name(f".{_writer()}.part.{final.name}")
    try:
        part.touch()
        mode = part.stat().st_mode
        part.unlink()
        yield part
        part.chmod(mode)
        _sync(part)
        part.replace(final)
        _sync(final.parent)
    finally:
        part.unlink(missing_ok=True)


@contextmanager
def atomic_directory(final: Path, wanted: Callable[[], bool] = lambda: True) -> Iterator[Path]:
    """A folder to fill; when the block ends well that folder takes `final`'s place, else it is removed.

    wanted: called once all is written and other processes are locked out, to look at what is in `final`'s place; this
    stays if it returns False or raises.
    """
    partial = _partial(final)
    try:
        shutil.rmtree(partial, ignore_errors=True)  # of a killed process that had this one's number
        partial.mkdir(parents=True)
        yield partial
        for path in (*partial.rglob("*"), partial):
            _sync(path)
        with undisturbed(final.parent):
            if wanted():
                _take_place(partial, final)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


@contextmanager
def undisturbed(folder: Path) -> Iterator[None]:
    """Locks `folder`, if it exists: in the block no process of this machine puts a whole folder into it. Folders that a
    killed process had set aside are put back first."""
    if not folder.is_dir():
        yield
        return
    with _locked(folder):
        for aside in folder.glob(f".*{ASIDE}"):
            _settle(aside.with_name(aside.name[1:].removesuffix(ASIDE)))
        yield


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    if sys.platform == "win32":
        yield
    else:
        handle = os.open(folder, os.O_RDONLY)
        try:
            with suppress(OSError):  # a file system without locks: then the renaming alone must do
                fcntl.flock(handle, fcntl.LOCK_EX)
            yield
        finally:
            os.close(handle)


@contextmanager
def alone_in(folder: Path, option: str) -> Iterator[None]:
    """Makes the folder; raises ValueError where another process is inside with it. `option` is what the user may
    change. A folder that it has made and that nothing was written to is removed.

    However the process ends, the next one may go in at once, even while processes that it forked live on, and removes
    the files that it had begun to write.
    """
    made = not folder.exists()
    folder.mkdir(parents=True, exist_ok=True)
    with open(folder / ".lock", "a") as lock:
        try:
            if sys.platform != "win32":
                os.register_at_fork(after_in_child=lock.close)
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if not os.path.lexists(lock.name):  # whoever made the folder has just removed it
                raise BlockingIOError
        except BlockingIOError as error:
            raise ValueError(f"another run writes to {folder}: wait for its end, or give another {option}") from error
        except OSError:  # a file system without locks
            pass
        remove_leftovers(folder)
        try:
            yield
        finally:
            with suppress(OSError):
                if made and os.listdir(folder) == [".lock"]:
                    os.unlink(lock.name)
                    folder.rmdir()


def atomic_removal(folder: Path, wanted: Callable[[], bool]) -> None:
    """Removes a folder, whole until it is gone; wanted: as for `atomic_directory`."""
    with undisturbed(folder.parent):
        if os.path.lexists(folder) and wanted():
            shutil.rmtree(folder.rename(_partial(folder)), ignore_errors=True)


def check_replaceable(folder: Path, written: Collection[str], option: str) -> None:
    """Raises ValueError where `folder` is a link or holds more than the files `written`, so that it must stay; `option`
    is what the user may change instead."""
    strange = {file.name for file in folder.iterdir() if file.name not in written or not file.is_file()}
    if folder.is_symlink() or strange:
        what = f"holds {', '.join(sorted(strange)[:3])}, which phydict did not write" if strange else "is a link"
        raise ValueError(f"{folder} {what}, and is not replaced: move that away, or give another {option}")


def is_signed(path: Path, mark: str) -> bool:
    """Whether there is a file that says `mark` at its beginning, of what wrote it."""
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return mark.encode() in file.read(1000)


def remove_leftovers(folder: Path) -> None:
    """Removes the unfinished files and folders that dead processes of this machine left in `folder`, and puts back what
    they had set aside."""
    with undisturbed(folder):
        for partial in folder.glob(".*.partial"):
            if _is_of_none(partial.name.removesuffix(".partial")):
                shutil.rmtree(partial, ignore_errors=True)
        for part in folder.glob(".*.part.*"):
            if _is_of_none(part.name.partition(".part.")[0]):
                part.unlink(missing_ok=True)


def _take_place(partial: Path, final: Path) -> None:
    try:
        if os.path.lexists(final):
            final.rename(_aside(final))
        partial.rename(final)
        _sync(final.parent)
    finally:
        _settle(final)


def _settle(final: Path) -> None:
    """Removes what was set aside for `final` if something took its place, and else puts it back."""
    aside = _aside(final)
    if not aside.is_dir():
        return
    if os.path.lexists(final):
        shutil.rmtree(aside.rename(_partial(aside)), ignore_errors=True)  # no part of it is ever taken for the whole
    else:
        aside.rename(final)


def in_between(name: str) -> bool:
    """Whether a folder of this name is just being written, or set aside while another takes its place."""
    return name.startswith(".") and name.endswith((".partial", ASIDE))


def _aside(final: Path) -> Path:
    return final.with_name(f".{final.name}{ASIDE}")


def _partial(final: Path) -> Path:
    return final.with_name(f".{final.name}.{_writer()}.partial")


def machine() -> str:
    """The name of this machine, and of the container where processes have numbers of their own: several containers may
    have the name of their host."""
    name = socket.gethostname()
    return f"{name}-{NUMBERING.stat().st_ino}" if NUMBERING.exists() else name


def _writer() -> str:
    return f"{machine()}.{os.getpid()}"


def _is_of_none(name: str) -> bool:
    """Whether a name ends in the `_writer` of a dead process of this machine."""
    host, _, process = name.rpartition(".")
    return host.endswith("." + machine()) and process.isdigit() and not _runs(int(process))


def _sync(path: Path) -> None:
    """Waits until the disk holds a file or, where the file system can tell, what a folder lists."""
    if sys.platform == "win32":
        return
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.ENOTSUP) or not path.is_dir():  # of a folder, on some shared disks
            raise
    finally:
        os.close(handle)


def _runs(process: int) -> bool:
    if sys.platform == "win32":  # where signal 0 is Ctrl-C
        return True
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        pass
    return True


def files_below(root: Path) -> list[Path]:
    """The files in a folder, at any depth and in linked folders too, each folder once, in order; hidden ones are passed
    over."""
    found, links = [], [root]
    seen = {str(folder) for folder in root.resolve().parents}
    while links:
        for folder, inner, names in os.walk(links.pop(0)):
            real = os.path.realpath(folder)
            inner[:] = sorted(name for name in inner if not name.startswith(".") and real not in seen)
            links += [Path(folder, name) for name in inner if Path(folder, name).is_symlink()]
            if real not in seen:
                found += [Path(folder, name) for name in names if not name.startswith(".")]
            seen.add(real)
    return sorted(path for path in found if path.is_file())


def file_crc32(path: Path, start: int = 0) -> int:
    """CRC-32 of a file's bytes, going on from the checksum `start`; read in pieces, so that any size fits in memory."""
    crc = start
    with path.open("rb") as file:
        while piece := file.read(2**24):
            crc = zlib.crc32(piece, crc)
    return crc
