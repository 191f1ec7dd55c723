"""The norm of a linear operator."""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor


def operator_norm(forward: Callable[[Tensor], Tensor], adjoint: Callable[[Tensor], Tensor], start: Tensor,
                  tolerance: float = 1e-5, iterations: int = 200) -> float:
    """The largest singular value, approached from below by power iteration to a relative change of `tolerance`.

    start: not orthogonal to the leading singular vector. Of an operator without negative entries that vector has none
    either (Perron & Frobenius), so a positive start always reaches it.
    """
    x, norm, last = start, 0.0, -1.0
    for _ in range(iterations):
        if abs(norm - last) <= tolerance * norm:
            break
        x, last = adjoint(forward(x / x.norm())), norm
        norm = float(x.norm()) ** 0.5
    return norm
