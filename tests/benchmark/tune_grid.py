"""Settings on fine voxels, tried on a CT kept for training: the refinement's, and those of methods without a prior.

    python tests/benchmark/tune_grid.py <a training CT> <voxels>x<views> [refinement|tv|cgls|sirt|diffvox ...]

X-rays are made on 256^3 voxels of 1.5 mm, with the default noise. The refinement starts from `phydict_fast` on 64^3,
reconstructed once. Writes tune_grid.csv beside this file and leaves the rows of other settings.
"""

import json
import sys
import time
import zlib
from dataclasses import replace
from pathlib import Path

import torch
from torch.nn.functional import avg_pool3d

from phydict.baselines import CGLS, FISTATV, SIRT, DiffVox
from phydict.datasets import find_cts, prepare_ct
from phydict.evaluation import body_weights, read_csv, volume_metrics, write_csv
from phydict.grid import Grid
from phydict.methods import onto_grid, reconstructor
from phydict.posterior import Posterior, ProximalCG, Refinement
from phydict.reconstruction import describe
from phydict.runtime.precision import instruction_set
from phydict.units import HUWindow
from phydict.xray import ConeBeam, Ideal, Projector

sys.path.append(str(Path(__file__).parents[1]))
from fitting import fit_to_grid

FILE = Path(__file__).with_suffix(".csv")
SCENE, WINDOW = Grid.cube(256), HUWindow()
STEP = ProximalCG(10, 3, tv_weight=10.0, tv_eps=0.003)
SETTINGS = {
    "refinement": [Refinement(None), Refinement(STEP, 0.1), Refinement(STEP, 0.2), Refinement(STEP, 0.5),
                   Refinement(replace(STEP, tv_weight=5.0), 0.2), Refinement(replace(STEP, tv_weight=20.0), 0.2),
                   Refinement(replace(STEP, restarts=2), 0.5), Refinement(STEP, 1.0)],
    "tv": [FISTATV(200, weight) for weight in (2.4e-3, 4.8e-3, 9.6e-3, 1.92e-2)],
    "cgls": [CGLS(10, restarts, WINDOW) for restarts in (20, 10, 5, 3)],
    "sirt": [SIRT(iterations) for iterations in (50, 100, 300, 1000)],
    "diffvox": [DiffVox(), *(DiffVox(300, smoothness) for smoothness in (50.0, 100.0)),
                *(DiffVox(1000, smoothness) for smoothness in (25.0, 100.0, 200.0))]}

SAME = ("case", "method", "voxels", "views", "settings")
"""What a row is made anew of."""


class Once(Posterior):
    """The default method, whose reconstruction is made once."""

    def reconstruct(self, *args, **settings):
        if not hasattr(self, "made"):
            object.__setattr__(self, "made", super().reconstruct(*args, **settings))
        return self.made


def main(ct: str, voxels: int, views: int, names: list[str]) -> None:
    grid = Grid.cube(voxels)
    case = find_cts(ct)[0]
    volume = prepare_ct(case.path, SCENE, WINDOW, id=case.id)["volume"]
    truth = WINDOW.to_hu(avg_pool3d(volume[None], SCENE.shape[0] // voxels))
    beam = ConeBeam.orbit(views, 1020, 740, (448, 448), 1.25)
    xrays = Ideal()(Projector(SCENE, beam, full_detector=True), WINDOW.to_mu(volume)[None],
                    zlib.crc32(f"0/{case.id}".encode()))[0]
    default = reconstructor("phydict_fast")
    base, rows = Once(default.prior, default.sampler), read_csv(FILE)
    for name in names:
        for settings in SETTINGS[name]:
            ready = onto_grid(base, grid, settings) if name == "refinement" else settings
            began = time.process_time()
            found = ready.reconstruct(*fit_to_grid(ready, grid, xrays, beam))
            spent = time.process_time() - began
            scores = volume_metrics(found.volume[None, None], truth, body=body_weights(truth, grid.spacing))
            row = {"case": case.id, "method": name, "voxels": voxels, "views": views,
                   "settings": json.dumps(describe(settings)), **scores, "misfit": found.misfit,
                   "cpu_seconds": round(spent, 1),
                   "instruction_set": instruction_set(torch.device("cpu"))}
            rows = [old for old in rows if any(old[k] != row[k] for k in SAME)]
            write_csv(FILE, rows := [*rows, row])
            print(voxels, views, name, row["settings"], f"{row['psnr']:.2f} dB, {row['cpu_seconds']} s", flush=True)


if __name__ == "__main__":
    if len(sys.argv) < 3:
        raise SystemExit("give a training CT and voxels x views: python tests/benchmark/tune_grid.py <CT> 128x8")
    main(sys.argv[1], *map(int, sys.argv[2].split("x")), sys.argv[3:] or list(SETTINGS))
