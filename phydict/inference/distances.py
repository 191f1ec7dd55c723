"""Frechet distances of slices, which take minutes where the slices are many, with their progress."""

from __future__ import annotations

from collections.abc import Mapping

from phydict.evaluation.fid import CaseFeatures, comparable, distances, fid_rows
from phydict.evaluation.planes import PLANES
from phydict.inference.scoring import FIDSettings
from phydict.runtime.progress import CaseProgress


def distance_rows(methods: Mapping[str, Mapping[str, CaseFeatures]], fid: FIDSettings) -> list[dict]:
    """The `fid_rows` of methods, label -> case id -> features, logging which planes are done. Raises ValueError without
    a case."""
    begun = False

    def on_plane(plane: str) -> None:
        nonlocal begun
        if begun:
            progress.finished("measured")
        progress.case(f"plane {plane}")
        begun = True

    with CaseProgress() as progress:
        progress.begin("Frechet distances of slices", len(comparable(methods)) * len(PLANES), verb="measure",
                       noun="plane")
        found = distances(methods, fid.replicates, on_plane)
        progress.finished("measured")
    return fid_rows(found, fid.backbone, fid.replicates, fid.normalisation)
