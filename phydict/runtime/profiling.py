"""What the stages of a computation take: seconds, calls and peak memory, measured while someone asks, else free.

The peak is that of the process' resident memory on Linux, where the kernel's mark can be set back before each stage;
on macOS it is the largest so far, on Windows unknown. On a CUDA device it is also that of the tensors there.
"""

from __future__ import annotations

import math
import re
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import torch

if sys.platform != "win32":
    import resource

MIB = 2**20
"""Bytes in the unit that every amount of memory is measured in, whatever name its column has kept."""

CPU, CUDA = torch.device("cpu"), torch.device("cuda")

_running: Profile | None = None
_set_back = 0.0  # the process' highest peak before one that `reset_peak_memory` began anew


@dataclass
class StageUsage:
    """What a stage took in all its calls: seconds, and the peaks in MiB of the process and of the device."""

    calls: int = 0
    seconds: float = 0.0
    peak_mib: float = 0.0
    device_mib: float = 0.0


class Profile:
    """Uses by stage; a stage inside another is named `outer / inner`, and its peak counts for both.

    memory: whether peaks are looked at, which takes a tenth of a millisecond for every stage.
    """

    def __init__(self, memory: bool):
        self.memory = memory
        self.uses: dict[str, StageUsage] = {}
        self._open: list[str] = []

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        self._mark()
        self._open.append(f"{self._open[-1]} / {name}" if self._open else name)
        use = self.uses.setdefault(self._open[-1], StageUsage())
        began = time.perf_counter()
        try:
            yield
        finally:
            _wait()
            use.seconds += time.perf_counter() - began
            use.calls += 1
            self._mark()
            self._open.pop()

    def _mark(self) -> None:
        """Gives the peaks since the last mark to every open stage."""
        _wait()
        if not self.memory:
            return
        process, device = peak_memory(CPU), peak_memory(CUDA) if torch.cuda.is_initialized() else 0.0
        reset_peak_memory(CPU)
        if torch.cuda.is_initialized():
            reset_peak_memory(CUDA)
        for name in self._open:
            use = self.uses[name]
            use.peak_mib, use.device_mib = max(use.peak_mib, process), max(use.device_mib, device)

    def seconds(self, *stages: str) -> dict[str, float]:
        """Seconds of each of the innermost `stages` that ran, whatever they ran in."""
        by_stage = {name: [use.seconds for use in self._of(name)] for name in stages}
        return {name: sum(seconds) for name, seconds in by_stage.items() if seconds}

    def calls(self, stage: str) -> int:
        """How often a stage ran, whatever it ran in."""
        return sum(use.calls for use in self._of(stage))

    def _of(self, stage: str) -> list[StageUsage]:
        return [use for full, use in self.uses.items() if full.split(" / ")[-1] == stage]

    def table(self) -> str:
        """One line per stage."""
        on_device = any(use.device_mib for use in self.uses.values())
        width = max((len(name) for name in self.uses), default=5)
        lines = [f"{'stage':{width}s}  {'calls':>6s}  {'seconds':>8s}  {'peak MiB':>8s}" + "  device MiB" * on_device]
        for name, use in self.uses.items():
            lines.append(f"{name:{width}s}  {use.calls:6d}  {use.seconds:8.3f}  {use.peak_mib:8.0f}"
                         + f"  {use.device_mib:10.0f}" * on_device)
        return "\n".join(lines)


@contextmanager
def profiled(memory: bool = True) -> Iterator[Profile]:
    """A profile of the stages that run inside."""
    global _running
    before, _running = _running, Profile(memory)
    try:
        yield _running
    finally:
        _running = before


@contextmanager
def stage(name: str) -> Iterator[None]:
    """A stage of a computation; without a profile nothing is measured."""
    if _running is None:
        yield
    else:
        with _running.stage(name):
            yield


def _wait() -> None:
    if torch.cuda.is_initialized():
        torch.cuda.synchronize()


def reset_peak_memory(device: torch.device) -> bool:
    """Begins `peak_memory` anew; False where the system does not let that of a process be, as outside Linux."""
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
        return True
    global _set_back
    _set_back = max(_set_back, peak_memory(CPU))
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        return False
    return True


def peak_memory(device: torch.device) -> float:
    """The most memory in MiB since `reset_peak_memory`: of the tensors on a CUDA device, of the process on others,
    NaN where the system does not tell."""
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device) / MIB
    try:
        peak = re.search(r"VmHWM:\s+(\d+) kB", Path("/proc/self/status").read_text())
    except OSError:
        peak = None
    if peak is not None:
        return int(peak[1]) * 1024 / MIB
    if sys.platform == "win32":
        return math.nan
    else:
        unit = 1 if sys.platform == "darwin" else 1024
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / MIB


def process_peak() -> float:
    """The most memory in MiB that the process ever had, whatever `reset_peak_memory` began anew."""
    return max(peak_memory(CPU), _set_back)


class Stopwatch:
    """Seconds spent per named stage of a reconstruction."""

    def __init__(self):
        self.seconds: dict[str, float] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        began = time.perf_counter()
        try:
            with stage(name):
                yield
        finally:
            _wait()
            self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - began
