"""Settings of the methods without a prior, tried on CTs that are kept for training.

    python tests/benchmark/tune_baselines.py <folder of training CTs> [how many of them]

Ideal X-rays as `infer.py test` makes them, from 4 and from 8 views, onto 64^3 voxels; total variation from 2, 16 and 32
as well, and from polychromatic ones of 128^3 voxels. Writes tune_baselines.csv beside this file; settings that it holds
already are not run again. The setting with the highest mean PSNR is the method's default, which
tests/baselines/test_tuned.py checks.
"""

import json
import sys
import zlib
from itertools import product
from pathlib import Path

import numpy as np
from torch.nn.functional import avg_pool3d

from phydict import HUWindow
from phydict.baselines import CGLS, FDK, FISTATV, SIRT, DiffVox
from phydict.datasets import CTFile, find_cts, prepare_ct
from phydict.evaluation import body_weights, read_csv, volume_metrics, write_csv
from phydict.grid import Grid
from phydict.reconstruction import Reconstructor, describe
from phydict.xray import ConeBeam, Ideal, Polychromatic, Projector

sys.path.append(str(Path(__file__).parents[1]))
from fitting import fit_to_grid

FILE = Path(__file__).with_name("tune_baselines.csv")
XRAYS = {"ideal": (Ideal(), 64), "polychromatic": (Polychromatic(), 128)}
"""Simulators, and the voxels along each side of what they see."""
SCENES: list[tuple[str, int]] = [("ideal", 4), ("ideal", 8)]
SCENES_OF: dict[str, list[tuple[str, int]]] = {"tv": list(product(XRAYS, (2, 4, 8, 16, 32)))}
"""The X-rays and numbers of views that each method is tried from, and those of single methods."""
CASES = 3
GRID, WINDOW = Grid.cube(64), HUWindow()
SETTINGS = {
    "fdk": [FDK(hann) for hann in (False, True)],
    "cgls": [*(CGLS(n) for n in (5, 10, 20, 40)),
             *(CGLS(n, restarts, WINDOW) for n, restarts in ((5, 10), (10, 5), (10, 10), (10, 20)))],
    "tv": [FISTATV(n, w) for n, w in ((400, 8e-4), (400, 2.4e-3), (400, 8e-3), (200, 2.4e-3), (100, 2.4e-3))],
    "diffvox": [DiffVox(n, s) for n, s in ((300, 1.5), (300, 5.0), (300, 15.0), (300, 50.0), (500, 15.0), (500, 50.0),
                                           (1000, 15.0), (1000, 50.0))],
    "sirt": [SIRT(n) for n in (100, 300, 1000)],
}


def text(method: Reconstructor) -> str:
    """A method's settings but for its name and the X-rays' own, as JSON."""
    return json.dumps({k: v for k, v in describe(method).items() if k not in ("mu_water", "name")})


def best(rows: list[dict]) -> dict[str, str]:
    """Method -> the settings with the highest PSNR, averaged over cases and numbers of views."""
    psnr: dict[str, dict[str, list[float]]] = {}
    for row in rows:
        psnr.setdefault(row["method"], {}).setdefault(row["settings"], []).append(row["psnr"])
    return {name: max(found, key=lambda s: np.mean(found[s])) for name, found in psnr.items()}


def tune(ct: CTFile, rows: list[dict]) -> None:
    """Adds to `rows` what is missing of one CT."""
    done = {(row["case"], row["xrays"], row["views"], row["settings"]) for row in rows}
    for kind, views in sorted({*SCENES, *(scene for own in SCENES_OF.values() for scene in own)}):
        simulator, voxels = XRAYS[kind]
        volume = prepare_ct(ct.path, Grid.cube(voxels), WINDOW, id=ct.id)["volume"][None]
        truth = WINDOW.to_hu(avg_pool3d(volume, voxels // GRID.shape[0]))
        body = body_weights(truth, GRID.spacing)
        beam = ConeBeam.orbit(views, 1020, 740, (448, 448), 1.25)
        exact = Projector(Grid.cube(voxels), beam, full_detector=True)
        xrays = simulator(exact, WINDOW.to_mu(volume), zlib.crc32(f"0/{ct.id}".encode()))[0]
        for name, methods in SETTINGS.items():
            for method in methods if (kind, views) in SCENES_OF.get(name, SCENES) else ():
                if (ct.id, kind, views, text(method)) in done:
                    continue
                result = method.with_mu_water(simulator.effective_mu_water).reconstruct(
                    *fit_to_grid(method, GRID, xrays, beam))
                scores = volume_metrics(result.volume[None, None], truth, body=body)
                rows.append({"case": ct.id, "method": name, "xrays": kind, "views": views, "settings": text(method),
                             **scores, "misfit": result.misfit, "projector_calls": result.projector_calls})
                print(ct.id, kind, views, name, text(method), f"{scores['psnr']:.2f} dB", flush=True)
                write_csv(FILE, rows)


if __name__ == "__main__":
    if len(sys.argv) < 2:
        raise SystemExit("give the folder of training CTs: python tests/benchmark/tune_baselines.py <folder>")
    rows = read_csv(FILE)
    for ct in find_cts(sys.argv[1])[:int(sys.argv[2]) if len(sys.argv) > 2 else CASES]:
        tune(ct, rows)
    for name, settings in best(rows).items():
        print(f"{name}: {settings}")
