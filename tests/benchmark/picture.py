"""Pictures of a CT beside what phydict_learned and total variation make of eight and two X-rays of it.

    python tests/benchmark/picture.py <CT> [128 or 256]

X-rays are made of 256^3 voxels, 0.5 % noise. Writes data/pictures/grid_<voxels>.png: the CT, phydict_learned on these
voxels and on 64^3, and total variation, whose weight grows with their number along an axis; and, for 128, the README's
real_ct.png, without 64^3.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from torch import Tensor
from torch.nn.functional import avg_pool3d

from phydict import METHODS, Grid, HUWindow, Projector, reconstruct
from phydict.baselines import FISTATV
from phydict.datasets import find_cts, prepare_ct
from phydict.evaluation import method_panel, volume_metrics
from phydict.xray import Ideal
from phydict.xray.binning import benchmark_orbit

PICTURES = Path(__file__).parents[2] / "data" / "pictures"
WINDOW, FINEST = HUWindow(), Grid.cube(256)
COARSE = "64^3"


def seen(volume: Tensor, views: int) -> Tensor:
    """X-rays (K, V, U) of a CT (1, X, Y, Z) on FINEST, in the prior's range."""
    projector = Projector(FINEST, benchmark_orbit(FINEST, views), full_detector=True)
    return Ideal()(projector, WINDOW.to_mu(volume)[None], 0)[0]


def on(volume: Tensor, voxels: int) -> Tensor:
    """A cube (X, Y, Z) in finer voxels, its own repeated."""
    for axis in range(3):
        volume = volume.repeat_interleave(voxels // volume.shape[axis], axis)
    return volume


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("ct", type=Path)
    parser.add_argument("voxels", type=int, nargs="?", default=128, choices=(128, 256))
    given = parser.parse_args()
    grid = Grid.cube(given.voxels)
    source = prepare_ct(find_cts(given.ct)[0].path, FINEST, WINDOW)["volume"]
    truth = WINDOW.to_hu(avg_pool3d(source, FINEST.shape[0] // given.voxels))[0]
    tried = {"phydict_learned": ("phydict_learned", given.voxels),
             f"phydict_learned, {COARSE}": ("phydict_learned", 64),
             "tv": (FISTATV(iterations=200, weight=given.voxels / 64 * METHODS["tv"].weight), given.voxels)}
    volumes, captions = {}, {}
    for views in (8, 2):
        xrays, beam = seen(source, views), benchmark_orbit(FINEST, views)
        for name, (method, voxels) in tried.items():
            found = reconstruct(xrays, beam, method=method, grid=Grid.cube(voxels)).volume
            label = f"{name}, {views} views"
            volumes[label] = on(found, given.voxels)
            scores = volume_metrics(volumes[label][None, None], truth[None, None])
            captions[label] = f"{scores['psnr']:.1f} dB, SSIM {scores['ssim']:.2f}"
            print(label, captions[label], flush=True)
    method_panel(PICTURES / f"grid_{given.voxels}.png", volumes, truth, grid, captions)
    if given.voxels == 128:
        shown = [label for label in volumes if COARSE not in label]
        method_panel(PICTURES / "real_ct.png", {label: volumes[label] for label in shown}, truth, grid,
                     {label: captions[label] for label in shown})


if __name__ == "__main__":
    main()
