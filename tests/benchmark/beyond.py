"""What X-rays tell of what lies beyond a volume, above, below and beside it, and what a reconstruction gains by asking.

    python tests/benchmark/beyond.py <folder of CTs> [--method phydict_learned]

Scenes of each CT: as it is in 384 mm, ending in air (`ends`); its last scanned slices repeated to 576 mm at both ends
(`goes on`) or below (`goes on below`), as in continued.py; and with arms of 42 x 72 mm and 40 HU at its sides, outside
the volume (`arms`). Ideal X-rays in geometries that meet these. Each is reconstructed by the default, which asks the
X-rays, and by the same where nothing lies beyond (`_unasked`); within_90: the share of the body inside its 90 %
interval. Writes beyond.csv beside this file and prints means.
"""

import argparse
import time
from dataclasses import replace
from pathlib import Path
from statistics import mean
from unittest.mock import patch

import torch
from continued import GRID, MORE, WINDOW, going_on
from torch import Tensor
from torch.nn.functional import pad

from phydict import ConeBeam, Projector, reconstruct
from phydict.baselines.beside import Beside, with_surroundings
from phydict.datasets import find_cts, prepare_ct
from phydict.evaluation import body_weights, volume_metrics, write_csv
from phydict.grid import Grid
from phydict.methods import fit_to_grid, reconstructor
from phydict.xray import Ideal
from phydict.xray.beyond import unexplained
from phydict.xray.binning import benchmark_orbit

SIDE = 8
"""Voxels beside the volume, at each side, where something stands."""
NEAR = [(f"orbit of {k}", benchmark_orbit(GRID, k)) for k in (1, 2, 8)]
FAR = [(f"long orbit of {k}", ConeBeam.orbit(k, 1300, 800, (448, 448), 1.6, start=0.1)) for k in (4, 8)] + [
    ("PA and lateral, 560 mm", ConeBeam.at_angles([90, 0], 1800, 1500, (448, 448), 1.25))]


def scenes_of(volume: Tensor) -> dict[str, Tensor]:
    """Scene -> a CT (1, 1, X, Y, Z) with MORE slices at both ends and SIDE columns at all sides."""
    ends, goes_on = pad(volume, (MORE, MORE), value=-1.0), going_on(volume)
    below = torch.where(torch.arange(goes_on.shape[-1]) < GRID.shape[2] + MORE, goes_on, -1.0)
    wide = {name: pad(scene, (0, 0, SIDE, SIDE, SIDE, SIDE), value=-1.0)
            for name, scene in (("ends", ends), ("goes on", goes_on), ("goes on below", below))}
    places = torch.arange(GRID.shape[0] + 2 * SIDE) - GRID.shape[0] / 2 - SIDE + 0.5
    arms = (((places[:, None].abs() - 36) / 3.5) ** 2 + (places / 6) ** 2 < 1)[..., None]
    return wide | {"arms": torch.where(arms, WINDOW.to_range(torch.tensor(40.0)), wide["ends"])}


def box(columns: int) -> Grid:
    """The voxels of a scene, with so many columns at each side of the volume."""
    n = GRID.shape[0] + 2 * columns
    return Grid.box([n, n, GRID.shape[2] + 2 * MORE], [6.0 * n, 6.0 * n, 6.0 * (GRID.shape[2] + 2 * MORE)])


def rows_of(ct, method: str) -> list[dict]:
    rows, scenes = [], scenes_of(prepare_ct(ct.path, GRID, WINDOW, id=ct.id)["volume"][None])
    for geometry, beam in NEAR + FAR:
        columns = SIDE if (geometry, beam) in FAR else 0
        middle = slice(SIDE - columns, SIDE + GRID.shape[0] + columns)
        for scene, volume in scenes.items():
            if scene == "arms" and not columns:
                continue
            seen = volume[..., middle, middle, :].contiguous()
            truth = WINDOW.to_hu(volume[..., SIDE:-SIDE, SIDE:-SIDE, MORE:-MORE].contiguous())
            xrays = Ideal()(Projector(box(columns), beam, full_detector=True), WINDOW.to_mu(seen), 0)[0].float()
            ready = reconstructor(method)
            left = [unexplained(xrays, replace(beam, continued=answer), Grid.cube(32)) for answer in (False, True)]
            began = time.perf_counter()
            y, projector = fit_to_grid(ready, GRID, xrays, beam)
            beside = isinstance(with_surroundings(ready, y, projector, False), Beside)
            asking = time.perf_counter() - began
            began = time.perf_counter()
            found = reconstruct(xrays, beam, method=method, grid=GRID)
            seconds = time.perf_counter() - began
            with patch("phydict.methods.with_surroundings", lambda method, *_: method):
                unasked = reconstruct(xrays, replace(beam, continued=False), method=method, grid=GRID)
            psnr, before = (volume_metrics(each.volume[None, None], truth)["psnr"] for each in (found, unasked))
            body = body_weights(truth, GRID.spacing)[0, 0] > 0.5
            within = [float(((each.volume - truth[0, 0]).abs() <= each.intervals[0.9])[body].float().mean())
                      if each.intervals else None for each in (found, unasked)]
            rows.append({"case": ct.id, "geometry": geometry, "scene": scene, "method": method,
                         "left_by_ends_over_continued": left[0] / left[1], "continued": projector.beam.continued,
                         "beside": beside, "psnr": psnr, "psnr_unasked": before, "misfit": found.misfit,
                         "misfit_unasked": unasked.misfit, "within_90": within[0],
                         "within_90_unasked": within[1], "seconds": seconds, "seconds_asking": asking})
            print(*rows[-1].values(), flush=True)
    return rows


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cts", type=Path)
    parser.add_argument("--method", default="phydict_learned")
    given = parser.parse_args()
    rows = [row for ct in find_cts(given.cts) for row in rows_of(ct, given.method)]
    write_csv(Path(__file__).with_suffix(".csv"), rows)
    for geometry, scene in dict.fromkeys((row["geometry"], row["scene"]) for row in rows):
        of = [row for row in rows if (row["geometry"], row["scene"]) == (geometry, scene)]
        print(f"{geometry:24} {scene:14} {mean(row['psnr_unasked'] for row in of):6.2f} "
              f"{mean(row['psnr'] for row in of):6.2f}  inside {mean(row['within_90'] or 0 for row in of):.2f} "
              f"({mean(row['within_90_unasked'] or 0 for row in of):.2f}) "
              f"continued {sum(row['continued'] for row in of)}, "
              f"beside {sum(row['beside'] for row in of)} of {len(of)}")
