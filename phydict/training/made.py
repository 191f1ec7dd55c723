"""Volumes for training that are each made once and kept in a file."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from pathlib import Path

import numpy as np
from torch import Tensor
from torch.utils.data import Dataset

from phydict.datasets.cts.cache import write_array
from phydict.runtime.progress_log import log_progress
from phydict.runtime.warning import warn


def mapped_volume(file: Path, make: Callable[[], Tensor]) -> np.ndarray:
    """The volume (X, Y, Z) that a file keeps in half precision, made when missing or damaged; read only where used."""
    if file.is_file():
        try:
            return np.load(file, mmap_mode="r")
        except (ValueError, EOFError) as error:
            warn(f"the cached volume {file} cannot be read ({error}); it is prepared again")
    write_array(file, make().numpy().astype(np.float16))
    return np.load(file, mmap_mode="r")


class MadeOnce(Dataset, ABC):
    """Items that are each made when first drawn, and kept in `folder` as `mapped_volume`s.

    name: what they are called.
    """

    name: str

    def __init__(self, folder: Path, length: int):
        self.folder, self.length = folder, length

    def __len__(self) -> int:
        return self.length

    def __getitem__(self, n: int) -> np.ndarray:
        return mapped_volume(self._file(n), lambda: self._made(n))

    def _file(self, n: int) -> Path:
        return self.folder / f"{n:05d}.npy"

    @abstractmethod
    def _made(self, n: int) -> Tensor:
        """Item n."""

    def log_made(self) -> None:
        """Says how many are made, where some remain."""
        made = sum(self._file(n).is_file() for n in range(self.length))
        if made < self.length:
            log_progress(f"{made} of {self.length} {self.name} are made, the others are when they are first drawn, in "
                         f"{self.folder}", event="made", name=self.name, done=made, of=self.length,
                         out=str(self.folder))
