"""What a drawn anatomy is made of: a patient's tissue, a shape between and beyond the patients', organs, findings."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
import torch
from torch import Tensor

from phydict.datasets.phantoms.findings import FOCAL, PLEURAL, Finding, draw_findings
from phydict.runtime.ranges import check_fields

PAINTED = FOCAL + PLEURAL
"""Kinds of findings that are put into CTs; the others would change organs that no mask shows."""

EXPLAINED, MOST_DEVIATIONS = 0.9, 2.0
"""Share of the shapes' variance that the principal modes keep, and how far a draw goes along one."""


@dataclass(frozen=True)
class Variation:
    """How far a population's draws go from its patients; 0 leaves that kind out.

    Args:
        mixing: share, at most, of the way from a patient's shape to a convex combination of all patients' shapes
        modes: standard deviation of a draw along each principal mode of the shapes, over that of the patients
        lungs: largest logarithm of the factor by which the lungs are inflated or deflated
        heart: the same of the heart
        liver: the same of the liver
        findings: share of the draws, of patients without a report, into which findings are put
    """

    mixing: float = 1.0
    modes: float = 0.7
    lungs: float = 0.3
    heart: float = 0.25
    liver: float = 0.2
    findings: float = 0.5

    def __post_init__(self):
        check_fields(self, "data.loading.population.variation", mixing=(0, 1.0), modes=(0, 2.0), lungs=(0, 0.7),
                     heart=(0, 0.7), liver=(0, 0.7), findings=(0, 1.0))

    @classmethod
    def none(cls) -> Variation:
        return cls(**{field.name: 0.0 for field in fields(cls)})


@dataclass(frozen=True)
class Anatomy:
    """One drawn anatomy of a population of N patients.

    patient: whose tissue, 0 to N - 1. weights: (N,), of the patients' velocities in that of the shape, their sum 1.
    lungs, heart, liver: logarithms of the factors of their volumes. findings: put in last.
    """

    patient: int
    weights: tuple[float, ...]
    lungs: float = 0.0
    heart: float = 0.0
    liver: float = 0.0
    findings: tuple[Finding, ...] = ()

    @classmethod
    def of(cls, patient: int, count: int) -> Anatomy:
        """A patient of `count` as they are."""
        return cls(patient, tuple(np.eye(count)[patient].tolist()))

    @classmethod
    def draw(cls, seed: int, modes: np.ndarray, variation: Variation = Variation()) -> Anatomy:
        """A random anatomy, the same for the same `seed` and modes (M, N), as `principal_modes` gives them."""
        rng = np.random.default_rng([seed, 11])
        count = modes.shape[1]
        patient = int(rng.integers(count))
        share = variation.mixing * rng.random()
        weights = share * rng.dirichlet(np.ones(count)) + (1 - share) * np.eye(count)[patient]
        along = rng.standard_normal(len(modes)).clip(-MOST_DEVIATIONS, MOST_DEVIATIONS)
        weights = weights + variation.modes * along @ modes
        lungs, heart, liver = (
            float(bound * rng.uniform(-1, 1)) for bound in (variation.lungs, variation.heart, variation.liver))
        return cls(patient, tuple(weights.tolist()), lungs, heart, liver, findings_of(seed, variation.findings))

    def towards_patient(self, share: float) -> Anatomy:
        """This anatomy, `share` of the way nearer to the shape of its own patient; its findings stay."""
        varied = 1 - share
        patient = np.eye(len(self.weights))[self.patient]
        weights = patient + varied * (np.array(self.weights) - patient)
        return replace(self, weights=tuple(weights.tolist()), lungs=varied * self.lungs, heart=varied * self.heart,
                       liver=varied * self.liver)


def findings_of(seed: int, share: float) -> tuple[Finding, ...]:
    """The findings of the draw with this seed, for `share` of the seeds; those that can be painted into a CT."""
    rng = np.random.default_rng([seed, 12])
    return tuple(f for f in draw_findings(rng) if f.kind in PAINTED) if rng.random() < share else ()


def principal_modes(velocities: Tensor) -> np.ndarray:
    """The leading modes of N velocities (N, ...) about their mean, as weights (M, N) of these with a sum of 0.

    Each has the length of one standard deviation; together they explain EXPLAINED of the variance.
    """
    centred = (velocities - velocities.mean(0)).flatten(1).double()
    values, vectors = torch.linalg.eigh(centred @ centred.T)
    values, vectors = values.flip(0).clamp(min=0).numpy(), vectors.flip(1).numpy()
    if len(values) < 2 or values.sum() == 0:
        return np.zeros((0, len(values)))
    kept = int(np.searchsorted(values.cumsum() / values.sum(), EXPLAINED)) + 1
    weights = vectors[:, :min(kept, len(values) - 1)].T / np.sqrt(len(values) - 1)
    return weights - weights.mean(1, keepdims=True)
