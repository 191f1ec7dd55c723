"""One file per rival: weights as safetensors, with the grid, the HU window and the geometry that they hold for."""

from __future__ import annotations

import reprlib
from pathlib import Path

from torch import Tensor

from phydict.grid import Grid
from phydict.prior.stage_file import built_network, loaded_stage, window_of
from phydict.rivals.lifted import LiftedNetwork
from phydict.rivals.network import RivalNetwork
from phydict.rivals.rival import Rival
from phydict.rivals.x2ct import X2CTNetwork
from phydict.rivals.xray2ctpa import XrayToCTPANetwork
from phydict.xray import ConeBeam

NETWORKS: dict[str, type[RivalNetwork]] = {
    network.stage: network for network in (LiftedNetwork, X2CTNetwork, XrayToCTPANetwork)}
"""The networks by the name that a file's header calls them."""


def load_rival(path: str | Path) -> Rival:
    """The rival in a file written by `phydict.prior.save_stage`, in evaluation mode.

    Raises FileNotFoundError when there is no file, ValueError when it is truncated, is no rival, or holds weights that
    are not finite.
    """
    def build(header: dict, weights: dict[str, Tensor]) -> Rival:
        rival, training = build_rival(header, weights), header.get("training")
        known = training if isinstance(training, dict) else {}
        rival.budget = {name: known[name] for name in ("steps", "samples") if type(known.get(name)) is int}
        return rival

    return loaded_stage(Path(path), tuple(NETWORKS), build)


def build_rival(header: dict, weights: dict[str, Tensor]) -> Rival:
    """The rival that `Rival.describe` described, with these weights. Raises ValueError where they do not fit."""
    def made() -> Rival:
        beam = None if header["beam"] is None else ConeBeam.from_dict(header["beam"])
        return Rival(NETWORKS[header["stage"]](**header["network"]), Grid(**header["grid"]), window_of(header), beam)

    if not isinstance(header.get("beam"), dict | None):
        raise ValueError(f"beam is {reprlib.repr(header['beam'])}, where a geometry is needed, or null")
    return built_network(made, weights, header, ("network",))
