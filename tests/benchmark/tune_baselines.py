"""Settings of the methods without a prior, tried on CTs that are kept for training.

    python tests/benchmark/tune_baselines.py <folder of training CTs> [how many of them]

Ideal X-rays as `infer.py test` makes them, from 4 and from 8 views, onto 64^3 voxels, and total variation from 16 and
32 as well. Writes tune_baselines.csv beside this file; settings that it holds already are not run again. The setting
with the highest mean PSNR from 4 and 8 views is the method's default, which tests/baselines/test_tuned.py checks.
"""

import json
import sys
import zlib
from pathlib import Path

import numpy as np

from phydict import HUWindow
from phydict.baselines import CGLS, FDK, FISTATV, SIRT, DiffVox
from phydict.datasets import CTFile, find_cts, prepare_ct
from phydict.evaluation import body_weights, read_csv, volume_metrics, write_csv
from phydict.grid import Grid
from phydict.reconstruction import Reconstructor, describe
from phydict.xray import ConeBeam, Ideal, Projector

sys.path.append(str(Path(__file__).parents[1]))
from fitting import fit_to_grid

FILE = Path(__file__).with_name("tune_baselines.csv")
VIEWS, MANY = (4, 8), (16, 32)
CASES = 3
GRID, WINDOW = Grid.cube(64), HUWindow()
SETTINGS = {
    "fdk": [FDK(hann) for hann in (False, True)],
    "cgls": [*(CGLS(n) for n in (5, 10, 20, 40)),
             *(CGLS(n, restarts, WINDOW) for n, restarts in ((5, 10), (10, 5), (10, 10), (10, 20)))],
    "tv": [FISTATV(n, w) for n, w in ((200, 1e-4), (200, 3e-4), (200, 1e-3), (200, 3e-3), (100, 3e-4), (400, 3e-4))],
    "diffvox": [DiffVox(n, s) for n, s in ((300, 1.5), (300, 5.0), (300, 15.0), (300, 50.0), (500, 15.0), (500, 50.0),
                                           (1000, 15.0), (1000, 50.0))],
    "sirt": [SIRT(n) for n in (100, 300, 1000)],
}
OF_MANY = {"tv": [FISTATV(200, w) for w in (3e-5, 1e-4, 3e-4)]}
"""What is tried from MANY views."""


def text(method: Reconstructor) -> str:
    """A method's settings but for its name and the X-rays' own, as JSON."""
    return json.dumps({k: v for k, v in describe(method).items() if k not in ("mu_water", "name")})


def best(rows: list[dict]) -> dict[str, str]:
    """Method -> the settings with the highest PSNR, averaged over cases and VIEWS."""
    psnr: dict[str, dict[str, list[float]]] = {}
    for row in (row for row in rows if row["views"] in VIEWS):
        psnr.setdefault(row["method"], {}).setdefault(row["settings"], []).append(row["psnr"])
    return {name: max(found, key=lambda s: np.mean(found[s])) for name, found in psnr.items()}


def tune(ct: CTFile, rows: list[dict]) -> None:
    """Adds to `rows` what is missing of one CT."""
    done = {(row["case"], row["views"], row["settings"]) for row in rows}
    volume = prepare_ct(ct.path, GRID, WINDOW, id=ct.id)["volume"][None]
    truth = WINDOW.to_hu(volume)
    body = body_weights(truth, GRID.spacing)
    for views in VIEWS + MANY:
        beam = ConeBeam.orbit(views, 1020, 740, (448, 448), 1.25)
        exact = Projector(GRID, beam, full_detector=True)
        xrays = Ideal()(exact, WINDOW.to_mu(volume), zlib.crc32(f"0/{ct.id}".encode()))[0]
        for name, methods in (SETTINGS if views in VIEWS else OF_MANY).items():
            for method in methods:
                if (ct.id, views, text(method)) in done:
                    continue
                result = method.reconstruct(*fit_to_grid(method, GRID, xrays, beam))
                scores = volume_metrics(result.volume[None, None], truth, body=body)
                rows.append({"case": ct.id, "method": name, "views": views, "settings": text(method), **scores,
                             "misfit": result.misfit, "projector_calls": result.projector_calls})
                print(ct.id, views, name, text(method), f"{scores['psnr']:.2f} dB", flush=True)
                write_csv(FILE, rows)


if __name__ == "__main__":
    if len(sys.argv) < 2:
        raise SystemExit("give the folder of training CTs: python tests/benchmark/tune_baselines.py <folder>")
    rows = read_csv(FILE)
    for ct in find_cts(sys.argv[1])[:int(sys.argv[2]) if len(sys.argv) > 2 else CASES]:
        tune(ct, rows)
    for name, settings in best(rows).items():
        print(f"{name}: {settings}")
