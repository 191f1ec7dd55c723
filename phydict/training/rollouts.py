"""Training a refiner on stored roll-outs of its reconstructions: many short steps for each of these."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from typing import cast

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset, default_collate

from phydict.datasets import Augmentation, CTSource
from phydict.datasets.cts.cache import key_of
from phydict.grid import Cube
from phydict.posterior import Unrolled
from phydict.prior import DEFAULT_REFINER, BoundRefiner, Refiner, fingerprint, load_prior
from phydict.prior.evidence_channels import EVIDENCE_CHANNELS
from phydict.runtime.ranges import check_fields
from phydict.training.data import PriorData, check_plain
from phydict.training.draws import Draws, Items
from phydict.training.made import MadeOnce
from phydict.training.refiner import RefinerTraining
from phydict.training.scenes import Scenes
from phydict.training.settings import HoldOut, Loading


@dataclass(frozen=True)
class RollOutSettings:
    """Which roll-outs are stored.

    Args:
        count: of them
        scenes: the X-rays that are drawn for them
        initial: the file of the refiner whose calls they hold, tied to model.initial
        source: which CTs of data.cts' folder are taken, as data.source of other stages
    """

    count: int = 300
    scenes: Scenes = Scenes(most_views=16)
    initial: str = str(DEFAULT_REFINER)
    source: CTSource = CTSource()

    def __post_init__(self):
        check_fields(self, "data.rollouts", count=(1, 1_000_000))


@dataclass(frozen=True)
class _Recording(BoundRefiner):
    """Keeps what a refiner is given at each call."""

    inputs: list[Tensor] = field(default_factory=list)

    def refine(self, x: Tensor, t: float, evidence: Tensor) -> Tensor:
        self.inputs.extend([x, evidence])
        return super().refine(x, t, evidence)


class RollOuts(MadeOnce):
    """What a refiner is given at each call of a case's reconstruction, without a report, and last what it should
    answer: (calls (C + EVIDENCE_CHANNELS) + C, X, Y, Z) in half precision, in the prior's range. Masks that are not
    known are NaN.

    Item n is that of draw n, in a scene of its own.
    """

    name = "roll-outs"

    def __init__(self, drawn: Callable[[int], dict], settings: RollOutSettings, method: Unrolled, folder: Path,
                 seed: int):
        super().__init__(folder, settings.count)
        self.drawn, self.settings, self.method, self.seed = drawn, settings, method, seed

    @cached_property
    def _refiner(self) -> Refiner:
        return cast(Refiner, load_prior(self.settings.initial))

    @torch.no_grad()
    def _made(self, n: int) -> Tensor:
        refiner, case = self._refiner, self.drawn(n)
        kinds = refiner.state_channels - 1
        masks = (2 * case["masks"][:, :kinds] - 1).where(case["has_masks"][:, :kinds, None, None, None], torch.nan)
        bound = refiner.bind()
        recording = _Recording(refiner, bound.context, bound.precision, bound.first)
        measurement = self.settings.scenes.measure(case["volume"], np.random.default_rng((self.seed, n)), refiner.grid,
                                                   refiner.window, case.get("fine"))
        for _ in self.method.estimates(recording, measurement):
            pass
        return torch.cat([*recording.inputs, case["volume"], masks], 1)[0]


class Calls(Draws):
    """Single calls of roll-outs: "state" and "evidence" as the network is given them, "call" its number, "volume" and
    "masks" what it should answer; masks are NaN where they are not known."""

    def __init__(self, rollouts: Items, channels: int, length: int, epoch: int, seed: int):
        super().__init__(rollouts, [], 1.0, length, epoch, seed)
        self.channels = channels

    def item(self, drawn: np.ndarray, rng: np.random.Generator) -> dict:
        width = self.channels + EVIDENCE_CHANNELS
        call = int(rng.integers(len(drawn) // width))
        inputs = torch.from_numpy(drawn[call * width:(call + 1) * width].astype(np.float32))
        truth = torch.from_numpy(drawn[-self.channels:].astype(np.float32))
        return {"state": inputs[:self.channels], "evidence": inputs[self.channels:], "call": call, "volume": truth[:1],
                "masks": truth[1:]}


class RollOutData(PriorData):
    """Calls of stored roll-outs for training a refiner.

    Args:
        rollouts: which are stored
        cts: a NIfTI file, or a folder of any depth in CT-RATE's layout or any other
        holdout: what validates instead of training
        phantoms: number of different phantoms
        loading: how the cases of roll-outs are drawn, and how calls
        cache: folder for prepared cases and roll-outs, never inside the CTs' folder
        augmentation: strengths of the random changes of each roll-out's case
        seed: of the draws and of the split into patients
        cube: tied to model.cube
        window: tied to model.window
    """

    def __init__(self, rollouts: RollOutSettings = RollOutSettings(), cts: str | None = None,
                 holdout: HoldOut = HoldOut(), phantoms: int = 2000, loading: Loading = Loading(),
                 cache: str = "runs/cache", augmentation: Augmentation = Augmentation(), seed: int = 0,
                 cube: Cube = Cube(), window: tuple[float, float] = (-1000.0, 1000.0)):
        check_plain(loading)
        super().__init__(cts, rollouts.source, holdout, phantoms, loading, cache, augmentation, seed, cube, window)
        refiner = load_prior(rollouts.initial)
        if not isinstance(refiner, Refiner) or not refiner.grid.same_as(cube.grid()) or refiner.window != self.window:
            raise ValueError(f"roll-outs are a refiner's on {cube.voxels} voxels per side in the HU window {window}, "
                             f"but {rollouts.initial} is none: give a refiner's file as model.initial, and model.cube "
                             "and model.window as its own")
        self.channels, method, made_by = refiner.state_channels, Unrolled(), fingerprint(rollouts.initial)
        self.made_by = {"model.initial": made_by}
        parts = [asdict(rollouts.scenes), made_by, str(method), seed, asdict(augmentation),
                 loading.ct_fraction, self.factor, self.origin()]
        if any(reports := [ct.report for ct in self.cts.cts]):  # whose words decide what may be mirrored or cut off
            parts.append(reports)
        folder = Path(cache) / f"rollouts-{key_of(parts)}"
        self.rollouts = RollOuts(self._case, rollouts, method, folder, seed)

    @cached_property
    def _cases(self) -> Dataset:
        return super().draws(0)

    def _case(self, n: int) -> dict:
        return super().collate([self._cases[n]])

    def draws(self, epoch: int) -> Dataset:
        if not self.trainer or self.trainer.is_global_zero:
            self.rollouts.log_made()
        return Calls(self.rollouts, self.channels, self.loading.epoch_size, epoch, self.seed)

    def collate(self, cases: list[dict]) -> dict:
        return default_collate(cases) if "state" in cases[0] else super().collate(cases)


class ReplayTraining(RefinerTraining):
    """Learns a Refiner from single calls of stored roll-outs (RollOutData), as RefinerTraining does from whole ones.

    A step costs one call and no likelihood step, so that the same seconds hold several times as many. What the network
    is given is what the refiner that made the roll-outs had come to, and not what it would itself: this is for training
    one on, not for beginning. No report is read.
    """

    calls = 1

    def on_fit_start(self) -> None:
        super().on_fit_start()
        if self.method != self.trainer.datamodule.rollouts.method:  # type: ignore[attr-defined]
            raise ValueError("the stored calls were made by Unrolled at its defaults, but model.method has others: "
                             "leave model.method out")

    def batch_loss(self, batch: dict, key: tuple[int, ...] = (0,), rank: int = 0, processes: int = 1) -> Tensor:
        times = torch.tensor(self.method.times + self.method.more_times, device=self.device)[batch["call"]]
        context = self.prior.prior.null.expand(len(times), -1, -1)
        x0, known = self.prior(batch["state"], times, context, batch["evidence"]), ~batch["masks"].isnan()
        return torch.stack([self.call_loss(*case) for case in zip(
            x0.split(1), batch["volume"].split(1), batch["masks"].split(1), known.split(1))]).mean()
