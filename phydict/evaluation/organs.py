"""How well organs agree: lungs and their vessels in a reconstruction and in the truth.

Both volumes are segmented by `datasets.segment` (thresholds), on voxels of FINEST_MM or less, into which coarser ones
are divided linearly. Where other segmentations of the truth are given, they take the place of the truth's own; the
reconstruction is segmented by thresholds all the same, so that even a perfect one then scores below 1.

    Dice    2 |A and B| / (|A| + |B|), of the lungs; where the truth's were given, also that of its own by thresholds,
            which is what a perfect reconstruction has
    HD95    the 95th percentile of the distances in mm between the lungs' surfaces (MONAI)
    clDice  harmonic mean of the shares of each vessel tree's skeleton that lie in the other tree
            (Shit et al. 2021, arXiv:2003.07311; skeleton by MONAI's soft_skel)
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import interpolate

from phydict.datasets.cts.anatomy import segment
from phydict.grid import Grid
from phydict.xray.boxes import divided

FINEST_MM, SKELETON_STEPS = 3.0, 10
ORGANS_VERSION = 3
"""To be raised where scores of the same volumes change, so that stored ones are not taken for new ones."""


def fine_grid(grid: Grid) -> Grid:
    """The voxels of FINEST_MM or less, whole parts of the grid's, on which organs are compared."""
    return divided(grid, max(1, math.ceil(max(grid.spacing) / FINEST_MM - 1e-6)))


def organ_scores(hu: Tensor, true_hu: Tensor, grid: Grid, given: Mapping[str, np.ndarray] | None = None
                 ) -> dict[str, float]:
    """{"dice_lung", "dice_lung_ct", "hd95_lung", "cldice_vessel"} of volumes (X, Y, Z) in HU on `grid`.

    given: masks (lung, vessel) of the truth on `fine_grid(grid)`, bool, by another segmenter. What is not found in the
    truth has no score; lungs that are not found in the reconstruction have Dice 0 and no HD95. dice_lung_ct, of given
    lungs alone: the Dice of the truth's own by thresholds.
    """
    given = dict(given or {})
    fine = fine_grid(grid)
    organs, known = _organs(hu, fine)
    own, found = _organs(true_hu, fine)
    truth, has = own | given, found | {name: bool(mask.any()) for name, mask in given.items()}
    scores = {}
    if has["lung"]:
        scores["dice_lung"] = dice(organs["lung"], truth["lung"]) if known["lung"] else 0.0
        if "lung" in given:
            scores["dice_lung_ct"] = dice(own["lung"], truth["lung"])
        if known["lung"]:
            scores["hd95_lung"] = hd95(organs["lung"], truth["lung"], fine.spacing)
    if has["vessel"]:
        scores["cldice_vessel"] = cl_dice(organs["vessel"], truth["vessel"]) if known["vessel"] else 0.0
    return scores


def dice(a: np.ndarray, b: np.ndarray) -> float:
    """Dice of two masks, of which one at least is not empty."""
    return float(2 * (a & b).sum() / (a.sum() + b.sum()))


def hd95(a: np.ndarray, b: np.ndarray, spacing) -> float:
    """The 95th percentile of the surfaces' distances in mm of masks (X, Y, Z)."""
    from monai.metrics import compute_hausdorff_distance

    box = tuple(slice(max(0, int(i.min()) - 1), int(i.max()) + 2) for i in np.nonzero(a | b))
    one, other = (torch.from_numpy(mask[box][None, None].astype(np.float32)) for mask in (a, b))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)  # MONAI's, of an argument that it gives itself
        return float(compute_hausdorff_distance(one, other, include_background=True, percentile=95,
                                                spacing=[float(mm) for mm in spacing]))


def cl_dice(a: np.ndarray, b: np.ndarray) -> float:
    """clDice of two trees of vessels, masks (X, Y, Z); 0 where one of them is empty or too thick for its lines to be
    found."""
    if not (a.any() and b.any()):
        return 0.0
    shares = []
    for mask, other in ((a, b), (b, a)):
        lines = skeleton(mask)
        shares.append(float(lines[other].sum() / lines.sum().clip(1e-6)))
    precision, sensitivity = shares
    return 2 * precision * sensitivity / (precision + sensitivity) if precision + sensitivity else 0.0


def skeleton(mask: np.ndarray) -> np.ndarray:
    """The morphological skeleton of a mask (X, Y, Z) that is not empty."""
    from monai.losses.cldice import soft_skel

    return soft_skel(torch.from_numpy(mask[None, None].astype(np.float32)), SKELETON_STEPS)[0, 0].numpy()


def _organs(hu: Tensor, fine: Grid) -> tuple[dict[str, np.ndarray], dict[str, bool]]:
    """Lung and vessels of HU (X, Y, Z) on the finer grid, and which of them were found."""
    volume = interpolate(hu[None, None].float().cpu(), fine.shape, mode="trilinear")[0, 0]
    masks, known = segment(volume.numpy(), fine.spacing)
    return ({"lung": masks[0] > 0, "vessel": masks[2] > 0},
            {"lung": bool(known[0]), "vessel": bool(known[2] and masks[2].any())})
