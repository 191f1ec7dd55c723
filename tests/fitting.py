"""What methods are given of X-rays, where the voxels are not to grow as in `phydict.reconstruct`."""

from __future__ import annotations

from torch import Tensor

from phydict.grid import Grid
from phydict.reconstruction import Reconstructor
from phydict.xray import ConeBeam, Projector
from phydict.xray.beyond import with_continuation
from phydict.xray.boxes import binned_to


def fit_to_grid(method: Reconstructor, grid: Grid, xrays: Tensor, beam: ConeBeam,
                projector: str = "auto") -> tuple[Tensor, Projector]:
    """X-rays (K, V, U), binned unless the method wants the full detector, and the projector that goes with them on the
    X-rays' device; `projector` is its kind, as Projector's `method`. Whether the patient continues beyond the grid is
    asked of the X-rays where the beam does not say."""
    xrays = xrays.float()
    beam = with_continuation(xrays, beam, method.survey or grid, False)
    return binned_to(grid, xrays, beam, method.full_detector, projector)
