"""What X-rays hold beside line integrals, found by comparing them with a reference projection.

Display values have an unknown gain and offset per view; scatter adds a smooth signal to what each view reads; a tube's
rays harden on their way.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

LARGEST_SHARE = 0.9
"""The share of a pixel's signal that may at most be scatter."""

ORDER = 3
"""The cosines that a view's scatter is made of have total orders below it."""

USUAL, BEYOND = 0.99, 1.0
"""A pixel tells the less of scatter the further its line integral, or what that exceeds the reference's by, is more
than BEYOND above what the share USUAL of its view's pixels have at most: it is dead or behind metal. In scenes of two
CTs with scatter no pixel is above it by more than 0.73."""

HARDENING = 0.011
"""By how much a tube's line integrals m of water bend: m + HARDENING m (m - m_0) is straight in the water's thickness,
within 0.07 over 450 mm, where m itself errs by 0.4 to 0.65. The best value is 0.0105 to 0.0121 for tubes of 70 to 120
kVp, with an ideal detector or caesium iodide."""

UNBENT_PATH = 200.0
"""mm of water of which m_0 is the line integral, and which the correction leaves as it is."""


def match_views(display: Tensor, reference: Tensor) -> Tensor:
    """Display values (B, K, V, U) mapped affinely, view by view, to the mean and spread of `reference`.

    Matching the spread instead of regressing on the reference keeps the contrast of the measurement when the
    reference is still blurred. A flat view takes the reference's mean.
    """
    axes = (-2, -1)
    centred = display - display.mean(axes, keepdim=True)
    spread = centred.square().mean(axes, keepdim=True).sqrt()
    gain = reference.std(axes, keepdim=True, correction=0) / spread.clamp(min=1e-12)
    return gain * centred + reference.mean(axes, keepdim=True)


def subtract_scatter(xrays: Tensor, reference: Tensor) -> Tensor:
    """Line integrals (B, K, V, U) without the scatter that makes their signal exceed that of `reference`.

    exp(-xrays) = exp(-reference) + S, with S per view a sum of the cosines of a total order below ORDER along rows
    and columns, fitted by least squares relative to the signal, so that what is thick counts as much as what is thin,
    but for pixels that stand out (USUAL, BEYOND), which would outweigh all others. S is kept above zero and below
    LARGEST_SHARE of the signal, and is zero where the pixels of a view do not tell it.
    """
    signal = torch.exp(-xrays.double())
    down, along = (torch.linspace(0, math.pi, n, dtype=torch.float64, device=xrays.device) for n in xrays.shape[-2:])
    smooth = torch.stack([torch.cos(i * down)[:, None] * torch.cos(j * along)
                          for i in range(min(ORDER, len(down))) for j in range(min(ORDER - i, len(along)))])
    counts = _counts(xrays.double(), reference.double())
    design = (counts[..., None, :, :] * smooth / signal[..., None, :, :]).flatten(-2)
    excess = (counts * (1 - torch.exp(-reference.double()) / signal)).flatten(-2)
    normal, right = design @ design.transpose(-1, -2), design @ excess[..., None]
    shares, singular = torch.linalg.solve_ex(normal, right)
    shares = torch.where(singular[..., None] > 0, 0, shares[..., 0])
    scatter = torch.einsum("...q,qvu->...vu", shares, smooth)
    return -torch.log(signal - torch.minimum(scatter.clamp(min=0), LARGEST_SHARE * signal)).to(xrays)


def _counts(xrays: Tensor, reference: Tensor) -> Tensor:
    """How much the pixels of line integrals (B, K, V, U) count in a fit of scatter: 1, of those that stand out less."""
    most = torch.minimum(_usual_most(xrays), reference + _usual_most(xrays - reference)) + BEYOND
    return torch.exp(-2 * (xrays - most).clamp(min=0))


def _usual_most(values: Tensor) -> Tensor:
    """What the share USUAL of each view's pixels (..., V, U), all but one at least, have at most: (..., 1, 1)."""
    flat = values.flatten(-2)
    n = flat.shape[-1]
    return flat.kthvalue(max(1, min(math.ceil(USUAL * n), n - 1))).values[..., None, None]


def without_hardening(xrays: Tensor, mu_water: float) -> Tensor:
    """Line integrals (K, V, U) of a tube's rays, straightened as those of water are (Herman 1979,
    doi:10.1088/0031-9155/24/1/008, for a tube that is not known); mu_water: in 1/mm, behind UNBENT_PATH."""
    return xrays + HARDENING * xrays * (xrays - UNBENT_PATH * mu_water)


def bend(xrays: Tensor, reference: Tensor, mu_water: float) -> float:
    """What of HARDENING line integrals (K, V, U) still show against those of a volume made of them, which has taken its
    part: a least squares fit."""
    form = xrays * (xrays - UNBENT_PATH * mu_water)
    return float(((reference - xrays) * form).sum() / form.square().sum().clamp(min=1e-12))
