"""Whether a detector saturated in air: whole counts that end at one value, though those below it are noisy."""

from __future__ import annotations

import numpy as np

from phydict.runtime.warning import warn

SHARE, SOLID = 0.02, 0.9
"""A view ends at its largest count where so many of its pixels hold that, and so many of their neighbours. Noise that
is clipped at the mean of air leaves half of the neighbours."""

TURNS, PAIRS = 0.5, 1000
"""Counts are noisy where so many of the second differences along rows have another sign than the next, in the bright
half, of which there must be so many pairs. Of white noise 0.73 do, and of a CT and two phantoms without noise, rounded
to 8 to 16 bits, on 128^2 to 448^2 pixels, 0.41 at most."""


def saturated(counts: np.ndarray) -> np.ndarray:
    """Which pixels of views of whole counts (K, V, U) are saturated, booleans (K, V, U): where views end at their
    largest count and, in the median of these views, are noisy below it. Warns where any are."""
    ends = counts == counts.max((1, 2), keepdims=True)
    turns = np.array([_turns(view, at_end) for view, at_end in zip(counts, ends)])
    if np.isnan(turns).all() or np.nanmedian(turns) <= TURNS:
        return np.zeros_like(ends)
    ends[np.isnan(turns)] = False
    share = ends.mean((1, 2))
    warn(f"{(share > 0).sum()} of {len(counts)} views hold exactly their largest count in up to {share.max():.0%} of "
         "their pixels, though counts below it are noisy: the detector saturates there, and these pixels count as air. "
         "Thin parts of the patient, such as skin and arms, are lost, and unless `air` is what it would count without "
         "that end, such as that of a lower exposure in proportion, each ray counts as too little: correct `air`, or "
         "expose less")
    return ends


def _turns(counts: np.ndarray, at_end: np.ndarray) -> float:
    """The share of second differences that turn in the bright half of a view (V, U); NaN of one that does not end in a
    solid region, or of which too little is bright to tell."""
    bright = ~at_end & (counts > counts.max() / 2)
    inner = bright[:, :-2] & bright[:, 1:-1] & bright[:, 2:]
    pairs = inner[:, :-1] & inner[:, 1:]
    if at_end.mean() < SHARE or _neighbours(at_end)[at_end].mean() < SOLID or pairs.sum() < PAIRS:
        return np.nan
    second = np.diff(counts.astype(np.float64), 2)
    return float((second[:, :-1] * second[:, 1:] < 0)[pairs].mean())


def _neighbours(mask: np.ndarray) -> np.ndarray:
    """The share of each pixel's four neighbours that a mask (V, U) holds; beyond the edges it is as there."""
    padded = np.pad(mask, 1, mode="edge").astype(np.float64)
    return (padded[:-2, 1:-1] + padded[2:, 1:-1] + padded[1:-1, :-2] + padded[1:-1, 2:]) / 4
