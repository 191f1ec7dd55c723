"""A walk through the example: X-rays and geometry, two methods, how well they fit, what is uncertain; with pictures.

    python data/example/walkthrough.py [folder for the pictures]
"""

import sys
from pathlib import Path

import phydict  # before torch, whose threads then wait less beside others

# isort: split
import nibabel
import numpy as np
import torch

from phydict.evaluation import method_panel, panel, volume_metrics

METHODS = ("sirt", "phydict_learned")


def main(out: Path, methods=METHODS) -> None:
    here = Path(__file__).parent
    case = phydict.load_xrays(here / "xrays")
    views, rows, columns = case["xrays"].shape
    print(f"1. {views} X-rays of {rows} x {columns} pixels, line integrals up to {case['xrays'].max():.1f}")
    distance = np.linalg.norm(case["beam"].sources, axis=1).mean()
    print(f"2. the sources stand {distance:.0f} mm from the isocentre; the report, used with up to three X-rays: "
          f"{case['report']}")
    truth = torch.from_numpy(nibabel.load(here / "truth.nii.gz").get_fdata(dtype="float32").copy())
    volumes, captions = {}, {}
    for method in methods:
        result = phydict.reconstruct(case["xrays"], case["beam"], method=method)
        scores = volume_metrics(result.volume[None, None], truth[None, None])
        captions[method] = f"{scores['psnr']:.1f} dB, misfit {result.misfit:.4f}"
        print(f"3. {method}: {captions[method]}, {sum(result.seconds.values()):.1f} s")
        worst = max(range(views), key=result.misfit_per_view.__getitem__)
        print(f"   the view that fits worst is {worst} (counted from 0), misfit {result.misfit_per_view[worst]:.4f}")
        for level, half_width in result.intervals.items():
            inside = ((result.volume - truth).abs() <= half_width).float().mean()
            print(f"   the {level:.0%} interval holds {inside:.0%} of the voxels")
        panel(out / f"{method}.png", result.volume, result.grid, result.xrays, result.reprojection, truth, method)
        result.save_nifti(out / f"{method}.nii.gz")
        volumes[method], grid = result.volume, result.grid
    method_panel(out / "comparison.png", volumes, truth, grid, captions)
    print(f"4. pictures and volumes: {out}")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "runs/walkthrough"))
