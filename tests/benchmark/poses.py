"""Poses found without a CT: what wrong geometries cost, and what a calibration gives back.

    python tests/benchmark/poses.py <folder of CTs> [--views 8 4] [--errors random one none breathing] [--only ID ...]

X-rays of 224 x 224 pixels of 2.7 mm, noise 0.5 % of the largest, are simulated from 64^3 voxels through the true beam;
the reconstruction is given the nominal orbit (source 740 mm, detector 1100 mm), or that and what is uncertain. Errors:

    random      every view: detector and source shifted by N(0, 5 mm) along rows and columns each, its distance wrong by
                N(0, 5 mm), rotated by N(0, 2 degrees) about three axes
    one         view 2 alone: detector shifted by 25 mm and rotated by 6 degrees
    none        the nominal orbit is the true one
    breathing   the nominal orbit is true, but in every second view the lower half of the chest is 10 mm lower

The true scene is carried as a whole to where the nominal beam sees it (phydict.xray.poses.gauge), since no X-ray shows
where it was. psnr_aligned is of the found beam carried to the true one before the reconstruction, psnr_calibrated of
the found beam as it is, and inside_90 the share of the body's voxels in the intervals of 90 %, if there are any;
reprojection_mm is after that carrying, the root mean square over views of 125 points' errors
on the detector. regained: the share of the lost PSNR. warnings: of the calibration; warnings_plain: of the run without.
Rows that poses.csv beside this file holds already are kept.
"""

from __future__ import annotations

import argparse
import sys
import time
import warnings
from pathlib import Path

import numpy as np
import torch

from phydict.datasets import CTSource, body_mask, load_case
from phydict.evaluation import body_weights, read_csv, volume_metrics, write_csv
from phydict.grid import Grid
from phydict.methods import calibrated, reconstructor
from phydict.poses.search import middle_points
from phydict.runtime.precision import instruction_set
from phydict.runtime.seeds import case_seed
from phydict.units import HUWindow
from phydict.xray import ConeBeam, Ideal, Projector
from phydict.xray.poses.gauge import aligned, reprojection_errors
from phydict.xray.poses.uncertain import Uncertain
from phydict.xray.poses.unknowns import moved

sys.path.append(str(Path(__file__).parents[1]))
from fitting import fit_to_grid

USUAL = Uncertain(detector_shift_mm=5.0, source_shift_mm=5.0, source_to_detector_mm=5.0, rotation_degrees=2.0)
FILE = Path(__file__).with_suffix(".csv")
GRID, WINDOW = Grid.cube(64), HUWindow()
POINTS = middle_points(GRID)
ERRORS = ("random", "one", "none", "breathing")
WRONG_VIEW = 2


def orbit(views: int) -> ConeBeam:
    return ConeBeam.orbit(views, 1100, 740, (224, 224), 2.7)


def true_beam(nominal: ConeBeam, errors: str, seed: int) -> ConeBeam:
    """Where the views really were."""
    values = np.zeros((nominal.views, 8))
    if errors == "random":
        values = np.random.default_rng(seed).normal(0, 1, values.shape) * USUAL.poses
    if errors == "one":
        values[WRONG_VIEW] = 25, 0, 0, 0, 0, 0, 0, 6
    return aligned(moved(nominal, values), nominal, POINTS)


def lowered(volume: torch.Tensor, mm: float = 10.0) -> torch.Tensor:
    """A volume (1, X, Y, Z) whose lower half is `mm` lower, and less so towards the apices."""
    slices = torch.arange(volume.shape[-1], dtype=torch.float64)
    share = (2 * (1 - slices / (len(slices) - 1))).clamp(max=1)
    source = (slices + share * mm / GRID.spacing[2]).clamp(max=len(slices) - 1)
    below = source.floor().long().clamp(max=len(slices) - 2)
    part = (source - below).to(volume)
    return (1 - part) * volume[..., below] + part * volume[..., below + 1]


def measured(volume: torch.Tensor, beam: ConeBeam, errors: str, seed: int) -> torch.Tensor:
    """X-rays (K, V, U)."""
    projector = Projector(GRID, beam, "siddon", full_detector=True)
    xrays = Ideal()(projector, WINDOW.to_mu(volume)[None], seed)[0]
    if errors == "breathing":
        xrays[1::2] = Ideal()(projector, WINDOW.to_mu(lowered(volume))[None], seed)[0][1::2]
    return xrays


def row(case: dict, views: int, errors: str, method: str) -> dict:
    """One case with one kind of errors."""
    nominal, seed = orbit(views), case_seed(0, case["id"])
    true = true_beam(nominal, errors, seed)
    xrays, ready, seconds = measured(case["volume"], true, errors, seed), reconstructor(method), {}
    truth = WINDOW.to_hu(case["volume"])[None]

    inside, body = {}, torch.from_numpy(body_mask(truth[0, 0].numpy(), GRID.spacing)) | (case["masks"][0] > 0.5)
    warned, weights, psnr_body = {}, body_weights(truth, GRID.spacing), {}

    def psnr(name: str, y: torch.Tensor, beam: ConeBeam) -> float:
        began = time.process_time()
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            result = ready.reconstruct(*fit_to_grid(ready, GRID, y, beam))
        warned[name] = "; ".join(str(warning.message) for warning in caught) or None
        seconds[name] = time.process_time() - began
        if name == "calibrated" and result.intervals:
            result = poses.added_to(result)
            held = ((result.volume - truth[0, 0]).abs() <= result.intervals[0.9])[body]
            inside["inside_90"], inside["interval_widening"] = float(held.float().mean()), result.interval_widening
        found = volume_metrics(result.volume[None, None], truth, body=weights)
        psnr_body[f"psnr_body_{name}"] = found["psnr_body"]
        return found["psnr"]

    began = time.process_time()
    y, poses = calibrated(ready, GRID, xrays, nominal, USUAL, False)
    seconds["calibrate"] = time.process_time() - began
    said = poses.warnings()
    moved_back = aligned(poses.beam, true, POINTS)
    scores = {"psnr_correct": psnr("correct", xrays, true), "psnr_wrong": psnr("wrong", xrays, nominal),
              "psnr_calibrated": psnr("calibrated", y, poses.beam), "psnr_aligned": psnr("aligned", y, moved_back)}
    lost = scores["psnr_correct"] - scores["psnr_wrong"]
    gained = {f"regained{end}": (scores[f"psnr_{name}"] - scores["psnr_wrong"]) / lost if lost > 0.1 else None
              for name, end in (("calibrated", ""), ("aligned", "_aligned"))}
    return {"case": case["id"], "views": views, "errors": errors, "method": method, **scores, **psnr_body, **gained,
            "reprojection_mm_before": rms(reprojection_errors(nominal, true, POINTS)),
            "reprojection_mm": rms(reprojection_errors(moved_back, true, POINTS)),
            **inside, "misfit_before": poses.misfits[0], "misfit_after": poses.misfits[1],
            "seconds_plain": seconds["wrong"], "seconds_calibrated": seconds["calibrate"] + seconds["calibrated"],
            "instruction_set": instruction_set(torch.device("cpu")),
            "ratio": (seconds["calibrate"] + seconds["calibrated"]) / seconds["wrong"],
            "warnings": "; ".join(said) or None, "warnings_plain": warned["wrong"]}


def rms(values: np.ndarray) -> float:
    return float(np.sqrt((values**2).mean()))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cts")
    parser.add_argument("--views", type=int, nargs="+", default=[8, 4])
    parser.add_argument("--errors", nargs="+", choices=ERRORS, default=ERRORS)
    parser.add_argument("--only", nargs="+")
    parser.add_argument("--method", default="phydict_fast")
    given = parser.parse_args()
    torch.set_num_threads(1)
    rows = read_csv(FILE)
    done = {(r["case"], r["views"], r["errors"], r["method"]) for r in rows}
    for errors in given.errors:
        for views in given.views:
            for ct in CTSource().find(given.cts):
                if (ct.id, views, errors, given.method) in done or (given.only and ct.id not in given.only):
                    continue
                case = load_case(ct, GRID, WINDOW)
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")
                    rows.append(row(case, views, errors, given.method))
                write_csv(FILE, rows)
                print(*(f"{name} {value:.3f}" if isinstance(value, float) else value
                        for name, value in rows[-1].items()), flush=True)


if __name__ == "__main__":
    main()
