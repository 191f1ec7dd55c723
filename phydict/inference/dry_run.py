"""A look before the time is spent: a case's geometry drawn, its X-rays beside those of a standard thorax."""

from __future__ import annotations

from pathlib import Path
from statistics import median

from phydict.datasets.case import Case
from phydict.grid import Grid
from phydict.inference.geometry_page import agreement, geometry_page, view_sides
from phydict.inference.orientation import (
    Comparison,
    correlation,
    flip_doubts,
    standard_thorax,
    thorax_views,
    whole_doubts,
)
from phydict.runtime.warning import warn
from phydict.xray.binning import binned, binning
from phydict.xray.checks import check_fit, prepared_xrays

LOW_VIEW, LOW_MEDIAN = 0.3, 0.45
"""Correlations with the standard thorax below which a view, and the median of all views, is low. In the right geometry
the median was 0.72 to 0.86 on five chest CTs and 0.50 on a sixth whose lungs are cut; of images magnified twice it was
0.26 to 0.49. A wrong order of views stays above."""


def dry_run(path: str | Path, case: Case, grid: Grid, box: Grid | None = None, chest: bool = True) -> list[str]:
    """Write the geometry page of an X-ray Case as PNG; returns one line per view that says what is seen in it, and
    warns of line integrals that no chest has and of views that look turned, moved, upside down, mirrored or unlike a
    thorax in this geometry.

    grid: where a reconstruction would put its voxels; box: those of its result, where they are others; chest: whether
    it is one that is seen, and not a smaller scene, which is drawn in the box alone and of which nothing looks wrong.
    Raises ValueError where X-rays, geometry and grid do not fit.
    """
    beam, display = case["beam"], case.get("display", False)
    grid = grid if chest else box or grid
    check_fit(case["xrays"], beam, box or grid, grid, display)
    factor = binning(grid, beam)
    coarse = beam.binned(factor)
    measured = binned(case["xrays"].float(), factor)
    prepared_xrays(measured, coarse, display)
    xrays, thorax = measured.numpy(), thorax_views(grid, coarse)
    whole, flips = list[str](), list[str]()
    if chest:
        compared = Comparison(case["xrays"], beam, grid)
        whole = whole_doubts(compared)
        flips = [] if whole else flip_doubts(compared)
    for doubt in whole + flips:
        warn(f"{case['id']}: {doubt}")
    geometry_page(path, coarse, grid, xrays, thorax, standard_thorax(grid), title=case["id"], flips=bool(flips))
    agreements = [agreement(*pair, bool(flips)) for pair in zip(xrays, thorax)]
    values = list(map(correlation, xrays, thorax))
    unlike = [k for k, value in enumerate(values) if value < LOW_VIEW or median(values) < LOW_MEDIAN]
    named = [str(k) for k in unlike if "changed" not in agreements[k]]
    if named and chest and not whole:
        warn(f"{case['id']}: view {', '.join(named)} agrees little with a standard thorax in this geometry (median of "
             f"all {median(values):.2f}): check distances, size of the pixels, turn and order of the views")
    kind = "display values" if display else "line integrals"
    return [f"{case['id']} view {k}: {sides}; {kind} from {image.min():.3g} to {image.max():.3g}; {words}"
            for k, (sides, image, words) in enumerate(zip(view_sides(coarse, grid), xrays, agreements))]
