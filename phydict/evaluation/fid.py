"""Frechet distance of slices, in three planes (2.5D FID), of reconstructions to the truth's of all cases.

    FID = |m - n|^2 + tr(S + T - 2 (S T)^(1/2))      means m, n and covariances S, T of the features of slices

Heusel et al. 2017, arXiv:1706.08500; Dowson & Landau 1982, doi:10.1016/0047-259X(82)90077-X. With T = B'B the last
trace is the sum of the roots of the eigenvalues of B S B', also where the slices are fewer than the features. The
number depends on the backbone, on the number of slices and on their size: compare at equal ones alone. Few slices make
it too large, and so do the bootstrap's repeated ones: its interval may lie above the number.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from safetensors import safe_open
from safetensors.torch import save_file
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

Features = Mapping[str, Tensor]
"""Plane -> features (2, N, d) of a case's slices: of the reconstruction and of the truth."""

Moments = tuple[Tensor, Tensor]
"""A mean (d,) of features, and a root (n, d), A, such that A'A is their covariance."""


class StoredFeatures(Mapping[str, Tensor]):
    """The features in a file, of which a plane is read when it is asked for and is not kept.

    backbone: whose they are to be. Raises ValueError, naming the file, where it is something else.
    """

    def __init__(self, file: Path, backbone: str):
        self.file = file
        try:
            with safe_open(file, "pt") as content:
                shapes = [tuple(content.get_slice(plane).get_shape()) for plane in PLANES]
        except Exception as error:  # whatever a missing or damaged file leads to
            raise ValueError(f"the features of slices {file} are missing or damaged: do the case again") from error
        if any(len(shape) != 3 or shape[::2] != (2, DIMENSIONS[backbone]) for shape in shapes):
            raise ValueError(f"{file} does not hold features of the FID backbone {backbone}: do the case again")

    def __getitem__(self, plane: str) -> Tensor:
        with safe_open(self.file, "pt") as content:
            return content.get_tensor(plane)

    def __iter__(self) -> Iterator[str]:
        return iter(PLANES)

    def __len__(self) -> int:
        return len(PLANES)


@dataclass(frozen=True)
class Distances:
    """The Frechet distances of a method's cases.

    cases: their names; slices: plane -> how many; values: for each of NAMES (1 + R,), that of the cases, and of R draws
    of their patients, which are the same for every method with the same cases.
    """

    cases: tuple[str, ...]
    slices: dict[str, int]
    values: dict[str, np.ndarray]

    def estimates(self, other: Distances | None = None) -> dict[str, Estimate]:
        """The distances, or by how much they are above those of another method with the same cases, draw by draw."""
        values = {name: one - other.values[name] if other else one for name, one in self.values.items()}
        return {name: Estimate(float(one[0]), *(percentiles(one[1:]) if len(one) > 1 else ()))
                for name, one in values.items()}


def case_features(network: SliceFeatures, hu: Tensor, truth: Features | Tensor) -> dict[str, Tensor]:
    """The features of a volume's slices (X, Y, Z) in HU beside the truth's, another volume or found before."""
    return {plane: torch.stack([network(hu, plane), truth[plane][1] if isinstance(truth, Mapping) else
                                network(truth, plane)]) for plane in PLANES}


def save_features(file: Path, features: Features) -> None:
    """Writes the features of a case as safetensors."""
    with atomic_write(file) as part:
        save_file({plane: values.contiguous() for plane, values in features.items()}, part)


def frechet_distance(a: Tensor, b: Tensor, repeats: Tensor | None = None) -> float:
    """The Frechet distance of features a (N, d) and b (M, d); repeats: how often each slice counts, of both (N = M).
    NaN where a feature is not finite."""
    return _distance(_moments(a, repeats), _reduced(_moments(b, repeats)))


def _moments(x: Tensor, repeats: Tensor | None) -> Moments:
    """Those of features (N, d), each of which counts as often as `repeats` (N,) says."""
    weight = (torch.ones(len(x)) if repeats is None else repeats).double()[:, None]
    x, weight = x[weight[:, 0] > 0].double(), weight[weight[:, 0] > 0]
    mean = (weight * x).sum(0) / weight.sum()
    return mean, (weight / (weight.sum() - 1)).sqrt() * (x - mean)


def _reduced(moments: Moments) -> Moments:
    """The same with a root of d rows at most."""
    mean, root = moments
    tall = len(root) > root.shape[1] and bool(root.isfinite().all())
    return mean, torch.linalg.qr(root, mode="r").R if tall else root


def _distance(of: Moments, to: Moments) -> float:
    """The distance of moments to others, whose root has few rows. NaN where one is not finite."""
    (m, first), (n, second) = of, to
    if not (first.isfinite().all() and second.isfinite().all()):
        return math.nan
    if len(first) > first.shape[1]:
        product = second @ (first.T @ first) @ second.T
    else:
        mixed = first @ second.T
        product = mixed @ mixed.T if len(first) < len(second) else mixed.T @ mixed
    trace = torch.linalg.eigvalsh(product).clamp(min=0).sqrt().sum()
    return float((m - n).square().sum() + first.square().sum() + second.square().sum() - 2 * trace)


def fid(cases: Mapping[str, Features], replicates: int = 0) -> dict[str, Estimate]:
    """{"fid_xy", "fid_yz", "fid_zx", "fid" (their mean)} over all slices of cases, as `distances` has them."""
    return distances({"": cases}, replicates)[""].estimates()


def distances(methods: Mapping[str, Mapping[str, Features]], replicates: int = 0) -> dict[str, Distances]:
    """Those of all slices of some methods' cases, label -> case id -> features.

    replicates: draws of patients, each with its slices of reconstruction and truth, of which the 95 % intervals are
    taken; 0: none. Raises ValueError without a case.
    """
    if not all(methods.values()):
        raise ValueError("there are no cases to take a Frechet distance of: score at least one")
    groups: dict[tuple[str, ...], list[str]] = {}
    for label, cases in methods.items():
        groups.setdefault(tuple(cases), []).append(label)
    found = {}
    for names, labels in groups.items():
        planes = {plane: _plane([methods[label] for label in labels], plane, replicates) for plane in PLANES}
        for place, label in enumerate(labels):
            values = {f"fid_{plane}": drawn[place] for plane, (_, drawn) in planes.items()}
            found[label] = Distances(names, {plane: count for plane, (count, _) in planes.items()},
                                     values | {"fid": sum(values.values()) / len(PLANES)})
    return {label: found[label] for label in methods}


def _plane(methods: Sequence[Mapping[str, Features]], plane: str, replicates: int) -> tuple[int, np.ndarray]:
    """The number of slices of each of some methods with the same cases in one plane, and their distances (methods,
    1 + R). A truth that methods share is summed up once for each draw; no other plane is in memory."""
    patients = list(dict.fromkeys(map(patient_of, methods[0])))
    fakes, truths, places = [], list[Tensor](), []
    for cases in methods:
        parts = [features[plane] for features in cases.values()]
        truth = torch.cat([part[1] for part in parts])
        place = next((n for n, other in enumerate(truths) if torch.equal(truth, other)), len(truths))
        truths += [truth] * (place == len(truths))
        fakes.append(torch.cat([part[0] for part in parts]))
        places.append(place)
        owners = torch.tensor([patients.index(patient_of(case)) for case, part in zip(cases, parts)
                               for _ in range(part.shape[1])])
    drawn = draws(len(patients), replicates) if replicates > 0 and len(patients) > 1 else ()
    values = []
    for repeats in (None, *(torch.from_numpy(counts)[owners] for counts in drawn)):
        references = [_reduced(_moments(truth, repeats)) for truth in truths]
        values.append([_distance(_moments(fake, repeats), references[place]) for fake, place in zip(fakes, places)])
    return len(owners), np.array(values).T


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
        cases: dict[str, dict[str, Tensor]] = {}
        for plane in PLANES:
            state: list[Tensor] | Tensor = getattr(self, plane)
            if not len(state):
                return {}
            rows = dim_zero_cat(state).reshape(-1, 2 + 2 * self.dimensions).cpu()
            for case in rows[:, 0].unique().tolist():
                slices = rows[rows[:, 0] == case]
                slices = slices[: int(slices[:, 1].max()) + 1, 2:]
                cases.setdefault(str(case), {})[plane] = slices.view(-1, 2, self.dimensions).movedim(1, 0)
        values = {name: torch.tensor(float(value)) for name, value in fid(cases).items()}
        counts = {f"slices_{plane}": sum(case[plane].shape[1] for case in cases.values()) for plane in PLANES}
        counts["fid_cases"] = len(cases)
        return values | {name: torch.tensor(float(count)) for name, count in counts.items()}
