"""What a super-resolution stage adds: reconstructions of CTs on its fine grid, from X-rays made there.

    python tests/benchmark/cascade.py <folder of CTs> <super-resolution stage>[=<views>,<views>...] ...

From eight views where none are given. Runs `infer.py test` with the base prior alone, with the second stage unguided,
and guided; the base prior's volumes are upsampled trilinearly and scored on the fine grid too. Writes cascade.csv
beside this file, and leaves the rows of stages and views that were not given.
"""

import json
import subprocess
import sys
import tempfile
from pathlib import Path

import nibabel
import torch
from rich.console import Console
from torch.nn.functional import interpolate

from phydict.datasets import find_cts, prepare_ct
from phydict.evaluation import mean_table, read_csv, write_csv
from phydict.inference.scoring import case_scores
from phydict.prior import load_super_resolution

FILE = Path(__file__).with_suffix(".csv")
ROOT = FILE.parents[2]


def compared(stage: str, views: int, cts: str) -> list[dict]:
    """One row for each way to the fine grid and each CT."""
    fine, rows = load_super_resolution(stage), []
    runs = {"upsampled": [f"--data.simulation_voxels={fine.grid.shape[0]}"],
            "unguided": [f"--model.super_resolution.file={stage}", "--model.super_resolution.guided=false"],
            "guided": [f"--model.super_resolution.file={stage}"]}
    with tempfile.TemporaryDirectory() as out:
        for name, arguments in runs.items():
            subprocess.run([sys.executable, "infer.py", "test", f"--data.cts={cts}", f"--data.orbit.views={views}",
                            f"--model.out={out}", f"--model.name={name}", *arguments], cwd=ROOT, check=True)
            scores = {row["case"]: row for row in read_csv(Path(out) / name / "results.csv")}
            for ct in find_cts(cts):
                case = Path(out) / name / ct.id
                record = json.loads((case / "reconstruction.json").read_text())
                row = scores[ct.id] | {"peak_memory_mb": record["process_peak_memory_mb"]}
                if name == "upsampled":
                    truth = prepare_ct(ct.path, fine.grid, fine.window, id=ct.id)
                    volume = torch.from_numpy(nibabel.load(case / "volume.nii.gz").get_fdata().astype("float32"))
                    volume = interpolate(volume[None, None], fine.grid.shape, mode="trilinear")
                    row |= case_scores(volume[0, 0], row["misfit"], truth, fine.grid, fine.window)
                rows.append({"stage": Path(stage).stem} | row)
    return rows


if __name__ == "__main__":
    if len(sys.argv) < 3:
        raise SystemExit("give both: python tests/benchmark/cascade.py <folder of CTs> <super-resolution stage> ...")
    cts, *stages = sys.argv[1:]
    for stage, _, views in (given.partition("=") for given in stages):
        for count in (int(n) for n in (views or "8").split(",")):
            new = compared(stage, count, cts)
            others = [row for row in read_csv(FILE) if (row["stage"], row["views"]) != (Path(stage).stem, count)]
            write_csv(FILE, others + new)
            Console(width=160).print(mean_table(new))
