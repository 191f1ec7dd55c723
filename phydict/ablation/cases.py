"""Where the cases of a comparison come from."""

from __future__ import annotations

import reprlib
from dataclasses import dataclass

from phydict.datasets import CTSource
from phydict.inference.data import ReconstructionData


@dataclass(frozen=True)
class Cases:
    """Where the cases come from: a folder of CTs, or a number of phantoms; `only` and `source` as in infer.py."""

    cts: str | None = None
    phantoms: int | None = None
    only: str | None = None
    source: CTSource = CTSource()

    def __post_init__(self):
        if (self.cts is None) == (self.phantoms is None):
            raise ValueError("the cases are those of a folder, cts, or a number of phantoms: give exactly one of the "
                             "two, in the file or on the command line")
        if self.phantoms is not None and type(self.phantoms) is not int:
            raise ValueError(f"phantoms is a whole number without quotes, but {self.phantoms!r} was given")
        for name in ("cts", "only"):
            check_path(getattr(self, name), name)

    def data(self, **settings) -> ReconstructionData:
        """The simulated X-rays of these cases."""
        kind = {"cts": self.cts} if self.phantoms is None else {"cts": "phantom", "phantoms": self.phantoms}
        return ReconstructionData(only=self.only, source=self.source, **kind, **settings)


def check_path(value, name: str) -> None:
    if not isinstance(value, str | None):
        raise ValueError(f"{name} is the name of a file or folder, but {reprlib.repr(value)} was given")
