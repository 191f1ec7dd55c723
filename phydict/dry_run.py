"""A look before the time is spent: a case's geometry drawn, its X-rays beside those of a standard thorax."""

from __future__ import annotations

from pathlib import Path

import torch

from phydict.datasets import Thorax, build
from phydict.evaluation import agreement, geometry_page, view_sides
from phydict.grid import Grid
from phydict.methods import binned, binning
from phydict.reconstructor import check_xrays
from phydict.units import hu_to_mu
from phydict.xray import Projector


def dry_run(path: str | Path, case: dict, grid: Grid) -> list[str]:
    """Write the geometry page of an X-ray Case as PNG; returns one line per view that says what is seen in it.

    grid: where a reconstruction would put its voxels. Raises ValueError where X-rays, geometry and grid do not fit.
    """
    beam = case["beam"]
    check_xrays(case["xrays"], beam)
    beam.check(grid)
    beam.check_scale(grid)
    factor = binning(grid, beam)
    coarse = beam.binned(factor)
    hu = build(Thorax.standard(), grid)[0]
    thorax = Projector(grid, coarse)(hu_to_mu(torch.from_numpy(hu))[None, None])[0].numpy()
    xrays = binned(case["xrays"].float(), factor).numpy()
    geometry_page(path, coarse, grid, xrays, thorax, hu, title=case["id"])
    return [f"{case['id']} view {k + 1}: {sides}; {agreement(xrays[k], thorax[k])}"
            for k, sides in enumerate(view_sides(coarse, grid))]
