"""Seeds: the only source of randomness."""

from __future__ import annotations

import zlib
from numbers import Integral


def case_seed(seed: int, case: str) -> int:
    """The seed of a case of infer.py's test and ablate, by the run's seed and the case's id: zlib.crc32 of the text
    "<seed>/<id>". It decides the noise of the case's X-rays and their reconstruction, whatever the method and the other
    cases are."""
    return zlib.crc32(f"{seed}/{case}".encode())


def check_seed(seed: int, name: str = "a seed") -> None:
    """Raises ValueError, with the name of the setting, unless a seed is a whole number that random generators take."""
    if isinstance(seed, bool) or not isinstance(seed, Integral) or not 0 <= int(seed) < 2**32:
        raise ValueError(f"{name} is a whole number from 0 to 2^32 - 1, but {seed} was given")
