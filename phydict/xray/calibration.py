"""Display values to line integrals: an unknown gain and offset per view, matched to a reference projection."""

from __future__ import annotations

from torch import Tensor


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
