"""In which precision networks compute: decided here alone, by what the device's hardware does."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache

import torch
from torch import Tensor

from phydict.runtime.warning import warn

PRECISIONS = ("auto", "float32", "bfloat16")
"""What a user may ask for. "auto" is bfloat16 where the hardware computes it, and faster, and float32 elsewhere; a
float64 state stays float64 unless bfloat16 is requested."""

LEAST_GAIN = 1.2
"""How many times faster a CPU's convolutions must be in bfloat16 before "auto" means it: some have instructions for it
that are slower than float32's, such as Intel's with AVX-512 whose AMX is kept from the process."""

SLOWER = {"AVX2": 200, "AVX512": 2}
"""How many times slower than float32 a network is in bfloat16 on CPUs that lack its instructions, by what they have:
AVX2, measured on a Zen 3; AVX-512, with oneDNN kept from bfloat16's instructions."""


def check_precision(precision: str) -> None:
    """Raises ValueError unless `precision` is one of PRECISIONS."""
    if precision not in PRECISIONS:
        raise ValueError(f"precision is {', '.join(PRECISIONS[:-1])} or {PRECISIONS[-1]}, but {precision!r} was given")


def computes_bfloat16(device: torch.device) -> bool:
    """Whether the hardware multiplies bfloat16 itself. On a CPU oneDNN must be allowed to use those instructions."""
    if device.type == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    if device.type != "cpu" or not torch.ops.mkldnn._is_mkldnn_bf16_supported():
        return False
    # On x86 oneDNN says yes to any AVX-512, of which only some have the instructions; on others its answer holds.
    return (torch.cpu._is_avx512_bf16_supported() or torch.cpu._is_amx_tile_supported()
            or not torch.cpu._is_avx2_supported())


@cache
def bfloat16_gain(device: torch.device) -> float:
    """How many times faster than in float32 a network's convolution is in bfloat16 on a CPU that computes it: of the
    fastest of twenty runs of a millisecond each, in turn, once per process."""
    seconds: dict[torch.dtype, list[float]] = {torch.float32: [], torch.bfloat16: []}
    with torch.no_grad():
        for _ in range(20):
            for dtype, taken in seconds.items():
                x = torch.ones(1, 32, 16, 16, 16, dtype=dtype, device=device)
                x, weight = x.to(memory_format=torch.channels_last_3d), x.new_ones(32, 32, 3, 3, 3)
                began = time.perf_counter()
                torch.ops.aten.mkldnn_convolution(x, weight, None, [1] * 3, [1] * 3, [1] * 3, 1)
                taken.append(time.perf_counter() - began)
    fastest = {dtype: min(taken) for dtype, taken in seconds.items()}
    return fastest[torch.float32] / fastest[torch.bfloat16]


def gains_by_bfloat16(device: torch.device) -> bool:
    """Whether networks are faster in bfloat16: on a GPU that computes it they are, a CPU is asked (`bfloat16_gain`)."""
    return computes_bfloat16(device) and (device.type != "cpu" or bfloat16_gain(device) >= LEAST_GAIN)


def resolve_precision(precision: str, device: torch.device, state: torch.dtype = torch.float32) -> torch.dtype:
    """What a network computes in for states of type `state` on `device`.

    Warns, once per process, where that is slow (bfloat16 without the hardware, or slower than float32) or where a GPU
    has no bfloat16. Raises ValueError for a precision that is none of PRECISIONS.
    """
    check_precision(precision)
    if precision == "float32" or (precision == "auto" and state == torch.float64):
        return state
    if gains_by_bfloat16(device):
        return torch.bfloat16
    if precision == "bfloat16":
        _warn_slow(device)
        return torch.bfloat16
    if device.type == "cuda":
        _warn_gpu(torch.cuda.get_device_name(device))
    return state


def trainer_precision(precision: str, device: torch.device) -> str:
    """The name that Lightning's Trainer has for what `precision` means on `device`."""
    return "bf16-mixed" if resolve_precision(precision, device) == torch.bfloat16 else "32-true"


@contextmanager
def network_precision(precision: str, x: Tensor) -> Iterator[torch.dtype]:
    """Networks run inside compute in what `precision` means for the state x; gives that type."""
    chosen = resolve_precision(precision, x.device, x.dtype)
    with torch.autocast(x.device.type, torch.bfloat16, enabled=chosen == torch.bfloat16):
        yield chosen


def precision_name(precision: str, x: Tensor) -> str:
    """What networks compute in for the state x, as results name it ("bfloat16")."""
    return str(resolve_precision(precision, x.device, x.dtype)).removeprefix("torch.")


def instruction_set(device: torch.device) -> str:
    """The instructions that `device` computes with: a CPU's widest vectors, and whether it has bfloat16's ("AVX2",
    "AVX512 with bfloat16"); a GPU's name."""
    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    if device.type != "cpu":
        return device.type
    vectors = torch.backends.cpu.get_cpu_capability()
    if not computes_bfloat16(device):
        return vectors
    return f"{vectors} with {'AMX' if torch.cpu._is_amx_tile_supported() else 'bfloat16'}"


@cache
def _warn_slow(device: torch.device) -> None:
    if computes_bfloat16(device):
        gain = bfloat16_gain(device)
        if gain < 1:
            warn(f"bfloat16 was requested, but this processor ({instruction_set(device)}) computes it {1 / gain:.1f} "
                 "times slower than float32: precision auto or float32 is faster", RuntimeWarning)
        return
    factor = SLOWER.get(torch.backends.cpu.get_cpu_capability()) if device.type == "cpu" else None
    slower = f"about {factor} times slower there than float32" if factor else "slower there than float32"
    warn(f"bfloat16 was requested, but {instruction_set(device)} does not compute it: networks are {slower}; "
         "precision auto or float32 is faster", RuntimeWarning)


@cache
def _warn_gpu(name: str) -> None:
    warn(f"{name} does not compute bfloat16: networks run in float32", RuntimeWarning)
