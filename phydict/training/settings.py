"""Settings of a training and of its data, in groups."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

from phydict.datasets.population import PopulationSettings
from phydict.runtime.ranges import check_between, check_fields
from phydict.runtime.reading import read_ids
from phydict.runtime.warning import warn

MOST_DRAWS, MOST_WORKERS = 10_000_000, 1000
"""Draws of an epoch are listed before it begins, and loader processes are all started then."""

MOST_LEARNING_RATE = 1e30
"""Steps of a larger one do not fit into float32."""


@dataclass(frozen=True)
class TextSettings:
    """What a prior reads reports with, and how it learns to.

    Args:
        encoder: "small" for a BERT that learns reports first (none where the data have no reports), a folder or hub id
            for a frozen one, "none" for a prior without text
        length: tokens of a report that a frozen encoder reads
        padded_to: 2048, with a length of 192, for contexts as MedSyn's; none given: padding is hidden
        reports: texts that the small BERT's vocabulary is learnt from (taken from the data)
        texts: a file of more such texts, one a line or one JSON object a line with its text under "text" or "caption"
        dropout: share of reports replaced by the null context, in [0, 1]
        pretrain_steps: steps in which a new small BERT and the map of kinds learn written reports before denoising
            begins; 0: they learn by denoising
        frozen: a small BERT that has learnt reports, and the map of kinds, are left as they are by denoising
        renew: a prior given as model.initial gets a new text side
    """

    encoder: str = "small"
    length: int = 128
    padded_to: int | None = None
    reports: list[str] | None = None
    texts: str | None = None
    dropout: float = 0.1
    pretrain_steps: int = 2000
    frozen: bool = True
    renew: bool = False

    def __post_init__(self):
        check_between("model.text.dropout", self.dropout)
        check_between("model.text.pretrain_steps", self.pretrain_steps, 0, math.inf)


@dataclass(frozen=True)
class Optimisation:
    """How weights are learnt.

    Args:
        learning_rate: of AdamW
        weight_decay: of AdamW
        warmup: steps over which the learning rate rises
        decay_from: step at which a linear decay of the learning rate to zero begins
        decay_steps: length of that decay in steps; 0: no decay
    """

    learning_rate: float = 5e-4
    weight_decay: float = 0.01
    warmup: int = 100
    decay_from: int = 0
    decay_steps: int = 0

    def __post_init__(self):
        ranges = dict.fromkeys(vars(self), (0, math.inf)) | {"learning_rate": (0, MOST_LEARNING_RATE)}
        check_fields(self, "model.optimisation", **ranges)

    def factor(self, step: int) -> float:
        """The share of the learning rate at a step."""
        rise = min(1.0, (step + 1) / self.warmup) if self.warmup else 1.0
        past = step - self.decay_from
        return rise * (max(0.0, 1 - past / self.decay_steps) if self.decay_steps and past > 0 else 1.0)

    def check_end(self, max_steps: int) -> None:
        """Warns where a training of so many steps does not end with its decay; -1: their number is not given."""
        end = self.decay_from + self.decay_steps
        if self.decay_steps and max_steps not in (-1, end):
            past = f"nothing is learnt after step {end:,}" if max_steps > end else "it does not come to 0"
            warn(f"the learning rate falls to 0 from step {self.decay_from:,} to {end:,}, but trainer.max_steps is "
                 f"{max_steps:,}, so that {past}: set model.optimisation.decay_from and decay_steps to end with it")


@dataclass(frozen=True)
class PriorOptimisation(Optimisation):
    """How a prior's weights are learnt.

    Args:
        sigma_data: standard deviation of the data in the prior's range; a prior that training starts from has its own
        mask_weight: weight of the anatomy masks' error beside the CT's
    """

    sigma_data: float = 0.5
    mask_weight: float = 0.1

    def __post_init__(self):
        super().__post_init__()
        check_between("model.optimisation.sigma_data", self.sigma_data, 1e-3, 1000)
        check_between("model.optimisation.mask_weight", self.mask_weight, 0, math.inf)


@dataclass(frozen=True)
class Previews:
    """What validation shows.

    Args:
        preview_steps: noise levels of the samples that validation paints; 0: none
    """

    preview_steps: int = 16

    def __post_init__(self):
        check_between("model.validation.preview_steps", self.preview_steps, 0, 10_000)


@dataclass(frozen=True)
class PriorValidation(Previews):
    """What validation shows and measures of a prior.

    Args:
        views: X-rays from which validation reconstructs each held-out case by phydict_fast, to tell which weights are
            best; 0: none, as where weights are sharded over devices
    """

    views: int = 4

    def __post_init__(self):
        super().__post_init__()
        check_between("model.validation.views", self.views, 0, math.inf)


@dataclass(frozen=True)
class RefinerValidation:
    """What validation measures of a refiner.

    Args:
        views: numbers of X-rays from which validation reconstructs each held-out case; their mean tells which weights
            are best
    """

    views: tuple[int, ...] = (2, 8)

    def __post_init__(self):
        if not self.views or not all(1 <= count <= 1000 for count in self.views):
            raise ValueError("model.validation.views are one or more numbers between 1 and 1000, but "
                             f"{self.views} was given")


@dataclass(frozen=True)
class CalibrationScenes:
    """What calibrates the uncertainty of a refiner.

    Args:
        scenes: reconstructions of each held-out case, from X-rays that are drawn as training's are
    """

    scenes: int = 12

    def __post_init__(self):
        check_between("model.validation.scenes", self.scenes, 1, 10_000)


@dataclass(frozen=True)
class Execution:
    """How a network is run, which changes no result but for rounding.

    Args:
        gradient_checkpointing: less memory for a second computation of each block's activations
        channels_last: lay the network's channels side by side in memory
        compile: run the network through torch.compile
    """

    gradient_checkpointing: bool = False
    channels_last: bool = True
    compile: bool = False


@dataclass(frozen=True)
class HoldOut:
    """What validates instead of training.

    Args:
        ids: CTs whose id or patient, such as CT-RATE's train_1, is one of these words or, of a word that is neither,
            whose id contains it; or a text file of them, one a line, such as a training's held_out.txt
        fraction: share of the patients, in [0, 1]
        phantoms: a number of phantoms that are never trained on
    """

    ids: list[str] | str | None = None
    fraction: float = 0.0
    phantoms: int = 6

    def __post_init__(self):
        check_between("data.holdout.phantoms", self.phantoms, 0, MOST_DRAWS)
        if isinstance(self.ids, str) and self.ids.startswith("["):
            raise ValueError(f"data.holdout.ids are words, but {self.ids} has numbers among them: quote each, as in "
                             "'[\"0002\"]'")

    @property
    def is_file(self) -> bool:
        """Whether `ids` is a text file."""
        return isinstance(self.ids, str) and (Path(self.ids).is_file() or self.ids.endswith(".txt"))

    def words(self) -> list[str]:
        """The words of `ids`. Raises FileNotFoundError for a text file that is not there."""
        if isinstance(self.ids, str):
            return read_ids(self.ids, "data.holdout.ids") if self.is_file else [self.ids]
        return self.ids or []


@dataclass(frozen=True)
class Loading:
    """How cases are drawn.

    Args:
        epoch_size: draws per epoch
        batch_size: draws per step on each device
        workers: loader processes per device
        ct_fraction: share of draws taken from the CTs, in [0, 1]
        population: new patients drawn from the CTs, which a share of these draws is taken from
        simulation_voxels: for stages that learn from X-rays, voxels per side of the volumes that these are made of, a
            multiple of model.cube.voxels; none given: the model's own
        draw_voxels: voxels per side on which cases are changed before they are averaged to those that are trained on,
            a multiple of these: more keep grain and edges that the changes' interpolation smooths; none given: the same
        reuse: times that a draw is trained on, on average; above 1, each is made once and kept in data.cache
    """

    epoch_size: int = 400
    batch_size: int = 4
    workers: int = 0
    ct_fraction: float = 0.5
    population: PopulationSettings = PopulationSettings()
    simulation_voxels: int | None = None
    draw_voxels: int | None = None
    reuse: int = 1

    def __post_init__(self):
        check_fields(self, "data.loading", epoch_size=(1, MOST_DRAWS), batch_size=(1, MOST_DRAWS),
                     workers=(0, MOST_WORKERS), ct_fraction=(0, 1), reuse=(1, MOST_DRAWS))


@dataclass(frozen=True)
class Crops:
    """The cubes that a super-resolution stage learns from.

    Args:
        size: voxels along each side, a multiple of the factor
        factor: tied to model.factor
        validation: fixed crops of each held-out volume that validate; 0: none
    """

    size: int = 96
    factor: int = 4
    validation: int = 4

    def __post_init__(self):
        check_between("model.factor", self.factor, 1, math.inf)
        check_between("data.crops.validation", self.validation, 0, MOST_DRAWS)
