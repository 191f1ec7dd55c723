"""How often flips, turns, the wrong sense or start of angles, a wrong detector shift and mirrored patients are named,
and the right geometry left alone.

    python tests/benchmark/orientation.py <folder of CTs> [<number of phantoms>]

X-rays of each CT and phantom (6) on 64^3 voxels, without noise, for orbits of 1, 2, 4 and 8 views and every file of
configs/geometry, as they are and with one mistake each: "shift" is a detector 20 mm along the rows and 50 mm along the
columns beside where it is told to be, "turn" are transposed images, and of "start" and "half" all angles are a quarter
and half of a turn more. Writes orientation.csv beside this file: of each geometry and mistake the number of cases of
which each was said.
"""

import sys
from collections import Counter
from dataclasses import replace
from pathlib import Path

import torch

from phydict.datasets import CTCases, CTSource, phantom_case
from phydict.evaluation import write_csv
from phydict.grid import Grid
from phydict.inference.orientation import in_other_sense, orientation_doubts, rotated
from phydict.units import HUWindow
from phydict.xray import ConeBeam, Projector
from phydict.xray.binning import benchmark_orbit, binning

FILE = Path(__file__).with_suffix(".csv")
GRID, WINDOW = Grid.cube(64), HUWindow()
FIRST_PHANTOM = 5000
SAID = {"upside down": "rows", "turned by 180": "rows and columns", "looks mirrored": "patient",
        "moved alike": "shift", "by a quarter": "turn", "turned by half": "half",
        "about the patient": "start",
        "the others as stated": "columns"}
SHIFT, START, HALF = (20.0, 50.0), 90.0, 180.0


def geometries() -> dict[str, ConeBeam]:
    orbits = {f"{views} views over {arc:g} degrees": benchmark_orbit(GRID, views, arc)
              for views, arc in ((1, 360), (2, 180), (2, 360), (4, 180), (4, 360), (8, 360))}
    return orbits | {file.stem: ConeBeam.load(file) for file in sorted(Path("configs/geometry").glob("*.yaml"))}


def said(xrays: torch.Tensor, beam: ConeBeam) -> str:
    """What the first doubt names, as a column of the CSV says it."""
    doubts = orientation_doubts(xrays, beam, GRID)
    if not doubts:
        return "nothing"
    named = next((name for words, name in SAID.items() if words in doubts[0]), None)
    return named or min(("columns", "sense"), key=lambda name: doubts[0].index(
        "change flip_columns" if name == "columns" else "negate the angles"))


if __name__ == "__main__":
    folder, *count = sys.argv[1:]
    cts = CTCases(CTSource().find(folder), None, GRID, WINDOW)
    volumes = [cts[n]["volume"] for n in range(len(cts))]
    volumes += [phantom_case(FIRST_PHANTOM + n, GRID)["volume"] for n in range(int(count[0]) if count else 6)]
    rows: dict[tuple[str, str], Counter] = {}
    for name, beam in geometries().items():
        beam = beam.binned(binning(GRID, beam))
        A, moved = (Projector(GRID, b, full_detector=True) for b in (beam, beam.shifted(*SHIFT)))
        lying = replace(beam, shape=beam.shape[::-1])
        for volume in volumes:
            mu = WINDOW.to_mu(torch.as_tensor(volume))[None]
            xrays = A(mu)[0]
            mirrored, other = xrays.flip(2), in_other_sense(beam, GRID)
            given = {"none": (xrays, beam), "rows": (xrays.flip(1), beam), "columns": (mirrored, beam),
                     "sense": (xrays, other), "patient": (mirrored, other), "shift": (moved(mu)[0], beam),
                     "turn": (xrays.mT, lying), "start": (xrays, rotated(beam, GRID, START)),
                     "half": (xrays, rotated(beam, GRID, HALF))}
            for mistake, scene in given.items():
                rows.setdefault((name, mistake), Counter())[said(*scene)] += 1
    what = ("nothing", "rows", "rows and columns", "columns", "sense", "patient", "shift", "turn", "start", "half")
    write_csv(FILE, [{"geometry": name, "mistake": mistake, "cases": len(volumes)} | {
        f"said {word}": counts[word] for word in what} for (name, mistake), counts in rows.items()])
    right = sum(counts["nothing"] for (_, mistake), counts in rows.items() if mistake == "none")
    print(f"right geometries left alone: {right} of {len(volumes) * len(rows) // len(given)}")
