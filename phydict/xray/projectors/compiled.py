"""How the projectors' loops are compiled."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from numba import njit

LOOPS_ALONE = {"prange": True} | dict.fromkeys(
    ("comprehension", "reduction", "inplace_binop", "setitem", "numpy", "stencil", "fusion"), False)
"""What numba runs on several threads: prange loops, but not array expressions, whose compilation takes seconds."""


def compiled(fastmath: bool | set[str] = False, parallel: bool = False) -> Callable[[Callable], Callable]:
    """Compiles a function at its first call; it runs without the GIL, with such liberties in arithmetic as `fastmath`,
    and its prange loops on several threads where `parallel` says so.

    The machine code is kept for other processes in NUMBA_CACHE_DIR, beside the source or in the user's cache folder,
    the first of them that can be written to; where none can, every process compiles anew. It is made anew when the
    function's own file changes, not when that of a compiled function it calls does: such a change needs both.
    """
    threads: Any = LOOPS_ALONE if parallel else False

    def decorate(function: Callable) -> Callable:
        try:
            return njit(nogil=True, cache=True, fastmath=fastmath, parallel=threads)(function)
        except RuntimeError:  # numba found no such folder
            return njit(nogil=True, fastmath=fastmath, parallel=threads)(function)

    return decorate
