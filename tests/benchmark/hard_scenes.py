"""What the scenes of hard_cases.py do to X-rays (K, V, U), to line integrals and to patients.

Signals are relative to air: a line integral y is read as exp(-y).
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch
from scipy.ndimage import gaussian_filter
from torch import Tensor
from torch.nn.functional import interpolate, pad

from phydict.xray import ConeBeam

AIR = -1.0
"""In the prior's range."""


def drifted(xrays: Tensor, least: float = 0.8) -> Tensor:
    """The tube's output falls from view to view, evenly, to the share `least`."""
    return xrays - torch.linspace(1, least, len(xrays)).log()[:, None, None]


def heeled(xrays: Tensor, least: float = 0.7) -> Tensor:
    """The anode's heel: the signal falls from the lowest row, evenly, to the share `least` in the uppermost."""
    return xrays - torch.linspace(least, 1, xrays.shape[1]).log()[:, None]


def blurred(xrays: Tensor, pixels: float) -> Tensor:
    """The signal blurred by a Gaussian of this standard deviation."""
    signal = gaussian_filter(torch.exp(-xrays).numpy(), (0, pixels, pixels), mode="nearest")
    return -torch.from_numpy(signal).log()


def lagging(xrays: Tensor, share: float = 0.05) -> Tensor:
    """Each view's signal holds this share of the view before it."""
    signal = torch.exp(-xrays)
    return -((1 - share) * signal + share * signal.roll(1, 0)).log()


def focal_spot(beam: ConeBeam, side: float, points: int = 3) -> Iterator[ConeBeam]:
    """The beams of the points of a square focal spot of `side` mm, parallel to the detector."""
    along, down = (step / np.linalg.norm(step, axis=1, keepdims=True) for step in (beam.u, beam.v))
    places = (np.arange(points) - (points - 1) / 2) * side / points
    for x in places:
        for y in places:
            yield ConeBeam(beam.sources + x * along + y * down, beam.detectors, beam.u, beam.v, beam.shape)


def scaled(volume: Tensor, factors: tuple[float, float, float]) -> Tensor:
    """A patient (1, 1, X, Y, Z) of another size on the same voxels: air around what is smaller, of what is larger the
    middle."""
    shape = volume.shape[-3:]
    sizes = [2 * round(n * factor / 2) for n, factor in zip(shape, factors)]
    made = interpolate(volume, size=sizes, mode="trilinear")
    margins = [(n - size) // 2 for n, size in zip(shape, sizes)]
    return pad(made, [margin for n in reversed(margins) for margin in (n, n)], value=AIR)


def water_cube(like: Tensor, hu: Tensor, voxels: int = 34) -> Tensor:
    """A cube of `hu`, in the prior's range, in air."""
    made = torch.full_like(like, AIR)
    first = (like.shape[-1] - voxels) // 2
    place = slice(first, first + voxels)
    made[..., place, place, place] = hu
    return made


def without_left_lung(volume: Tensor, lung: Tensor, filling: float) -> Tensor:
    """The patient's left lung (1, 1, X, Y, Z), of the mask `lung` (X, Y, Z), filled with `filling`, in the prior's
    range."""
    middle = int(torch.nonzero(lung)[:, 0].float().mean())
    left = lung.clone()
    left[middle:] = False  # the first axis runs towards the patient's right
    return torch.where(left, torch.full_like(volume, filling), volume)
