"""Frechet distance of slices, in three planes (2.5D FID), of reconstructions to the truth's of all cases.

    FID = |m - n|^2 + tr(S + T - 2 (S T)^(1/2))      means m, n and covariances S, T of the features of slices

Heusel et al. 2017, arXiv:1706.08500; Dowson & Landau 1982, doi:10.1016/0047-259X(82)90077-X. With S = A'A and T = B'B
the last trace is the sum of the singular values of A B', also where the slices are fewer than the features. The number
depends on the backbone, on the number of slices and on their size: compare at equal ones alone. Few slices make it too
large, and so do the bootstrap's repeated ones: its interval may lie above the number.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from safetensors.torch import load_file, save_file
from torch import Tensor
from torchmetrics import Metric
from torchmetrics.utilities.data import dim_zero_cat

from phydict.datasets.cts.ct_rate import patient_of
from phydict.evaluation.backbones import DIMENSIONS, SliceFeatures
from phydict.evaluation.bootstrap import Estimate, draws, percentiles
from phydict.evaluation.planes import PLANES
from phydict.runtime.files import atomic_write

NAMES = (*(f"fid_{plane}" for plane in PLANES), "fid")
"""The distances of the planes, and their mean."""

Features = dict[str, Tensor]
"""Plane -> features (2, N, d) of a case's slices: of the reconstruction and of the truth."""


def case_features(network: SliceFeatures, hu: Tensor, truth: Features | Tensor) -> Features:
    """The features of a volume's slices (X, Y, Z) in HU beside the truth's, another volume or found before."""
    return {plane: torch.stack([network(hu, plane), truth[plane][1] if isinstance(truth, dict) else
                                network(truth, plane)]) for plane in PLANES}


def save_features(file: Path, features: Features) -> None:
    """Writes the features of a case as safetensors."""
    with atomic_write(file) as part:
        save_file({plane: values.contiguous() for plane, values in features.items()}, part)


def load_features(file: Path, backbone: str) -> Features:
    """What `save_features` wrote. Raises ValueError, naming the file, where it is something else."""
    try:
        features = load_file(file)
        shapes = {plane: tuple(features[plane].shape) for plane in PLANES}
    except Exception as error:  # whatever a missing or damaged file leads to
        raise ValueError(f"the features of slices {file} are missing or damaged: do the case again") from error
    if any(len(shape) != 3 or shape[::2] != (2, DIMENSIONS[backbone]) for shape in shapes.values()):
        raise ValueError(f"{file} does not hold features of the FID backbone {backbone}: do the case again")
    return features


def frechet_distance(a: Tensor, b: Tensor, repeats: Tensor | None = None) -> float:
    """The Frechet distance of features a (N, d) and b (M, d); repeats: how often each slice counts, of both (N = M).
    NaN where a feature is not finite."""
    if not (a.isfinite().all() and b.isfinite().all()):
        return math.nan
    (m, first), (n, second) = (_moments(x.double(), repeats) for x in (a, b))
    mixed = torch.linalg.svdvals(first @ second.T).sum()
    return float((m - n).square().sum() + first.square().sum() + second.square().sum() - 2 * mixed)


def _moments(x: Tensor, repeats: Tensor | None) -> tuple[Tensor, Tensor]:
    """The mean of x (N, d), and A (d or fewer, d) such that A'A is its covariance."""
    repeats = torch.ones(len(x)) if repeats is None else repeats
    weight = repeats.double()[:, None]
    mean = (weight * x).sum(0) / weight.sum()
    root = (weight / (weight.sum() - 1)).sqrt() * (x - mean)
    root = root[repeats > 0]
    return mean, torch.linalg.qr(root, mode="r").R if len(root) > root.shape[1] else root


def fid(cases: Mapping[str, Features], replicates: int = 0) -> dict[str, Estimate]:
    """{"fid_xy", "fid_yz", "fid_zx", "fid" (their mean)} over all slices of cases, id -> features.

    replicates: draws of patients, each with its slices of reconstruction and truth, of which the 95 % intervals are
    taken; 0: none. Raises ValueError without a case.
    """
    if not cases:
        raise ValueError("there are no cases to take a Frechet distance of: score at least one")
    names = list(dict.fromkeys(map(patient_of, cases)))
    stacks = {plane: torch.cat([features[plane] for features in cases.values()], 1) for plane in PLANES}
    owners = {plane: torch.tensor([names.index(patient_of(case)) for case, features in cases.items()
                                   for _ in range(features[plane].shape[1])]) for plane in PLANES}
    distances = _planes(stacks)
    if replicates < 1 or len(names) < 2:
        return {name: Estimate(value) for name, value in distances.items()}
    drawn = [_planes(stacks, {plane: torch.from_numpy(counts)[owners[plane]] for plane in PLANES})
             for counts in draws(len(names), replicates)]
    return {name: Estimate(value, *percentiles(np.array([one[name] for one in drawn])))
            for name, value in distances.items()}


def _planes(stacks: Features, repeats: Mapping[str, Tensor | None] | None = None) -> dict[str, float]:
    distances = {f"fid_{plane}": frechet_distance(stacks[plane][0], stacks[plane][1], (repeats or {}).get(plane))
             for plane in PLANES}
    return distances | {"fid": sum(distances.values()) / len(PLANES)}


class PlaneFID(Metric):
    """`fid` of the cases that all processes have seen; a case seen twice counts once.

    dimensions: of the features. State: the cases' features as they are, so that the distance is over all slices.
    """

    full_state_update = False
    higher_is_better = False
    is_differentiable = False

    def __init__(self, dimensions: int):
        super().__init__()
        self.dimensions = dimensions
        # Flat float32 rows [case, slice, reconstruction's features, truth's]: torchmetrics gathers an empty process as
        # a flat tensor.
        for plane in PLANES:
            self.add_state(plane, default=[], dist_reduce_fx="cat")

    def update(self, case: int, features: Features) -> None:
        """Add one case, by its index in the dataset, the same in every process."""
        for plane, values in features.items():
            fake, real = values.float().to(self.device)
            place = torch.stack([torch.full((len(fake),), float(case)), torch.arange(float(len(fake)))], 1)
            getattr(self, plane).append(torch.cat([place.to(self.device), fake, real], 1).flatten())

    def compute(self) -> dict[str, Tensor]:
        """The distances, and the numbers of cases and of slices in each plane, as a flat dict of scalars."""
        cases: dict[str, Features] = {}
        for plane in PLANES:
            state: list[Tensor] | Tensor = getattr(self, plane)
            if not len(state):
                return {}
            rows = dim_zero_cat(state).reshape(-1, 2 + 2 * self.dimensions).cpu()
            for case in rows[:, 0].unique().tolist():
                slices = rows[rows[:, 0] == case]
                slices = slices[: int(slices[:, 1].max()) + 1, 2:]
                cases.setdefault(str(case), {})[plane] = slices.view(-1, 2, self.dimensions).movedim(1, 0)
        distances = {name: torch.tensor(float(value)) for name, value in fid(cases).items()}
        counts = {f"slices_{plane}": sum(case[plane].shape[1] for case in cases.values()) for plane in PLANES}
        counts["fid_cases"] = len(cases)
        return distances | {name: torch.tensor(float(count)) for name, count in counts.items()}
