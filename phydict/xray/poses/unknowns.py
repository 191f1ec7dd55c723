"""The unknowns of a view's pose, and the beam that they make of another."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import torch
from torch import Tensor
from torch.autograd.functional import jacobian

from phydict.xray.geometry import ConeBeam

POSE = ("detector_shift_mm",) * 2 + ("source_shift_mm",) * 2 + ("source_to_detector_mm",) + ("rotation_degrees",) * 3
"""The kinds of the eight unknowns of a view, in their order.

Along its u and v: the detector's shift, then the source's; the detector's way from the source, along the normal; then
the rotation of source and detector together about the isocentre, a vector along u, v and the normal as they were.
"""


def moved(beam: ConeBeam, values: np.ndarray) -> ConeBeam:
    """The beam with its views moved by `values` (K, 8), in mm and degrees, as POSE lists them."""
    vectors = torch.stack([_moved(unknowns, vectors) for unknowns, vectors in _views(beam, values)])
    sources, detectors, u, v = np.moveaxis(vectors.numpy(), 1, 0)
    return beam.at(sources, detectors, u, v)


def derivative(beam: ConeBeam, values: np.ndarray) -> Tensor:
    """What each unknown changes in source, detector, u and v at `values`: (K, 4, 3, 8), per mm and degree."""
    return torch.stack([jacobian(lambda x, vectors=vectors: _moved(x, vectors), unknowns)
                        for unknowns, vectors in _views(beam, values)])


def _views(beam: ConeBeam, values: np.ndarray) -> Iterable[tuple[Tensor, Tensor]]:
    """Each view's unknowns (8,) and vectors (4, 3)."""
    vectors = np.stack([beam.sources, beam.detectors, beam.u, beam.v], 1)
    return zip(torch.as_tensor(np.array(values, float)), torch.as_tensor(vectors), strict=True)


def _moved(values: Tensor, vectors: Tensor) -> Tensor:
    """One view's four vectors (4, 3)."""
    source, detector, u, v = vectors
    along, down = u / u.norm(), v / v.norm()
    normal = torch.linalg.cross(along, down)
    normal = normal * torch.sign(((detector - source) * normal).sum())
    source = source + values[2] * along + values[3] * down
    detector = detector + values[0] * along + values[1] * down + values[4] * normal
    turn = torch.deg2rad(values[5] * along + values[6] * down + values[7] * normal)
    return torch.stack([source, detector, u, v]) @ torch.linalg.matrix_exp(_cross_matrix(turn)).T


def _cross_matrix(w: Tensor) -> Tensor:
    zero = torch.zeros_like(w[0])
    return torch.stack([zero, -w[2], w[1], w[2], zero, -w[0], -w[1], w[0], zero]).view(3, 3)
