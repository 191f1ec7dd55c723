"""Training a refiner on the states of its own unrolled reconstructions."""

from __future__ import annotations

import math
from copy import deepcopy

import numpy as np
import torch
from torch import Tensor

from phydict.grid import Cube
from phydict.posterior import Unrolled
from phydict.prior import DEFAULT_PRIOR, BoundPrior, BoundRefiner, Prior, Refiner, load_prior
from phydict.runtime.ranges import check_between
from phydict.training.scenes import Scenes
from phydict.training.scores import log_error, log_scores
from phydict.training.settings import Optimisation, RefinerValidation
from phydict.training.stage import StageTraining, check_continues
from phydict.units import HUWindow

MEAN_DRAWS = 4
"""Noise draws over which the prior's estimate at time 1 is averaged."""


TEXT_DROPOUT = 0.3
"""Share of the draws whose report is kept from the network."""


class _Learning(BoundRefiner):
    """A refiner of one report whose calls are recorded for gradients, in the precision of the training."""

    def refine(self, x: Tensor, t: float, evidence: Tensor) -> Tensor:
        return self.refiner(x, torch.full((len(x),), float(t), device=x.device), self.context, evidence)


class RefinerTraining(StageTraining):
    """Learns a Refiner: at each call of its own reconstruction, the logarithms of the CT's mean squared and mean
    absolute error.

    The logarithms weigh a dB alike at all numbers of views; the absolute error keeps air empty. What the calls start
    from, and the likelihood steps between them, are those of `method`; no gradient passes through them.

    Args:
        method: the unrolled reconstruction whose calls are learnt
        scenes: the X-rays that are drawn for it
        cube: of voxels
        window: HU that the prior's range [-1, 1] stands for
        optimisation: how the weights are learnt
        validation: what validation measures
        body_weight: how many times more a voxel of the body counts than one of air, plus 1
        mask_weight: weight of the anatomy masks' error beside the CT's
        initial: a prior's file to begin with, or a refiner's to continue from
        seed: of scenes and noise
    """

    prior: Refiner

    def __init__(self, method: Unrolled = Unrolled(), scenes: Scenes = Scenes(), cube: Cube = Cube(),
                 window: tuple[float, float] = (-1000.0, 1000.0), optimisation: Optimisation = Optimisation(),
                 validation: RefinerValidation = RefinerValidation(), body_weight: float = 2.0,
                 mask_weight: float = 0.1, initial: str = str(DEFAULT_PRIOR), seed: int = 0):
        check_between("model.body_weight", body_weight, 0, math.inf)
        check_between("model.mask_weight", mask_weight, 0, math.inf)
        loaded = load_prior(initial)
        if not isinstance(loaded, Prior | Refiner):
            raise ValueError(f"a refiner begins with a prior of phydict's own, but {initial} is MedSyn's: give another "
                             "model.initial")
        check_continues("prior", initial, loaded, cube.grid(), HUWindow(*window))
        refiner = loaded if isinstance(loaded, Refiner) else Refiner(
            loaded, _mean(loaded), first=deepcopy(loaded) if loaded.reads_text else None)
        refiner.uncertainty = None  # of what it was
        super().__init__(refiner.train().requires_grad_(True), optimisation, seed, initial)
        refiner.reader.ready_text()
        if refiner.first is not None:
            refiner.first.requires_grad_(False)
        self.method, self.scenes, self.body_weight, self.mask_weight = method, scenes, body_weight, mask_weight
        self.validation_views = validation.views

    @property
    def calls(self) -> int:  # type: ignore[override]
        """Those of every scene; the further ones of many views (`Unrolled.more_times`) are not counted."""
        return len(self.method.times)

    def batch_loss(self, batch: dict, key: tuple[int, ...] = (0,), rank: int = 0, processes: int = 1) -> Tensor:
        losses = [self._case_loss(*drawn) for drawn in self.drawn(batch, key, rank, processes)]
        return torch.stack(losses).mean()

    def _case_loss(self, case: dict, rng: np.random.Generator) -> Tensor:
        ct, kinds = case["volume"], self.prior.state_channels - 1
        masks, known = 2 * case["masks"][:, :kinds] - 1, case["has_masks"][:, :kinds]
        measurement = self.scenes.measure(ct, rng, self.prior.grid, self.prior.window, case.get("fine"))
        with_report = self.prior.reader.text is not None and rng.random() >= TEXT_DROPOUT
        report = case["report"][0] if with_report else ""
        reader = self.prior.reader
        context, first = self.prior.conditioning(BoundPrior(reader, reader.context([report]), 1.0), bool(report))
        learning = _Learning(self.prior, context, first=first)
        losses = []
        calls = self.method.calls(measurement.projector.beam.views)
        for _, x0 in zip(calls, self.method.estimates(learning, measurement)):  # and not the step after the last
            losses.append(self.call_loss(x0, ct, masks, known))
        return torch.stack(losses).mean()

    def call_loss(self, x0: Tensor, ct: Tensor, masks: Tensor, known: Tensor) -> Tensor:
        """The loss of one call's answer x0 (1, C, X, Y, Z); of the masks (1, C - 1, X, Y, Z) those that are known,
        (1, C - 1) or for each voxel, teach."""
        loss = log_error(x0[:, :1], ct, self.body_weight)
        if bool(known.any()):
            loss = loss + self.mask_weight * ((x0[:, 1:] - masks)[known].square().mean() + 1e-4).log()
        return loss

    def validation_step(self, batch: dict, index: int) -> None:
        log_scores(self, batch, index, self.validation_views, self.method)


@torch.no_grad()
def _mean(prior: Prior) -> Tensor:
    """The state (C, X, Y, Z) that a prior expects at time 1, where there is nothing but noise."""
    noise = torch.randn(MEAN_DRAWS, prior.state_channels, *prior.grid.shape, generator=torch.Generator().manual_seed(0))
    denoiser = prior.bind(precision="float32")
    return torch.stack([denoiser.denoise(one[None], 1.0)[0].clamp(-1, 1) for one in noise]).mean(0)
