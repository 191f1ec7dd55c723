"""Rivals as reconstruction methods: X-rays through a trained network, once."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import lru_cache

import torch
from torch import Tensor

from phydict.baselines.baseline import Baseline, CountingProjector
from phydict.grid import Grid
from phydict.reconstruction import Reconstruction, Reconstructor
from phydict.rivals.files import load_rival
from phydict.rivals.rival import Rival
from phydict.runtime.files import file_crc32
from phydict.runtime.precision import check_precision, network_precision, precision_name
from phydict.runtime.shipped import own_or_shipped
from phydict.units import MU_WATER, HUWindow
from phydict.xray import Projector


@dataclass(frozen=True)
class RivalAnswer(Baseline):
    """What a rival makes of X-rays. Display values are matched to a typical chest, as for other baselines.

    seed: of a rival that is random; precision: of its network, see phydict.runtime.precision.
    """

    rival: Rival
    seed: int = 0
    precision: str = "auto"
    mu_water: float = MU_WATER
    name: str = "rival"

    @property
    def grid(self) -> Grid:
        return self.rival.grid

    @property
    def window(self) -> HUWindow:
        return self.rival.window

    def steps(self) -> int:
        return self.rival.network.steps()

    def solve(self, A: CountingProjector, y: Tensor, on_step: Callable[[], None]) -> Tensor:
        self.rival.check(A.grid, A.beam)
        seen = y.float()
        with network_precision(self.precision, seen):
            x = self.rival.reconstruct(seen, A.beam, torch.Generator().manual_seed(self.seed), on_step)
        return self.rival.window.to_mu(x, 1.0).to(y)

    def reconstruct(self, xrays: Tensor, projector: Projector, report: str = "", display: bool = False,
                    seed: int = 0, on_step: Callable[[], None] = lambda: None,
                    outside: Tensor | None = None) -> Reconstruction:
        seeded = replace(self, seed=seed)
        result = super(RivalAnswer, seeded).reconstruct(xrays, projector, report, display, seed, on_step, outside)
        return replace(result, network_calls=self.steps(), precision=precision_name(self.precision, xrays.float()))


@dataclass(frozen=True)
class TrainedRival(Reconstructor):
    """A rival from its file, such as `train.py fit -c configs/rivals/lifted.yaml` and `train.py export` write it.

    It reads no report. Finer voxels are refined from its own; a rival that is bound to one geometry refuses any other.

    Args:
        file: the rival's .safetensors file, or the name of a shipped one, such as data/rivals/lifted_64.safetensors
        precision: of its network: auto, float32 or bfloat16
    """

    file: str | None = None
    precision: str = "auto"
    mu_water: float = MU_WATER
    name: str = "rival"
    weights_crc32: int = field(init=False, default=0)

    def __post_init__(self):
        super().__post_init__()
        check_precision(self.precision)
        if self.file is not None:
            object.__setattr__(self, "weights_crc32", _checksum(self.file))

    @property
    def answer(self) -> RivalAnswer:
        """The method with its weights read. Raises ValueError without a file."""
        if self.file is None:
            raise ValueError("a rival is trained weights, but no file was given: train one by `train.py fit -c "
                             "configs/rivals/<lifted, x2ct or xray2ctpa>.yaml` and `train.py export`, then give its "
                             "file as --model.method.init_args.file, or to ablate as --set <name>.method.file=<file>")
        return RivalAnswer(_loaded(self.file, self.weights_crc32), 0, self.precision, self.mu_water, self.name)

    @property
    def training(self) -> str:
        """In words, how many views the weights are for and how long they learnt, as their file tells. Raises ValueError
        where there is none, or no rival in it."""
        rival = self.answer.rival
        views = f"K = {rival.beam.views}" if rival.beam else "any K"
        return ", ".join([views, *(f"{count:,} {name}" for name, count in rival.budget.items())]
                         if rival.budget else [views, "steps not stated"])

    @property
    def grid(self) -> Grid | None:
        return None if self.file is None else self.answer.rival.grid

    @property
    def window(self) -> HUWindow:
        return self.answer.rival.window

    def steps(self) -> int:
        return self.answer.steps()

    def reconstruct(self, xrays: Tensor, projector: Projector, report: str = "", display: bool = False,
                    seed: int = 0, on_step: Callable[[], None] = lambda: None) -> Reconstruction:
        answer = self.answer
        answer.rival.to(xrays.device)
        return answer.reconstruct(xrays, projector, report, display, seed, on_step)


def _checksum(file: str) -> int:
    try:
        return file_crc32(own_or_shipped(file))
    except OSError as error:
        raise ValueError(f"there is no rival's file {file}: give the .safetensors file that train.py export wrote"
                         ) from error


@lru_cache(4)
def _loaded(file: str, checksum: int) -> Rival:
    """The rival in a file, read once for each of its contents."""
    return load_rival(own_or_shipped(file))
