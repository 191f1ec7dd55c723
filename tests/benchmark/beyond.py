"""What a reconstruction gains by asking the X-rays what lies beyond its volume, above, below and beside it.

    python tests/benchmark/beyond.py <folder of CTs> [--methods phydict_learned ...] [--geometries "orbit of 8" ...]

Scenes of each CT: as it is in 384 mm, ending in air (`ends`); its last scanned slices repeated to 576 mm at both ends
(`continues`) or below (`continues below`); moved down or up by 96 mm, so that it does continue (`lower`, `higher`);
and with arms of 42 x 72 mm and 40 HU at its sides, outside the volume (`arms`). Ideal X-rays in geometries that meet
these. Each is reconstructed by the default, which asks the X-rays, and by the same where nothing lies beyond
(`_unasked`), CTs that end also where `continued` says that they do not (`_told`); within_90: the share of the body
inside the 90 % interval. Writes beyond.csv beside this file after each CT, where other rows stay, and prints means.
"""

import argparse
import time
from dataclasses import replace
from pathlib import Path
from statistics import mean
from unittest.mock import patch

import torch
from torch import Tensor
from torch.nn.functional import pad

from phydict import ConeBeam, Projector, reconstruct
from phydict.baselines.extended import extended
from phydict.datasets import find_cts, prepare_ct
from phydict.evaluation import body_weights, read_csv, volume_metrics, write_csv
from phydict.grid import Grid
from phydict.methods import reconstructor
from phydict.reconstruction import Reconstruction
from phydict.units import HUWindow
from phydict.xray import Ideal
from phydict.xray.binning import benchmark_orbit

FILE = Path(__file__).with_suffix(".csv")
GRID, WINDOW = Grid.cube(64), HUWindow()
MORE, SIDE = 16, 8
"""Slices above and below the volume, and voxels beside it, at each side, where something may be."""
SOFT, LEAST = -300, 150
"""HU, and voxels above it, by which a slice was scanned."""
NEAR = {f"orbit of {k}": benchmark_orbit(GRID, k) for k in (1, 2, 8)}
FAR = {f"long orbit of {k}": ConeBeam.orbit(k, 1300, 800, (448, 448), 1.6, start=0.1) for k in (4, 8)} | {
    "PA and lateral, 560 mm": ConeBeam.at_angles([90, 0], 1800, 1500, (448, 448), 1.25)}


def going_on(volume: Tensor) -> Tensor:
    """A CT (1, 1, X, Y, Z) on MORE slices to both sides, those that were not scanned replaced by the last that were."""
    scanned = ((WINDOW.to_hu(volume)[0, 0] > SOFT).sum((0, 1)) > LEAST).nonzero().flatten()
    first, last = int(scanned[0]) + 1, int(scanned[-1]) - 1  # whose averages hold no slice beyond the scan
    return volume[..., torch.arange(-MORE, GRID.shape[2] + MORE).clamp(first, last)]


def scenes_of(volume: Tensor) -> dict[str, Tensor]:
    """Scene -> a CT (1, 1, X, Y, Z) with MORE slices at both ends and SIDE columns at all sides."""
    ends, goes_on = pad(volume, (MORE, MORE), value=-1.0), going_on(volume)
    below = torch.where(torch.arange(goes_on.shape[-1]) < GRID.shape[2] + MORE, goes_on, -1.0)
    wide = {name: pad(scene, (0, 0, SIDE, SIDE, SIDE, SIDE), value=-1.0)
            for name, scene in (("ends", ends), ("continues", goes_on), ("continues below", below),
                                ("lower", ends.roll(-MORE, -1)), ("higher", ends.roll(MORE, -1)))}
    places = torch.arange(GRID.shape[0] + 2 * SIDE) - GRID.shape[0] / 2 - SIDE + 0.5
    arms = (((places[:, None].abs() - 36) / 3.5) ** 2 + (places / 6) ** 2 < 1)[..., None]
    return wide | {"arms": torch.where(arms, WINDOW.to_range(torch.tensor(40.0)), wide["ends"])}


def row_of(volume: Tensor, beam: ConeBeam, columns: int, method: str, ends: bool) -> dict:
    """The scores of a scene, of which so many columns at each side of the volume are seen."""
    middle = slice(SIDE - columns, SIDE + GRID.shape[0] + columns)
    seen = volume[..., middle, middle, :].contiguous()
    truth = WINDOW.to_hu(volume[..., SIDE:-SIDE, SIDE:-SIDE, MORE:-MORE].contiguous())
    xrays = Ideal()(Projector(GRID.grown(columns, columns, MORE), beam, full_detector=True), WINDOW.to_mu(seen), 0)[0]
    body = body_weights(truth, GRID.spacing)

    def scored(name: str, found: Reconstruction) -> dict:
        scores = volume_metrics(found.volume[None, None], truth, body=body)
        inside = (found.volume - truth[0, 0]).abs() <= found.intervals[0.9] if found.intervals else None
        return {f"psnr{name}": scores["psnr"], f"psnr_body{name}": scores["psnr_body"], f"misfit{name}": found.misfit,
                f"within_90{name}": None if inside is None else float(inside[body[0, 0] > 0.5].float().mean())}

    began = time.perf_counter()
    extended(reconstructor(method), GRID, xrays, beam, False)
    asking = time.perf_counter() - began
    began = time.perf_counter()
    found = reconstruct(xrays, beam, method=method, grid=GRID)
    seconds = time.perf_counter() - began
    with patch("phydict.methods.extended", lambda method, grid, xrays, beam, display: (method, grid, beam)):
        unasked = reconstruct(xrays, replace(beam, continued=False), method=method, grid=GRID)
    told = scored("_told", reconstruct(xrays, replace(beam, continued=True), method=method, grid=GRID)) if ends else {}
    return {"extended_beside_mm": found.extended_mm[0], "extended_above_mm": found.extended_mm[2],
            "seconds": seconds, "seconds_asking": asking} | scored("", found) | scored("_unasked", unasked) | told


def rows_of(ct, methods: list[str], geometries: list[str]) -> list[dict]:
    rows, scenes = [], scenes_of(prepare_ct(ct.path, GRID, WINDOW, id=ct.id)["volume"][None])
    for geometry in geometries:
        for scene, volume in scenes.items():
            if scene == "arms" and geometry not in FAR:
                continue
            for method in methods:
                scores = row_of(volume, (NEAR | FAR)[geometry], SIDE if geometry in FAR else 0, method, scene == "ends")
                rows.append({"case": ct.id, "geometry": geometry, "scene": scene, "method": method} | scores)
                print(*rows[-1].values(), flush=True)
    return rows


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cts", type=Path)
    parser.add_argument("--methods", nargs="+", default=["phydict_learned"])
    parser.add_argument("--geometries", nargs="+", default=[*NEAR, *FAR], choices=[*NEAR, *FAR])
    given = parser.parse_args()
    for ct in find_cts(given.cts):
        rows = rows_of(ct, given.methods, given.geometries)
        write_csv(FILE, [row for row in read_csv(FILE) if row["case"] != ct.id or row["method"] not in given.methods
                         or row["geometry"] not in given.geometries] + rows)
    rows = [row for row in read_csv(FILE) if row["method"] in given.methods and row["geometry"] in given.geometries]
    for key in dict.fromkeys((row["method"], row["geometry"], row["scene"]) for row in rows):
        of = [row for row in rows if (row["method"], row["geometry"], row["scene"]) == key]
        means = {name: mean(row[name] for row in of)
                 for name in ("psnr_unasked", "psnr", "psnr_body_unasked", "psnr_body", "psnr_told", "within_90")
                 if all(row.get(name) is not None for row in of)}
        print(*key, *(f"{name} {value:.2f}" for name, value in means.items()),
              *(f"{name} {sum(row[name] > 0 for row in of)}" for name in ("extended_above_mm", "extended_beside_mm")))
