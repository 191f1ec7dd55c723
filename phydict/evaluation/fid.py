"""Frechet distance of slices, in three planes (2.5D FID), of reconstructions to the truth's of all cases.

    FID = |m - n|^2 + tr(S + T - 2 (S T)^(1/2))      means m, n and covariances S, T of the features of slices

Heusel et al. 2017, arXiv:1706.08500; Dowson & Landau 1982, doi:10.1016/0047-259X(82)90077-X. With T = B'B the last
trace is the sum of the roots of the eigenvalues of B S B', also where the slices are fewer than the features. The
number depends on the backbone, on the number of slices and on their size: compare at equal ones alone. Few slices make
it too large, and so do the bootstrap's repeated ones: its interval may lie above the number.

Means and covariances are streamed in float64, case by case (Chan, Golub & LeVeque 1983, doi:10.1080/00031305.1983.
10483115), so that memory does not grow with the cases. A covariance of each patient would be 2 MB for 512 features and
34 MB for 2048, many times the patient's slices; so the bootstrap keeps one for each of as many draws as BLOCK_BYTES
hold, and reads the features again for the next ones: 256 draws in one go for 512 features, 16 for 2048.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
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
from phydict.evaluation.bootstrap import Estimate, draws, patients, percentiles
from phydict.evaluation.planes import PLANES
from phydict.runtime.files import atomic_write

NAMES = (*(f"fid_{plane}" for plane in PLANES), "fid")
"""The distances of the planes, and their mean."""

Features = Mapping[str, Tensor]
"""Plane -> features (2, N, d) of a case's slices: of the reconstruction and of the truth."""

Reference = tuple[Tensor, Tensor]
"""A mean (d,) of features, and a root (r, d), B, such that B'B is their covariance."""

BLOCK_BYTES = 2**29
"""What the covariances of the draws that are summed up at once may take; twice as much is in memory at most."""


class Moments:
    """Of features, slice upon slice, in float64: their count, mean (d,), and scatter (d, d), the sum of
    (x - mean)(x - mean)'."""

    def __init__(self, dimensions: int):
        self.count, self.mean = 0.0, torch.zeros(dimensions, dtype=torch.float64)
        self.scatter = torch.zeros(dimensions, dimensions, dtype=torch.float64)

    @classmethod
    def of(cls, x: Tensor) -> Moments:
        """Those of features (N, d)."""
        moments, x = cls(x.shape[1]), x.double().cpu()
        moments.count, moments.mean = float(len(x)), x.sum(0) / len(x)
        apart = x - moments.mean
        moments.scatter = apart.T @ apart
        return moments

    def add(self, other: Moments, times: float = 1.0) -> None:
        """Adds other features, each of which counts `times` times."""
        if not (added := times * other.count):
            return
        apart, total = other.mean - self.mean, self.count + added
        self.scatter.add_(other.scatter, alpha=times).addr_(apart, apart, alpha=self.count * added / total)
        self.mean = self.mean + apart * (added / total)
        self.count = total

    @property
    def covariance(self) -> Tensor:
        return self.scatter / (self.count - 1)


class StoredFeatures(Mapping[str, Tensor]):
    """The features in a file, of which a plane is read on request and not kept; shapes: plane -> that of its features.

    backbone: whose they are to be. Raises ValueError, naming the file, where it is something else.
    """

    def __init__(self, file: Path, backbone: str):
        self.file = file
        try:
            with safe_open(file, "pt") as content:
                self.shapes = {plane: tuple(content.get_slice(plane).get_shape()) for plane in PLANES}
        except Exception as error:  # whatever a missing or damaged file leads to
            raise ValueError(f"the features of slices {file} are missing or damaged: do the case again") from error
        if any(len(shape) != 3 or shape[::2] != (2, DIMENSIONS[backbone]) for shape in self.shapes.values()):
            raise ValueError(f"{file} does not hold features of the FID backbone {backbone}: do the case again")

    def __getitem__(self, plane: str) -> Tensor:
        with safe_open(self.file, "pt") as content:
            return content.get_tensor(plane)

    def __iter__(self) -> Iterator[str]:
        return iter(PLANES)

    def __len__(self) -> int:
        return len(PLANES)


class SeedFeatures(Mapping[str, tuple[Tensor, Tensor]]):
    """The features of a case that was reconstructed by several seeds: plane -> those of all reconstructions, and the
    truth's once."""

    def __init__(self, seeds: Sequence[Features]):
        self.seeds = seeds

    def __getitem__(self, plane: str) -> tuple[Tensor, Tensor]:
        fake, truth = self.seeds[0][plane]
        return torch.cat([fake, *(seed[plane][0] for seed in self.seeds[1:])]), truth

    def __iter__(self) -> Iterator[str]:
        return iter(PLANES)

    def __len__(self) -> int:
        return len(PLANES)


CaseFeatures = Features | SeedFeatures
"""The features of a case: plane -> those of its reconstructions and of the truth."""


@dataclass(frozen=True)
class Distances:
    """The Frechet distances of a method's cases.

    cases: their names; seeds: how many reconstructions each has; slices: plane -> how many each case's truth has;
    values: for each of NAMES (1 + R,), that of the cases, and of R draws of their patients, which are the same for
    every method with the same cases.
    """

    cases: tuple[str, ...]
    seeds: tuple[int, ...]
    slices: dict[str, tuple[int, ...]]
    values: dict[str, np.ndarray]

    @property
    def basis(self) -> tuple:
        """What they rest on: those of other numbers of slices are not compared."""
        return self.cases, self.seeds, self.slices

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


def _reduced(moments: Moments) -> Reference:
    """The mean and a root of the covariance, with as many rows as that has eigenvalues above what rounding leaves."""
    covariance = moments.covariance
    if not covariance.isfinite().all():
        return moments.mean, covariance
    values, vectors = torch.linalg.eigh(covariance)
    there = values > len(values) * torch.finfo(values.dtype).eps * values[-1]
    return moments.mean, values[there].sqrt()[:, None] * vectors.T[there]


def _distance(of: Moments, to: Reference) -> float:
    """The distance of moments to others. NaN where one is not finite."""
    covariance, (mean, root) = of.covariance, to
    if not (covariance.isfinite().all() and root.isfinite().all()):
        return math.nan
    trace = torch.linalg.eigvalsh(root @ covariance @ root.T).clamp(min=0).sqrt().sum()
    return float((of.mean - mean).square().sum() + covariance.trace() + root.square().sum() - 2 * trace)


def fid_rows(methods: Mapping[str, Distances], backbone: str, replicates: int, normalisation: str) -> list[dict]:
    """The distances of methods by label, a row each, with what they rest on and, in columns that begin with "less_", by
    how much they are above those of `less`, the method of most cases and of these the nearest, where they are of the
    same cases and of as many slices; a distance that is not a number comes behind all others. A distance's interval is
    in columns that end in "_low" and "_high".

    backbone: whose features they were; replicates: the draws of patients that they were found with; normalisation: of
    the slices, in words.
    """
    best = min(methods, key=lambda label: _place(methods[label]))
    rows = []
    for label, found in methods.items():
        row: dict = {"method": label, "fid_backbone": backbone, "fid_normalisation": normalisation,
                     "replicates": replicates, "cases": len(found.cases), "patients": patients(found.cases),
                     "seeds": " to ".join(str(n) for n in sorted({min(found.seeds), max(found.seeds)}))}
        row |= {f"slices_{plane}": sum(n * slices for n, slices in zip(found.seeds, of))
                for plane, of in found.slices.items()}
        row |= {f"truth_slices_{plane}": sum(of) for plane, of in found.slices.items()}
        row |= _numbers("", found.estimates())
        if label != best and found.basis == methods[best].basis and not math.isnan(_place(methods[best])[-1]):
            row["less"] = best
            row |= _numbers("less_", found.estimates(methods[best]))
        rows.append(row)
    return rows


def _place(found: Distances) -> tuple[bool, int, float]:
    """By what a method is the one that others are compared with, the least: it has a distance, most cases, and is the
    nearest."""
    distance = float(found.values["fid"][0])
    return math.isnan(distance), -len(found.cases), distance


def _numbers(of: str, estimates: Mapping[str, Estimate]) -> dict[str, float]:
    return {f"{of}{name}{end}": number for name, estimate in estimates.items()
            for end, number in zip(("", "_low", "_high"), estimate) if not math.isnan(number)}


def comparable(methods: Mapping[str, Mapping[str, CaseFeatures]]) -> list[list[str]]:
    """The labels of methods in groups of the same cases, of as many slices each."""
    groups: dict[tuple, list[str]] = {}
    for label, cases in methods.items():
        groups.setdefault((*cases, *_seeds(cases), *_slices(cases).values()), []).append(label)
    return list(groups.values())


def _seeds(cases: Mapping[str, CaseFeatures]) -> tuple[int, ...]:
    """How many reconstructions each case has."""
    return tuple(len(of.seeds) if isinstance(of, SeedFeatures) else 1 for of in cases.values())


def _slices(cases: Mapping[str, CaseFeatures]) -> dict[str, tuple[int, ...]]:
    """Plane -> the number of slices of each case's truth."""
    firsts = [of.seeds[0] if isinstance(of, SeedFeatures) else of for of in cases.values()]
    shapes = [features.shapes if isinstance(features, StoredFeatures) else
              {plane: of.shape for plane, of in features.items()} for features in firsts]
    return {plane: tuple(shape[plane][1] for shape in shapes) for plane in PLANES}


def distances(methods: Mapping[str, Mapping[str, CaseFeatures]], replicates: int = 0,
              on_plane: Callable[[str], None] = lambda plane: None) -> dict[str, Distances]:
    """Those of all slices of some methods' cases, label -> case id -> features.

    replicates: draws of patients, each with its slices of reconstruction and truth, of which the 95 % intervals are
    taken; 0: none. on_plane: called with each plane before it is measured, for each group of `comparable` methods.
    Raises ValueError without a case.
    """
    if not all(methods.values()):
        raise ValueError("there are no cases to take a Frechet distance of: score at least one")
    found = {}
    for labels in comparable(methods):
        first, planes = methods[labels[0]], {}
        for plane in PLANES:
            on_plane(plane)
            planes[plane] = _plane([methods[label] for label in labels], plane, replicates)
        for place, label in enumerate(labels):
            values = {f"fid_{plane}": drawn[place] for plane, drawn in planes.items()}
            values["fid"] = sum(values.values()) / len(PLANES)
            found[label] = Distances(tuple(first), _seeds(first), _slices(first), values)
    return {label: found[label] for label in methods}


def _plane(methods: Sequence[Mapping[str, CaseFeatures]], plane: str, replicates: int) -> np.ndarray:
    """The distances (methods, 1 + R) of some `comparable` methods in one plane. A truth that methods share is summed up
    once for each draw; draws that are alike are one."""
    of_patient: dict[str, list[str]] = {}
    for case in methods[0]:
        of_patient.setdefault(patient_of(case), []).append(case)
    n = len(of_patient)
    drawn = np.vstack([np.ones((1, n), int), *([] if replicates < 1 or n < 2 else [draws(n, replicates)])])
    distinct, place = np.unique(drawn, axis=0, return_inverse=True)
    shared = [next(k for k, other in enumerate(methods) if _same_truth(cases, other, plane)) for cases in methods]
    dimensions = next(iter(methods[0].values()))[plane][0].shape[1]
    size, values = max(1, BLOCK_BYTES // (8 * dimensions**2)), np.empty((len(methods), len(distinct)))
    for start in range(0, len(distinct), size):
        block = slice(start, start + size)
        for first in dict.fromkeys(shared):
            truths = [_reduced(moments) for moments in _drawn(methods[first], 1, plane, of_patient, distinct[block])]
            for k in (k for k, other in enumerate(shared) if other == first):
                fakes = _drawn(methods[k], 0, plane, of_patient, distinct[block])
                values[k, block] = [_distance(fake, truth) for fake, truth in zip(fakes, truths)]
    return values[:, place.ravel()]


def _same_truth(cases: Mapping[str, CaseFeatures], others: Mapping[str, CaseFeatures], plane: str) -> bool:
    return cases is others or all(torch.equal(features[plane][1], others[case][plane][1])
                                  for case, features in cases.items())


def _drawn(cases: Mapping[str, CaseFeatures], of: int, plane: str, of_patient: Mapping[str, Sequence[str]],
           counts: np.ndarray) -> list[Moments]:
    """The moments of cases' reconstructions (of 0) or truths (1) in draws of their patients, by counts (draws,
    patients); the features of one case alone are in memory."""
    sums: list[Moments] = []
    for names, repeats in zip(of_patient.values(), counts.T):
        patient = Moments.of(cases[names[0]][plane][of])
        for case in names[1:]:
            patient.add(Moments.of(cases[case][plane][of]))
        sums = sums or [Moments(len(patient.mean)) for _ in counts]
        for moments, times in zip(sums, repeats):
            moments.add(patient, float(times))
    return sums


class PlaneFID(Metric):
    """`distances` of the cases that all processes have seen; a case seen twice counts once, in another process where it
    is the last one there, as where a distributed sampler repeats cases to fill the last batch.

    dimensions: of the features. State: in float64 the sums of (1, x)(1, x)' over all slices but those of the last case,
    whose features are kept until the next one.
    """

    full_state_update = False
    higher_is_better = False
    is_differentiable = False
    sums: Tensor
    summed: list[Tensor]

    def __init__(self, dimensions: int):
        super().__init__()
        self.dimensions, self.seen = dimensions, set[int]()
        shape = (len(PLANES), 2, dimensions + 1, dimensions + 1)
        self.add_state("sums", default=torch.zeros(shape, dtype=torch.float64), dist_reduce_fx="sum")
        # Flat float32 rows: torchmetrics gathers an empty process as a flat tensor. Cases that are summed up; and of
        # the last one [case, slice, reconstruction's features, truth's].
        for name in ("summed", *PLANES):
            self.add_state(name, default=[], dist_reduce_fx="cat")

    def reset(self) -> None:
        super().reset()
        self.seen = set()

    def update(self, case: int, features: Features) -> None:
        """Add one case, by its index in the dataset, the same in every process."""
        if case in self.seen:
            return
        self.seen.add(case)
        for last, kept in self._last().items():
            self.sums += self._products(kept)
            self.summed.append(torch.tensor([float(last)], device=self.device))
        for plane, values in features.items():
            fake, real = values.float().to(self.device)
            place = torch.stack([torch.full((len(fake),), float(case)), torch.arange(float(len(fake)))], 1)
            setattr(self, plane, [torch.cat([place.to(self.device), fake, real], 1).flatten()])

    def compute(self) -> dict[str, Tensor]:
        """The distances, and the numbers of cases and of slices in each plane, as a flat dict of scalars."""
        known = set(dim_zero_cat(self.summed).int().tolist()) if len(self.summed) else set()
        last = {case: kept for case, kept in self._last().items() if case not in known}
        sums = self.sums.cpu() + sum(self._products(kept).cpu() for kept in last.values())
        if not float(sums[0, 0, 0, 0]):
            return {}
        values = {f"fid_{plane}": _distance(_unpacked(fake), _reduced(_unpacked(real)))
                  for plane, (fake, real) in zip(PLANES, sums)}
        values["fid"] = sum(values.values()) / len(PLANES)
        counts = {f"slices_{plane}": float(of[0, 0, 0]) for plane, of in zip(PLANES, sums)}
        return {name: torch.tensor(value) for name, value in (
            values | counts | {"fid_cases": float(len(known) + len(last))}).items()}

    def _last(self) -> dict[int, dict[str, Tensor]]:
        """Case -> plane -> features (2, N, d) of the last case of each process that is known here."""
        cases: dict[int, dict[str, Tensor]] = {}
        for plane in PLANES:
            state: list[Tensor] | Tensor = getattr(self, plane)
            rows = dim_zero_cat(state).reshape(-1, 2 + 2 * self.dimensions) if len(state) else torch.empty(0, 2)
            for case in rows[:, 0].unique().tolist():
                slices = rows[rows[:, 0] == case]
                slices = slices[: int(slices[:, 1].max()) + 1, 2:]
                cases.setdefault(int(case), {})[plane] = slices.view(-1, 2, self.dimensions).movedim(1, 0)
        return cases

    @staticmethod
    def _products(features: Features) -> Tensor:
        """The sums (planes, 2, 1 + d, 1 + d) of (1, x)(1, x)' over a case's slices."""
        ones = [torch.nn.functional.pad(features[plane].double(), (1, 0), value=1.0) for plane in PLANES]
        return torch.stack([x.mT @ x for x in ones])


def _unpacked(sums: Tensor) -> Moments:
    """The moments whose sums of (1, x)(1, x)' are given."""
    moments = Moments(len(sums) - 1)
    moments.count, moments.mean = float(sums[0, 0]), sums[0, 1:] / sums[0, 0]
    moments.scatter = sums[1:, 1:] - sums[0, 0] * torch.outer(moments.mean, moments.mean)
    return moments
