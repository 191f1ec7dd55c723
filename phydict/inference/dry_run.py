"""A look before the time is spent: a case's geometry drawn, its X-rays beside those of a standard thorax."""

from __future__ import annotations

from pathlib import Path
from statistics import median

import torch

from phydict.datasets import Thorax, build
from phydict.datasets.case import Case
from phydict.grid import Grid
from phydict.inference.geometry_page import agreement, correlation, geometry_page, view_sides
from phydict.runtime.warning import warn
from phydict.units import hu_to_mu
from phydict.xray import Projector
from phydict.xray.binning import binned, binning
from phydict.xray.checks import check_fit

LOW_VIEW, LOW_MEDIAN = 0.3, 0.45
"""Correlations with the standard thorax below which a view, and the median of all views, is low. In the right geometry
the median was 0.72 to 0.86 on five chest CTs and 0.50 on a sixth whose lungs are cut; of images magnified twice it was
0.26 to 0.49. A wrong order of views stays above."""


def dry_run(path: str | Path, case: Case, grid: Grid, box: Grid | None = None) -> list[str]:
    """Write the geometry page of an X-ray Case as PNG; returns one line per view that says what is seen in it, and
    warns of views that look upside down, mirrored or unlike a thorax in this geometry.

    grid: where a reconstruction would put its voxels; box: those of its result, where they are others. Raises
    ValueError where X-rays, geometry and grid do not fit.
    """
    beam = case["beam"]
    check_fit(case["xrays"], beam, box or grid, grid)
    factor = binning(grid, beam)
    coarse = beam.binned(factor)
    hu = build(Thorax.standard(), grid)[0]
    thorax = Projector(grid, coarse)(hu_to_mu(torch.from_numpy(hu))[None, None])[0].numpy()
    xrays = binned(case["xrays"].float(), factor).numpy()
    geometry_page(path, coarse, grid, xrays, thorax, hu, title=case["id"])
    agreements = [agreement(*pair) for pair in zip(xrays, thorax)]
    for flips, how in (("flip_rows", "upside down"), ("flip_rows and flip_columns", "turned by 180 degrees")):
        turned = [str(k) for k, words in enumerate(agreements) if words.endswith(f"with {flips} changed")]
        if turned:
            warn(f"{case['id']}: view {', '.join(turned)} agrees better with a standard thorax when {how}: row 0 is "
                 f"superior, change {flips}")
    mirrored = [str(k) for k, words in enumerate(agreements) if words.endswith("with flip_columns changed")]
    if mirrored:
        warn(f"{case['id']}: view {', '.join(mirrored)} agrees better with a standard thorax when mirrored: "
             "check on which side the source stands, for a left lateral (LL) view at the patient's right, 270 "
             "degrees of an orbit, or change flip_columns")
    values = [correlation(*pair) for pair in zip(xrays, thorax)]
    unlike = [k for k, value in enumerate(values) if value < LOW_VIEW or median(values) < LOW_MEDIAN]
    if named := [str(k) for k in unlike if "better" not in agreements[k]]:
        warn(f"{case['id']}: view {', '.join(named)} agrees little with a standard thorax in this geometry (median of "
             f"all {median(values):.2f}): check distances, size of the pixels, turn and order of the views")
    return [f"{case['id']} view {k}: {sides}; {words}"
            for k, (sides, words) in enumerate(zip(view_sides(coarse, grid), agreements))]
