"""Two plain radiographs as DICOM: what a pair gives with and without calibration.

    python tests/benchmark/radiographs.py <folder of CTs> [--release <folder of the release's X-rays>]

Of each CT a PA and a right lateral image are simulated from 128^3 voxels: 120 kVp, scatter behind a grid, a heel
effect by which the signal falls by 30 % from the lowest to the uppermost row, 12-bit display values of unknown gain and
offset. The patient turns by hand: between what the tags say and what was exposed lie N(0, 5 degrees) about the vertical
and N(0, 2 degrees) about the other axes, N(0, 10 mm) of the detector along rows and columns, and a magnification of up
to 10 % more or less in each view. The true scene is carried as a whole to where the nominal beam sees it, since no
X-ray shows where it was. Given is each of

    true        the true geometry, which no one knows
    tags        what the tags say
    calibrated  what the tags say, and `calibrate`, which takes them for uncertain by what is usual

Writes radiographs.csv beside this file: scores against the CT on 64^3 voxels, the share of the voxels of body and lungs
inside the 90 % interval and half its mean width there, reprojection_mm as poses.py has it, and what was said. Of the
release's own images 0 (PA) and 2 (lateral) the misfit alone is known: there is no truth.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import warnings
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from phydict import ConeBeam, Grid, HUWindow, Projector, load_xrays, reconstruct
from phydict.datasets import body_mask, find_cts, prepare_ct
from phydict.evaluation import volume_metrics, write_csv
from phydict.poses.search import middle_points
from phydict.runtime.seeds import case_seed
from phydict.runtime.shipped import shipped
from phydict.xray import Polychromatic
from phydict.xray.poses.gauge import aligned, reprojection_errors
from phydict.xray.poses.uncertain import by_hand
from phydict.xray.poses.unknowns import moved

sys.path.insert(0, str(Path(__file__).parents[1]))
from dicom_files import write_dicom

FILE = Path(__file__).with_suffix(".csv")
WINDOW, GRID, FINE = HUWindow(), Grid.cube(64), Grid.cube(128)
POINTS = middle_points(GRID)
SIMULATOR = Polychromatic(120, scatter=0.06)
DISTANCE, ISOCENTRE, PIXEL = 1800.0, 1400.0, 2.0
NOMINAL = ConeBeam.at_angles([0, 90], DISTANCE, ISOCENTRE, (240, 240), PIXEL)
POSITIONS = {"PA": ["L", "F"], "RL": ["A", "F"]}
"""ViewPosition of each view and the directions of its columns and rows."""
HEEL = 0.3
METHODS = ("phydict_learned", "tv")


def true_beam(seed: int) -> ConeBeam:
    """Where the views really were, the scene carried to where the nominal beam sees it."""
    random = np.random.default_rng(seed)
    values = np.zeros((2, 8))
    values[:, :2] = random.normal(0, 10, (2, 2))
    values[:, 4] = DISTANCE * random.uniform(-0.1, 0.1, 2)
    values[:, 5:] = random.normal(0, 1, (2, 3)) * [2, 5, 2]  # about columns' direction, rows' direction, normal
    return aligned(moved(NOMINAL, values), NOMINAL, POINTS)


def exposed(volume: Tensor, beam: ConeBeam, seed: int) -> Tensor:
    """Line integrals (K, V, U) with scatter and heel effect of a volume (1, X, Y, Z) on FINE."""
    xrays = SIMULATOR(Projector(FINE, beam, full_detector=True), WINDOW.to_mu(volume)[None], seed)[0]
    heel = torch.linspace(1 - HEEL, 1, xrays.shape[1])[:, None]
    return xrays - heel.log()


def as_dicom(folder: Path, xrays: Tensor) -> dict:
    """The pair, written and read."""
    for image, (position, orientation) in zip(xrays.numpy(), POSITIONS.items()):
        stored = np.rint(4095 * (image - image.min()) / np.ptp(image)).astype(np.uint16)
        write_dicom(folder / f"{len(list(folder.iterdir()))}_{position}.dcm", stored, "DX", ViewPosition=position,
                    PatientOrientation=orientation, ImagerPixelSpacing=[PIXEL, PIXEL], BitsStored=12, HighBit=11,
                    DistanceSourceToDetector=DISTANCE, PixelIntensityRelationship="LOG",
                    EstimatedRadiographicMagnificationFactor=DISTANCE / ISOCENTRE, PixelIntensityRelationshipSign=-1)
    return load_xrays(folder)


def told(found, caught: list) -> dict:
    """What is known of a reconstruction without the truth."""
    said = dict.fromkeys(" ".join(str(warning.message).split()) for warning in caught)
    return {"misfit": found.misfit, "interval_widening": found.interval_widening if found.intervals else None,
            "said": "; ".join(said) or None}


def rows_of(ct) -> list[dict]:
    """A CT's pair by each method, given each geometry."""
    fine = prepare_ct(ct.path, FINE, WINDOW, id=ct.id)["volume"]
    truth, seed = WINDOW.to_hu(torch.nn.functional.avg_pool3d(fine, 2)), case_seed(0, ct.id)
    lung = prepare_ct(ct.path, GRID, WINDOW, id=ct.id)["masks"][:1] > 0.5
    body = torch.from_numpy(body_mask(truth[0].numpy(), GRID.spacing))[None] | lung
    true = true_beam(seed)
    with tempfile.TemporaryDirectory() as folder:
        pair = as_dicom(Path(folder), exposed(fine, true, seed))
    rows = []
    for method in METHODS:
        for given, beam in (("true", true), ("tags", pair["beam"]), ("calibrated", pair["beam"])):
            with warnings.catch_warnings(record=True) as caught:
                warnings.simplefilter("always")
                found = reconstruct(pair["xrays"], beam, method=method, display=pair["display"],
                                    uncertain=pair["uncertain"] if given == "calibrated" else None)
            scores = volume_metrics(found.volume[None, None], truth[None], lung[None].float(), body[None].float())
            used = aligned(found.beam, true, POINTS) if found.beam else beam
            inside = (found.volume - truth[0]).abs() <= found.intervals[0.9] if found.intervals else None
            rows.append({"case": ct.id, "method": method, "geometry": given,
                         **{name: scores[name] for name in ("psnr", "ssim", "psnr_body", "mae_hu")},
                         **{f"inside_90_{part}": None if inside is None else float(inside[mask[0]].float().mean())
                            for part, mask in (("body", body), ("lung", lung))},
                         "half_width_90_hu": float(found.intervals[0.9][body[0]].mean()) if found.intervals else None,
                         "reprojection_mm": float(np.sqrt((reprojection_errors(used, true, POINTS)**2).mean())),
                         **told(found, caught)})
    return rows


def release(folder: Path) -> list[dict]:
    """The misfit of the release's own PA and lateral image, with and without calibration."""
    described = shipped("configs/geometry/phydict_release.yaml")
    beam = ConeBeam.load(described).select([0, 2])
    images = [np.asarray(Image.open(folder / f"real_img_800.0_{view}.png"))[::-1, :, 0] / 255 for view in (0, 2)]
    rows = []
    for given, uncertain in (("tags", None), ("calibrated", by_hand(beam))):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            found = reconstruct(np.stack(images).astype(np.float32), beam, display=True, uncertain=uncertain)
        rows.append({"case": "release", "method": METHODS[0], "geometry": given, **told(found, caught)})
    return rows


def table(rows: list[dict]) -> str:
    """Means over CTs, as Markdown."""
    columns = [name for name, value in rows[0].items() if isinstance(value, float)]
    lines = ["| method | geometry | " + " | ".join(columns) + " |", "|---|---|" + "---:|" * len(columns)]
    for place in dict.fromkeys((row["method"], row["geometry"]) for row in rows):
        own = [row for row in rows if (row["method"], row["geometry"]) == place and row["case"] != "release"]
        lines.append(f"| {place[0]} | {place[1]} | " + " | ".join(
            "-" if own[0][name] is None else f"{np.mean([row[name] for row in own]):.3f}" for name in columns) + " |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cts", type=Path)
    parser.add_argument("--release", type=Path)
    given = parser.parse_args()
    rows = [row for ct in find_cts(given.cts) for row in rows_of(ct)]
    write_csv(FILE, rows + (release(given.release) if given.release else []))
    print(table(rows))


if __name__ == "__main__":
    main()
