"""Memory: what there is of it, and what a computation frees and asks for again, kept by the process in between.

glibc hands a large piece back to the system as soon as it is free, and the system gives it again page by page, each
cleared: an eighth of the seconds of a reconstruction on 128^3 voxels, on two AVX2 cores, and a sixth on 256^3.
"""

from __future__ import annotations

import ctypes
import math
import os
import platform
import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import Lock

from phydict.runtime.reading import one_line

CONTROL_GROUPS = (Path("/sys/fs/cgroup/memory.max"), Path("/sys/fs/cgroup/memory/memory.limit_in_bytes"))
"""Where Linux says how much memory a container has, as a number of bytes or "max"."""

USAGE = {"memory.max": "memory.current", "memory.limit_in_bytes": "memory.usage_in_bytes"}
"""What of it is in use, by the file of the limit beside it."""

MEMINFO, STATM = Path("/proc/meminfo"), Path("/proc/self/statm")
"""Where Linux says how much memory is free, and how much of it this process holds."""

PIECE, KEPT = 2**27, 2**29
"""Bytes above which a piece is not kept, and of all that is free at the end of the heap and kept."""

AFTERWARDS = 2**25, 2**26
"""The two up to which glibc raises them itself, and at which they are left."""

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3  # of glibc's malloc.h

OWN_CHOICE = "MALLOC_MMAP_THRESHOLD_", "MALLOC_TRIM_THRESHOLD_", "MALLOC_MMAP_MAX_", "GLIBC_TUNABLES"
"""Environment variables by which a user has settled it."""

LOADERS = re.compile("unable to allocate shared memory|DataLoader worker .* is killed by signal: (Bus error|Killed)")
"""What torch says where processes that load data lack memory, their own or what they share, of which Docker gives a
container 64 MiB."""

_inside, _counting = 0, Lock()


class TooLittleMemory(ValueError):
    """This machine has too little memory; a larger one could do it."""


def check_memory(needed: int, what: str, advice: str, now: bool = False) -> None:
    """Raises TooLittleMemory, with both numbers, where `what` takes more bytes than this machine, or the container
    that this runs in, has memory; now: or, beside what this process holds, has free at present."""
    there = min([_memory(), *container_limits().values()])
    takes = f"{what} would take {needed / 2**30:,.1f} GiB of memory, but"
    if needed > there:
        raise TooLittleMemory(f"{takes} this machine has {there / 2**30:,.1f}; {advice}")
    if now and (free := free_memory()) is not None and needed > free:
        raise TooLittleMemory(f"{takes} of the {there / 2**30:,.1f} that this machine has other programs leave "
                              f"{free / 2**30:,.1f} at present; end some of them, or {advice}")


def _memory() -> float:
    """Bytes of memory that this machine has; infinite on Windows, which is not asked."""
    if sys.platform == "win32":
        return math.inf
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")


def free_memory() -> int | None:
    """Bytes of memory and swap that are free or that this process holds, in a container of what it may use; None where
    the system does not say."""
    if sys.platform == "win32":
        return None
    try:
        kilobytes = dict(line.split()[:2] for line in MEMINFO.read_text().splitlines())
        own = int(STATM.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
        free = [1024 * (int(kilobytes["MemAvailable:"]) + int(kilobytes.get("SwapFree:", 0)))]
        for path, limit in container_limits().items():
            stat = dict(line.split() for line in path.with_name("memory.stat").read_text().splitlines())
            files = sum(int(stat.get(f"total_{kind}", stat.get(kind, 0))) for kind in ("inactive_file", "active_file"))
            free.append(limit - int(path.with_name(USAGE[path.name]).read_text()) + files)  # which give way
    except (OSError, KeyError, ValueError):
        return None
    return min(free) + own


@contextmanager
def enough_memory() -> Iterator[None]:
    """Raises TooLittleMemory where main memory, a device's or what processes share gives out inside."""
    try:
        yield
    except (MemoryError, RuntimeError) as error:
        if LOADERS.search(text := str(error)):
            raise TooLittleMemory(f"the processes that load data lack memory ({one_line(text.splitlines()[-1])}): "
                                  "give the container more in /dev/shm, as docker run --shm-size does, fewer "
                                  "data.loading.workers, or 0, or a smaller batch") from error
        device = type(error).__name__ == "OutOfMemoryError"  # torch's, which takes long to import
        if not (device or isinstance(error, MemoryError) or "can't allocate memory" in str(error)):
            raise
        raise TooLittleMemory(f"memory gave out ({one_line(str(error)) or 'MemoryError'}): give fewer voxels, fewer "
                              "samples or a smaller batch, or use a machine with more") from error


def container_limits() -> dict[Path, int]:
    """Bytes of memory that control groups of either version allow, where they say so, by the file that does."""
    texts = {path: path.read_text().strip() for path in CONTROL_GROUPS if os.access(path, os.R_OK)}
    return {path: int(text) for path, text in texts.items() if text.isdigit()}


@contextmanager
def freed_memory_kept(needed: int) -> Iterator[None]:
    """While something is inside, in any thread, the process keeps what it frees; afterwards it hands that back.

    needed: bytes that what is inside takes without this, and up to twice as many with it. Where those are not free,
    without glibc, and where the environment has OWN_CHOICE, nothing changes.
    """
    global _inside
    glibc, chosen = platform.libc_ver()[0] == "glibc", any(name in os.environ for name in OWN_CHOICE)
    if not glibc or chosen or (free_memory() or 0) < 2 * needed:
        yield
        return
    libc = ctypes.CDLL(None)
    with _counting:
        _inside += 1
        _set_thresholds(libc, PIECE, KEPT)
    try:
        yield
    finally:
        with _counting:
            _inside -= 1
            if not _inside:
                _set_thresholds(libc, *AFTERWARDS)
                libc.malloc_trim(0)


def _set_thresholds(libc: ctypes.CDLL, piece: int, kept: int) -> None:
    libc.mallopt(M_MMAP_THRESHOLD, piece)
    libc.mallopt(M_TRIM_THRESHOLD, kept)
