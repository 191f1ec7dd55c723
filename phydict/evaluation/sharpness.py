"""How sharp a reconstruction is: the width of edges, and the contrast of ribs and vessels."""

from __future__ import annotations

from contextlib import suppress

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import avg_pool3d, max_pool3d

from phydict.grid import Grid

VESSELS = 200
"""How many of a lung's brightest voxels count as vessels."""

REACH_MM = 24.0
"""How far on either side of an edge its profile is looked at."""

BONE, WALL_MM, RIB_MM = 200.0, 24.0, 12.0
"""Ribs: from how many HU on, how near to a lung, and how far above and below their middle they are looked at."""

AXES = {"diaphragm": 2, "chest_wall": 0}
"""The axis across each edge of the lungs."""


def edge_profile(volume: Tensor, lung: Tensor, edge: str, reach: int) -> Tensor:
    """Mean profile (2 reach,) of a volume (X, Y, Z) across an edge of the lungs, from the lung outward.

    lung: mask (X, Y, Z) in the truth. edge: "diaphragm", below the lowest lung voxel of each column, or "chest_wall",
    beside the outermost one of each row. Lines on which less than `reach` voxels of lung or of other tissue meet at the
    edge are left out. Raises ValueError where none is left.
    """
    axis = AXES[edge]
    lines = [x.movedim(axis, -1).reshape(-1, x.shape[axis]) for x in (volume, lung > 0.5)]
    both = [lines] if edge == "diaphragm" else [lines, [line.flip(-1) for line in lines]]
    crossing = []
    for values, inside in both:
        first = inside.int().argmax(-1)
        places = first[:, None] + torch.arange(reach - 1, -reach - 1, -1, device=first.device)
        kept = inside.any(-1) & (places.amin(-1) >= 0) & (places.amax(-1) < values.shape[-1])
        kept[kept.clone()] &= inside[kept].gather(-1, places[kept])[:, :reach].all(-1)
        crossing.append(values[kept].gather(-1, places[kept]))
    profiles = torch.cat(crossing)
    if not len(profiles):
        raise ValueError(f"no line crosses the {edge.replace('_', ' ')} with {reach} voxels on both sides: give the "
                         "lungs' mask, or a smaller reach")
    return profiles.mean(0)


def edge_width(profile: Tensor, spacing: float) -> float:
    """mm over which a profile rises from 10 to 90 % of the way between its ends; of `spacing` mm between samples.
    Raises ValueError where the ends are equal."""
    if profile[0] == profile[-1]:
        raise ValueError("the profile's ends are equal, so that nothing rises between them: give one across an edge")
    share = ((profile - profile[0]) / (profile[-1] - profile[0])).double().numpy(force=True)
    share = np.maximum.accumulate(share)
    places = np.arange(len(share))
    low, high = (float(np.interp(level, share + 1e-9 * places, places)) for level in (0.1, 0.9))
    return (high - low) * spacing


def edge_spread(volume: Tensor, lung: Tensor, grid: Grid, edge: str) -> float:
    """Width in mm, 10 to 90 %, of a reconstruction's edge between lung and what is below or beside it; as
    `edge_profile`."""
    spacing = grid.spacing[AXES[edge]]
    return edge_width(edge_profile(volume, lung, edge, max(2, round(REACH_MM / spacing))), spacing)


def rib_profile(volumes: Tensor, truth: Tensor, lung: Tensor, grid: Grid) -> Tensor:
    """Mean profiles of volumes (..., X, Y, Z) from the middle of the truth's ribs to RIB_MM above and below.

    A middle is a voxel of BONE or more that is the highest of its column within RIB_MM and lies at most WALL_MM outside
    of a lung (mask (X, Y, Z)). Raises ValueError where there is none.
    """
    reach = max(2, round(RIB_MM / grid.spacing[2]))
    near = [2 * max(1, round(WALL_MM / spacing)) + 1 for spacing in grid.spacing]
    inside = lung[None, None].float()
    for axis, size in enumerate(near):
        window = [size if axis == other else 1 for other in range(3)]
        inside = max_pool3d(inside, window, 1, [n // 2 for n in window])
    column = max_pool3d(truth[None, None], (1, 1, 2 * reach + 1), 1, (0, 0, reach))[0, 0]
    middle = (truth >= BONE) & (truth == column) & (inside[0, 0] > 0.5) & (lung <= 0.5)
    middle[:, :, :reach] = middle[:, :, -reach:] = False
    if not middle.any():
        raise ValueError(f"no rib of {BONE:g} HU or more lies beside the lungs' mask: give the lungs of this volume")
    x, y, z = middle.nonzero(as_tuple=True)
    return torch.stack([(volumes[..., x, y, z + step] + volumes[..., x, y, z - step]).mean(-1) / 2
                        for step in range(reach + 1)], -1)


def vessel_visibility(volume: Tensor, truth: Tensor, lung: Tensor) -> float:
    """How much of the vessels' contrast a volume (X, Y, Z) holds: that of the truth's VESSELS brightest lung voxels to
    the mean of their 5^3 neighbourhoods, as a share of the truth's. 1: all of it, 0: none. Raises ValueError where the
    truth has none."""
    contrasts = [x - avg_pool3d(x[None, None], 5, 1, 2, count_include_pad=False)[0, 0] for x in (volume, truth)]
    inside = (lung > 0.5).flatten()
    brightest = torch.where(inside, truth.flatten(), -torch.inf).topk(min(VESSELS, int(inside.sum()))).indices
    measured, expected = (float(contrast.flatten()[brightest].mean()) for contrast in contrasts)
    if expected == 0:
        raise ValueError("the truth's brightest lung voxels are as bright as what is around them: give a chest CT")
    return measured / expected


def sharpness_scores(volume: Tensor, truth: Tensor, lung: Tensor, grid: Grid) -> dict[str, float]:
    """{"edge_diaphragm", "edge_chest_wall", "ribs", "vessels"} of a volume (X, Y, Z) in HU on `grid`, as shares of the
    truth's: widths (edge_) are 1 where edges are as sharp as there, more where they are blurred; of ribs, from
    their middle to between them, and of vessels the contrast is 1 where all of it is there.

    lung: mask (X, Y, Z) in the truth. An edge that no line crosses or that does not show, ribs and vessels without
    lungs, and those without contrast in the truth, as in a box of air alone, have no score.
    """
    scores = {}
    for edge in AXES:
        with suppress(ValueError):
            spread, true_spread = (edge_spread(x, lung, grid, edge) for x in (volume, truth))
            scores[f"edge_{edge}"] = spread / true_spread
    with suppress(ValueError):
        ribs, true_ribs = (float(profile[0] - profile[-1]) for profile in
                           rib_profile(torch.stack([volume, truth]), truth, lung, grid))
        if true_ribs:
            scores["ribs"] = ribs / true_ribs
    if (lung > 0.5).any():
        with suppress(ValueError):
            scores["vessels"] = vessel_visibility(volume, truth, lung)
    return scores
